"""Whether a probability that is told comes true as often as it says."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from twin.proof.scoring.intervals import clopper_pearson

BINS, DRAWS = 10, 1000
COLUMNS = ("low", "high", "n", "claimed", "right", "low90", "high90")


def reliability(outcomes: pd.DataFrame) -> tuple[pd.DataFrame, float]:
    """Bins of the first finding's probability against its being right, and the expected calibration error.

    Right: the mechanism of a true term, at its place or beside it. An answer without a finding tells no probability
    and is left out. Bins hold equal numbers of cases; the error is the mean over cases of the bins' |told − right|
    (Naeini, Cooper and Hauskrecht 2015), nan of no cases.
    """
    told, right = told_and_right(outcomes)
    rows = []
    for own in _bins(told):
        low90, high90 = clopper_pearson(int(right[own].sum()), len(own))
        rows.append((told[own].min(), told[own].max(), len(own), told[own].mean(), right[own].mean(), low90, high90))
    return pd.DataFrame(rows, columns=list(COLUMNS)), calibration_error(np.column_stack([told, right]))


def told_and_right(outcomes: pd.DataFrame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Probabilities (n,) and whether it was right (n,), 0 or 1, of cases with a finding."""
    rows = outcomes[outcomes["probability"].notna()]
    right = rows["first_right"].fillna(False).astype(bool) & rows["place_near"].fillna(False).astype(bool)
    return np.asarray(rows["probability"], float), np.asarray(right, float)


def calibration_error(pairs: NDArray[np.float64]) -> float:
    """Of pairs (n, 2) of what was told and whether it was right."""
    if not len(pairs):
        return float("nan")
    gaps = [len(own) * abs(float(np.mean(pairs[own, 0] - pairs[own, 1]))) for own in _bins(pairs[:, 0])]
    return float(np.sum(gaps) / len(pairs))


def error_by_chance(told: NDArray[np.float64], seed: int = 0) -> float:
    """The calibration error that these probabilities (n,) show in the mean where every one of them is exactly right.

    Ten bins of a dozen cases scatter about the truth: the error is never 0 (Bröcker and Smith 2007).
    """
    if not len(told):
        return float("nan")
    drawn = np.random.default_rng(seed).random((DRAWS, len(told))) < told
    return float(np.mean([calibration_error(np.column_stack([told, right])) for right in drawn]))


def _bins(told: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    return [own for own in np.array_split(np.argsort(told, kind="stable"), BINS) if len(own)]
