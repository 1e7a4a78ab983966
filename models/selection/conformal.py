"""Bounds on the S of a run from runs that were left out: split conformal, scaled by run, adaptive over time.

The score of a left-out run is its S over a factor that is known before the run is measured. A bound is the weighted
quantile of the scores times the factor of the new run (locally weighted split conformal: Lei et al., JASA 113, 2018;
weights for runs that are not exchangeable: Barber et al., Annals of Statistics 51, 2023). The level of the quantile
follows the misses of the forward blocks (adaptive conformal inference: Gibbs & Candès, NeurIPS 2021).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from statistics import NormalDist
from typing import Any, NamedTuple, Self

import numpy as np
import pandas as pd

from data.arrays import Array

LEVEL = 0.90  # of later runs stay below the bound
LED_BY = ("forward", "leave-season-out", "leave-batch-out")  # nearest to the next season first
# How far a left-out run counts for a later one: a forward run is one, the others were predicted under other conditions.
_WEIGHTS = {"forward": 1.0, "leave-season-out": 0.5, "leave-speed-out": 0.5, "leave-batch-out": 0.5}
# Few runs have no 90 % quantile. A log-normal distribution counts as so many runs; its sd is that of ln S over the runs
# of one model (lathe 0.5, spindle 0.7, sample year 0.6).
_PRIOR_RUNS, _PRIOR_SD = 4.0, 0.6
_PRIOR_Z = np.array([NormalDist().inv_cdf((k + 0.5) / 20) for k in range(20)])
# Slopes of ln S with ln disagreement and ln(1 + distance) before any run is known, and the sd of what is believed.
_SLOPES, _SLOPE_SD = np.array([0.25, 0.25]), 0.15
_FLOOR = 0.05  # of the median S: a smaller disagreement of models carries no information
_LEAST_UM = 1e-6  # of S, far below any instrument: its logarithm is finite
_RATE, _MOST_LEVEL = 0.02, 0.98  # step of the level per run (Gibbs & Candès: 0.005 for long series), and its limit


class NextRun(NamedTuple):
    """Expected S of a run in the next season and the bound that covers it with 90 %, µm; `n_runs` under `protocol`."""

    S_um: float
    bound_um: float
    n_runs: int
    protocol: str


def expected_next(table: pd.DataFrame) -> NextRun:
    """The residual of a run of the next season, whatever its inputs: from the left-out runs (R,) of one cell.

    The expected S is the mean under the protocol nearest to the next season; the bound uses all of them.

    Args:
        table: protocol, fold, batch_id, S_um, as in `GridResult.scores`; other columns are not used.
    """
    known = table[np.isfinite(table["S_um"])]
    run = [p for p in (*LED_BY, *known["protocol"]) if (known["protocol"] == p).any()]
    if not run:
        return NextRun(float("nan"), float("nan"), 0, "")
    led = known[known["protocol"] == run[0]]
    bound = RunBound.of(known[["protocol", "fold", "batch_id", "S_um"]])
    return NextRun(float(led["S_um"].mean()), max(bound.bound_um, 0.0), len(led), run[0])


@dataclass(frozen=True)
class RunBound:
    """Expected S of a run and its 90 % bound, from what its inputs show.

    Both are those of an ordinary run times `factor`, `(d + floor)/(typical + floor)` to the power `slopes[0]` times
    `(1 + distance)` to the power `slopes[1]`, with the disagreement d of the peers in µm and the distance from the
    trained region in widths. The slopes are a ridge regression of ln S about a weak prior and never negative: a run
    that is farther out or less agreed upon is never expected to be better.

    expected_um, bound_um: of an ordinary run. typical_um, floor_um: of the disagreement. tested: the greatest distance
    of a left-out run. level: the quantile that the bound is, 0.9 or more. n_runs: how many runs were left out.
    usual_um: the disagreement above which a run is flagged, one in ten of the left-out runs with less than twice the
    expected S (conformal risk control of false flags: Angelopoulos et al., ICLR 2024).
    """

    expected_um: float
    bound_um: float
    slopes: tuple[float, float]
    typical_um: float
    floor_um: float
    tested: float
    level: float
    n_runs: int
    usual_um: float = math.inf  # of a model that an earlier program stored

    @classmethod
    def of(cls, table: pd.DataFrame) -> Self:
        """From left-out runs: protocol, fold, batch_id, S_um, and, where known, disagreement_um and distance.

        Forward folds are in order of time. Protocols without a weight are used only where there is no other.
        """
        table = table[np.isfinite(table["S_um"].to_numpy(float))]
        weighted = table[table["protocol"].isin(_WEIGHTS)]
        table = weighted if len(weighted) else table
        n = table["batch_id"].nunique()
        if not n:
            nan = float("nan")
            return cls(nan, nan, (0.0, 0.0), nan, nan, nan, LEVEL, 0)
        counts = table["protocol"].map(_WEIGHTS).fillna(1.0).to_numpy(float)
        weight = np.asarray(counts * (n / counts.sum()), float)  # a run that several protocols left out is one run
        S_um = np.maximum(table["S_um"].to_numpy(float), _LEAST_UM)
        disagreement_um, distance = (_column(table, c) for c in ("disagreement_um", "distance"))
        known = disagreement_um[np.isfinite(disagreement_um)]
        typical_um, floor_um = float(np.median(known)) if len(known) else 1.0, _FLOOR * float(np.median(S_um))
        seen = _visible(disagreement_um, distance, typical_um, floor_um)
        slopes = _slopes(seen, np.log(S_um), weight)
        score = np.log(S_um) - seen @ slopes
        level = _adapted(table, score, weight)
        values, mass = _with_prior(score, weight)
        expected_um = float(np.average(np.exp(values), weights=mass))
        bound_um = max(expected_um, float(np.exp(_quantile(values, mass, level))))
        fine = np.isfinite(disagreement_um) & (S_um <= 2.0 * expected_um)
        return cls(
            expected_um, bound_um, (float(slopes[0]), float(slopes[1])), typical_um, floor_um,
            float(np.nanmax(distance, initial=0.0)), level, n,
            _quantile(disagreement_um[fine], weight[fine], LEVEL) if fine.any() else 0.0,
        )  # fmt: skip

    @classmethod
    def of_cell(
        cls, left_out: pd.DataFrame, scores: pd.DataFrame, selector: str, family: str, n_tsp: int
    ) -> Self | None:
        """Of one cell, from the runs of `models.selection.trust.left_out_runs`, or where these are another cell's from
        `GridResult.scores`, which know neither disagreement nor distance; None where no table has it."""
        if len(left_out) and (own := left_out["cell"] == f"{selector}|{family}|{n_tsp}").any():
            return cls.of(left_out[own])
        own = (scores["selector"] == selector) & (scores["family"] == family) & (scores["n_tsp"] == n_tsp)
        return cls.of(scores[own]) if scores.loc[own, "S_um"].notna().any() else None

    def factor(self, disagreement_um: float, distance: float) -> float:
        """How many times an ordinary run's S; 1 where both are unknown (NaN)."""
        seen = _visible(np.array([disagreement_um]), np.array([distance]), self.typical_um, self.floor_um)
        return float(np.exp(seen @ np.array(self.slopes))[0])

    def as_plain(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> Self:
        """The inverse of `as_plain`; what other versions of the program kept besides is not read."""
        own = {f.name: plain[f.name] for f in fields(cls) if f.name in plain}
        return cls(**{**own, "slopes": (float(plain["slopes"][0]), float(plain["slopes"][1]))})


def _column(table: pd.DataFrame, name: str) -> Array:
    return table[name].to_numpy(float) if name in table else np.full(len(table), np.nan)


def _visible(disagreement_um: Array, distance: Array, typical_um: float, floor_um: float) -> Array:
    """ln of the two quantities (R, 2), 0 where unknown."""
    seen = np.column_stack([np.log((disagreement_um + floor_um) / (typical_um + floor_um)), np.log1p(distance)])
    return np.nan_to_num(seen, nan=0.0)


def _slopes(seen: Array, ln_S: Array, weight: Array) -> Array:
    """Slopes (2,) of ln S about the prior, with the spread of ln S about a machine's ordinary run as its noise."""
    x, y = (v - np.average(v, axis=0, weights=weight) for v in (seen, ln_S))
    noise = (_PRIOR_SD / _SLOPE_SD) ** 2
    moved = np.linalg.solve((x.T * weight) @ x + noise * np.eye(2), (x.T * weight) @ (y - x @ _SLOPES))
    return np.asarray(np.maximum(_SLOPES + moved, 0.0))


def _with_prior(score: Array, weight: Array) -> tuple[Array, Array]:
    """The scores with those of the prior about their median, and all weights."""
    prior = _quantile(score, weight, 0.5) + _PRIOR_SD * _PRIOR_Z
    return np.append(score, prior), np.append(weight, np.full(len(prior), _PRIOR_RUNS / len(prior)))


def _quantile(values: Array, weight: Array, level: float) -> float:
    return float(np.quantile(values, level, weights=weight, method="inverted_cdf"))


def _adapted(table: pd.DataFrame, score: Array, weight: Array) -> float:
    """The level after the forward blocks, each bounded by what was known before it."""
    level, later = LEVEL, (table["protocol"] == "forward").to_numpy()
    known = ~later
    for fold in dict.fromkeys(table["fold"][later]):
        own = later & (table["fold"] == fold).to_numpy()
        if known.any():
            bound = _quantile(*_with_prior(score[known], weight[known]), level)
            misses = float((score[own] > bound).sum())
            level = float(np.clip(level + _RATE * (misses - (1 - LEVEL) * own.sum()), LEVEL, _MOST_LEVEL))
        known |= own
    return level
