"""Losses of many cells on the same left-out runs: differences, the cost of choosing, records on other machines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import ndtri

from data.arrays import Array

# Mean S of later runs with all points over that of the best family, geometric mean over four kinds of machine: the
# sample year (3 + 2 error channels of two seeds), simulated machines of two kinds (3 + 2 each), the spindle (3); see
# `python -m benchmarks.forward --records`. It counts like so many runs of the machine at hand
# (`PromotionRule.record_runs`); a family without a record gets the usual one.
RECORDS: Mapping[str, float] = {
    "lag_dictionary": 1.09, "stack": 1.16, "distributed_lag": 1.38, "twin_residual": 1.45, "transfer_function": 1.46,
    "gru": 1.47, "lstm": 1.47, "tcn": 1.47, "gaussian_process": 1.53, "ridge": 1.54, "pcr_lbo": 1.56, "lssvm": 1.57,
    "pls": 1.58, "bp_linear": 1.60, "elastic_net": 1.60, "huber": 1.62, "svr": 1.65, "mlr": 1.65, "bp": 1.68,
    "gm_dl": 2.13, "hist_gradient_boosting": 2.15, "random_forest": 2.25, "gm_lssvm": 2.31, "twin": 2.45,
    "thermal_exponential": 2.62, "pcr": 2.65, "mean_curve": 3.75, "gm1n": 4.15, "zero": 6.00,
}  # fmt: skip
USUAL_RECORD = 1.6

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
