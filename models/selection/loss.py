"""Losses of many cells on the same left-out runs: differences, the cost of choosing, records on other machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import ndtri

from data.arrays import Array
from models import RECORDS, USUAL_RECORD

BASELINES = ("zero", "mean_curve")
_RECORD_RUNS = 8.0  # as `PromotionRule.record_runs`


def cost_of_choosing(
    S_um: Array, cells: Sequence[tuple[str, str, int]], tried: Mapping[str, int], weight: Array | None = None
) -> Array:
    """What the best of many cells is flattered by, (C,) in µm; S_um (C, R).

    Of m equal cells the best looks better by the expected maximum of m normal deviates (Blom 1958), each with the
    standard error of the difference to the family's reference, the cell with the most points: that one costs nothing.

    Args:
        tried: how many cells of each family took part in the search.
    """
    families = [family for _, family, _ in cells]
    out = np.zeros(len(cells))
    for family in dict.fromkeys(families):
        own = [i for i, f in enumerate(families) if f == family]
        reference = max(own, key=lambda i: (cells[i][2], cells[i][0] == "none", np.isfinite(S_um[i]).all()))
        m = max(tried.get(family, 0), len(own))
        _, se_um = paired(S_um[own], S_um[reference], weight)
        out[own] = float(ndtri((m - 0.375) / (m + 0.25))) * np.where(np.isfinite(se_um), se_um, 0.0)
    return out


def pooled(
    loss_um: Array, families: Sequence[str], runs: float, record_runs: float = _RECORD_RUNS
) -> tuple[Array, float]:
    """Losses (C,) on so many runs, pooled with what their families reached on other machines (`models.RECORDS`).

    The logarithms are averaged, the record counting like `record_runs` runs and starting from the least loss here.
    Hierarchical models of several machines: Gelman et al. (2013), Bayesian Data Analysis, ch. 5.

    Returns:
        the pooled losses (C,), and the share of this machine's own runs in them.
    """
    share = runs / (runs + record_runs)
    record = np.array([RECORDS.get(f, USUAL_RECORD) for f in families])
    least_um = float(np.min(loss_um, initial=np.inf))
    if not (np.isfinite(least_um) and least_um > 0):
        return loss_um, share
    return loss_um**share * (least_um * record / min(RECORDS.values())) ** (1.0 - share), share


def paired(S_um: Array, leader_um: Array, weight: Array | None = None) -> tuple[Array, Array]:
    """Mean difference of S (C, R) to that of the leader (R,) on the same runs, and its standard error, (C,) each.

    Args:
        weight: of the runs (R,); None: equal.
    """
    w = np.ones(S_um.shape[1]) if weight is None else weight
    with np.errstate(invalid="ignore"):
        d = S_um - leader_um
        mean = d @ w / w.sum()
        n = len(w)
        spread = np.sqrt(((w * (d - mean[:, None])) ** 2).sum(axis=1) * n / max(n - 1, 1)) / w.sum()
    return mean, np.where(np.isfinite(spread) & (n > 1), spread, np.inf)
