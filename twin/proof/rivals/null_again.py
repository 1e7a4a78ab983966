"""The structural null of another statistic: the same refined machines, noise and scales as the diagnosis draws."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from data.errors import InputError, WorkError
from twin.calibration.fit_problem import Array
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.rounds.null import SCALES, TWINS, Null
from twin.diagnosis.rounds.refined import refined
from twin.diagnosis.scoring.evidence import Evidence
from twin.diagnosis.scoring.finite import difference

SEED = 0  # as a diagnosis draws them
Gains = Callable[[Evidence, Sequence[Array], Sequence[int]], Array]  # of recordings by columns, (R, C)
Score = Callable[[Evidence, Sequence[Array]], Array]  # of recordings without a candidate, (R,)


def structural_misfits(fitted: Fitted) -> list[list[Array]]:
    """Of each refined machine what it shows beyond the fit, (n_b,) of every batch in units of the given noise."""
    base = fitted.problem.residuals(fitted.x, fitted.state.nuisance)
    out = []
    for k in range(TWINS):
        try:
            part = refined(fitted.part, fitted.problem.network, fitted.values, SEED + k)
            out.append(difference(fitted, part, base))
        except (InputError, WorkError):
            continue  # a draw that no machine has
    return out


def null_of(
    misfits: Sequence[Sequence[Array]], z: Array, evidence: Evidence, columns: Sequence[int], gains: Gains, score: Score
) -> Null:
    """`twin.diagnosis.rounds.null.structural_null` by `gains` of these columns and `score`; `z` (p,) of the fit."""
    rng = np.random.default_rng(SEED)
    shape = (len(misfits), len(SCALES))
    none = np.zeros((0, 0, 0))
    if not misfits:
        return Null(np.zeros(shape), np.zeros(shape), none, none)
    targets: list[list[Array]] = [[] for _ in evidence.batches]
    for rows in misfits:
        for drawn, b, misfit in zip(targets, evidence.batches, rows, strict=True):
            noise = rng.standard_normal(len(misfit))
            drawn += [b.of(scale * misfit + noise) for scale in SCALES]
    stacked = []
    for b, drawn in zip(evidence.batches, targets, strict=True):
        own = min(len(z), b.jacobian.shape[1])
        stacked.append(np.stack(drawn, axis=1) + (b.jacobian[:, :own] @ z[:own])[:, None])
    gain = gains(evidence, stacked, columns).max(axis=1, initial=0.0)
    return Null(gain.reshape(shape), score(evidence, stacked).reshape(shape), none, none)
