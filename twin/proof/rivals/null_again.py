"""The structural null of another statistic: the same refined machines, noise and scales as the diagnosis draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from twin.calibration.fit_problem import Array
from twin.diagnosis.rounds.null import SCALES, Null, recordings
from twin.diagnosis.scoring.evidence import Evidence

Gains = Callable[[Evidence, Sequence[Array], Sequence[int]], Array]  # of recordings by columns, (R, C)
Score = Callable[[Evidence, Sequence[Array]], Array]  # of recordings without a candidate, (R,)


def null_of(
    misfits: Sequence[Sequence[Array]], evidence: Evidence, columns: Mapping[str, int], gains: Gains, score: Score
) -> Null:
    """`twin.diagnosis.rounds.null.structural_null` by `gains` of these columns, numbered by candidate, and `score`."""
    shape = (len(misfits), len(SCALES))
    none = np.zeros((0, 0, 0))
    if not misfits:
        return Null(np.zeros(shape), np.zeros(shape), none, none)
    drawn = recordings(misfits, evidence)
    gain = gains(evidence, drawn, list(columns.values()))
    largest, density = gain.max(axis=1, initial=0.0), score(evidence, drawn)
    return Null(
        largest.reshape(shape), density.reshape(shape), none, none, tuple(columns), gain.reshape(*shape, len(columns))
    )
