"""The structural null of another statistic: the same refined machines, noise and scales as the diagnosis draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

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
    misfits: Sequence[Sequence[Array]], evidence: Evidence, columns: Mapping[str, int], gains: Gains, score: Score
) -> Null:
    """`twin.diagnosis.rounds.null.structural_null` by `gains` of these columns, numbered by candidate, and `score`."""
    rng = np.random.default_rng(SEED)
    shape = (len(misfits), len(SCALES))
    none = np.zeros((0, 0, 0))
    if not misfits:
        return Null(np.zeros(shape), np.zeros(shape), none, none)
    targets: list[list[Array]] = [[] for _ in evidence.batches]
    for rows in misfits:
        z = rng.standard_normal(evidence.batches[0].jacobian.shape[1])
        for drawn, b, misfit in zip(targets, evidence.batches, rows, strict=True):
            plain, noise = b.jacobian @ z, rng.standard_normal(len(misfit))
            drawn += [plain + b.of(scale * misfit + noise) for scale in SCALES]
    stacked = [np.stack(drawn, axis=1) for drawn in targets]
    gain = gains(evidence, stacked, list(columns.values()))
    largest, density = gain.max(axis=1, initial=0.0), score(evidence, stacked)
    return Null(
        largest.reshape(shape), density.reshape(shape), none, none, tuple(columns), gain.reshape(*shape, len(columns))
    )
