"""Every goal with the measured value, its 90 % interval and whether it is met: over all cases and by plant."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from thermodrift_exam.proof.scoring.goals import GOALS, Goal, Wanted, bootstrap, clopper_pearson, mean, of_groups
from thermodrift_exam.proof.spec import UNSEEN, is_unseen

BINS, DRAWS = 10, 1000
RELIABILITY_COLUMNS = ("low", "high", "n", "claimed", "right", "low90", "high90")


def reliability(outcomes: pd.DataFrame) -> tuple[pd.DataFrame, float]:
    """Bins of the probability of the first finding against the share of right ones, and the expected calibration error.

    Right: the mechanism of a true term, at its place or adjacent. An answer without a finding states no probability
    and is left out. Bins hold equal numbers of cases; the error is the mean over cases of the bins' |stated − right|
    (Naeini, Cooper and Hauskrecht 2015), nan of no cases.
    """
    stated, right = stated_and_right(outcomes)
    rows = []
    for own in _bins(stated):
        low90, high90 = clopper_pearson(int(right[own].sum()), len(own))
        rows.append(
            (stated[own].min(), stated[own].max(), len(own), stated[own].mean(), right[own].mean(), low90, high90)
        )
    return pd.DataFrame(rows, columns=list(RELIABILITY_COLUMNS)), calibration_error(np.column_stack([stated, right]))


def stated_and_right(outcomes: pd.DataFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Probabilities (n,) and whether it was right (n,), 0 or 1, of cases with a finding."""
    rows = outcomes[outcomes["probability"].notna()]
    right = rows["first_right"].fillna(False).astype(bool) & rows["place_near"].fillna(False).astype(bool)
    return np.asarray(rows["probability"], float), np.asarray(right, float)


def calibration_error(pairs: NDArray[np.float64]) -> float:
    """Of pairs (n, 2): stated probability, and 1 if right, else 0."""
    if not len(pairs):
        return float("nan")
    gaps = [len(own) * abs(float(np.mean(pairs[own, 0] - pairs[own, 1]))) for own in _bins(pairs[:, 0])]
    return float(np.sum(gaps) / len(pairs))


def error_by_chance(stated: NDArray[np.float64], seed: int = 0) -> float:
    """Expected value of the calibration error of these probabilities (n,) if they are perfectly calibrated.

    Finite bins scatter about the truth, so that the error is above 0 (Bröcker and Smith 2007).
    """
    if not len(stated):
        return float("nan")
    drawn = np.random.default_rng(seed).random((DRAWS, len(stated))) < stated
    return float(np.mean([calibration_error(np.column_stack([stated, right])) for right in drawn]))


def _bins(stated: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    return [own for own in np.array_split(np.argsort(stated, kind="stable"), BINS) if len(own)]


GOAL_COLUMNS: Mapping[str, str] = {
    "measure": "string", "goal": "string", "wanted": "Float64", "better": "string", "value": "Float64",
    "low90": "Float64", "high90": "Float64", "n": "Int64", "met": "boolean", "informed": "Float64",
    "informed_n": "Int64", "plant": "string",
}  # fmt: skip
CALIBRATION = Wanted("probabilities: expected calibration error", 0.05, "lower", unit="")
LEAD = Wanted("right answers: lead over the best baseline", 0.15, "higher")  # in share of right answers
WANTED: tuple[Wanted, ...] = (*GOALS, CALIBRATION, LEAD)


def goal_table(outcomes: pd.DataFrame, terms: pd.DataFrame, compared: pd.DataFrame | None = None) -> pd.DataFrame:
    """Columns `GOAL_COLUMNS`, plant "all" first, then "unseen", kinds of machines that the diagnosis was not developed
    on, if there are any, then every plant. Shares with exact intervals, the rest by a bootstrap over cases.
    `informed` is the value of the true model (`goals.Goal`).

    `compared` (`thermodrift_rivals.compared`) adds the lead over the best baseline, for all cases together.
    """
    rows: list[dict[str, Any]] = []
    there = sorted(outcomes["plant"].dropna().unique())
    groups = {"all": there, UNSEEN: [p for p in there if is_unseen(p)], **{p: [p] for p in there}}
    for plant, members in groups.items():
        if plant == UNSEEN and not members:
            continue
        own = outcomes if plant == "all" else outcomes[outcomes["plant"].isin(members)]
        parts = terms if plant == "all" else terms[terms["plant"].isin(members)]
        rows += [{**row, "plant": plant} for row in _measured(own, parts)]
        if plant == "all" and compared is not None:
            rows.append({**_lead(compared), "plant": plant})
    return pd.DataFrame(rows, columns=list(GOAL_COLUMNS), dtype=object).astype(dict(GOAL_COLUMNS))


def _measured(outcomes: pd.DataFrame, terms: pd.DataFrame) -> Iterator[dict[str, Any]]:
    for goal in GOALS:
        informed = goal.informed(outcomes, terms) if goal.informed is not None else pd.Series(dtype=float)
        statistic = goal.statistic or mean
        reached = statistic(informed.to_numpy(float)) if len(informed) else None
        yield _row(goal, goal.of(outcomes, terms)) | {"informed": reached, "informed_n": len(informed)}
    pairs = np.column_stack(stated_and_right(outcomes))
    low, high = (
        of_groups(list(pairs[:, None]), lambda g: calibration_error(np.vstack(g))) if len(pairs) else (None,) * 2
    )
    row = _row_of(CALIBRATION, calibration_error(pairs) if len(pairs) else None, low, high, len(pairs))
    yield row | {"informed": error_by_chance(pairs[:, 0]) if len(pairs) else None, "informed_n": len(pairs)}


def _row(goal: Goal, values: pd.Series) -> dict[str, Any]:
    n = len(values)
    if n == 0:
        return _row_of(goal, None, None, None, 0)
    if goal.statistic is None:
        right = int(values.astype(bool).sum())
        return _row_of(goal, right / n, *clopper_pearson(right, n), n)
    return _row_of(goal, goal.statistic(values.to_numpy(float)), *bootstrap(values, goal.statistic), n)


def _lead(compared: pd.DataFrame) -> dict[str, Any]:
    """Over the baseline with the most right answers."""
    baselines = compared[(compared["group"] == "baseline") & compared["lead"].notna()]
    if baselines.empty:
        return _row_of(LEAD, None, None, None, 0)
    best = baselines.sort_values(["lead", "method"]).iloc[0]
    lead, low, high = (float(best[c]) for c in ("lead", "lead_low90", "lead_high90"))
    return _row_of(LEAD, lead, low, high, int(best["n"]))


def _row_of(wanted: Wanted, value: float | None, low: float | None, high: float | None, n: int) -> dict[str, Any]:
    return {
        "measure": wanted.measure,
        "goal": wanted.label,
        "wanted": wanted.wanted,
        "better": wanted.better,
        "value": value,
        "low90": low,
        "high90": high,
        "n": n,
        "met": None if value is None else wanted.met(value),
    }
