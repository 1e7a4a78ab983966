"""Batches predicted by a fit that has not seen them: parameters of the others, the batch's own start estimated.

The parameters are one Gauss–Newton step from the whole fit without the batch (its information taken away, Pregibon
1981); the batch's own unknowns (start, offsets) are estimated from it, within their priors; the simulation is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.linalg import cho_factor, cho_solve

from twin.calibration.descent import x_of, z_bounds
from twin.calibration.fit_problem import Array
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.scoring.whitened import whitened

RMS_COLUMNS = ("batch", "channel", "unit", "rows", "rms")


@dataclass(frozen=True)
class LeftOutRows:
    """Measured less predicted (n_b,) of every batch in the channels' units, and the rms by batch and channel."""

    error: list[Array]
    rms: pd.DataFrame


def left_out_rows(fitted: Fitted) -> LeftOutRows:
    """Every batch predicted by all others."""
    problem, state = fitted.problem, fitted.state
    weight = 1.0 / fitted.noise.factor**2
    blocks = list(problem.linearise(fitted.x, state.nuisance))
    rows = [
        whitened(b, v, state.z, problem.unknowns, (), weight, fitted.memory)
        for b, v in zip(blocks, state.nuisance, strict=True)
    ]
    own = [w.jacobian.T @ w.jacobian for w in rows]
    to = [w.jacobian.T @ w.target for w in rows]
    information, total = np.sum(own, axis=0) + np.eye(len(state.z)), np.sum(to, axis=0)
    low, high = z_bounds(problem.unknowns)
    spread = np.array([u.spread for u in problem.unknowns])
    errors = []
    table = []
    for k, (block, w) in enumerate(zip(blocks, rows, strict=True)):
        z = np.clip(cho_solve(cho_factor(information - own[k]), total - to[k]), low, high)
        moved = block.residual + block.nuisance @ state.nuisance[k] - block.jacobian @ (spread * (z - state.z))
        known, aim = (w.innovations((rows.T * w.scale).T) for rows in (block.nuisance, moved))
        normal = known.T @ known + np.eye(known.shape[1])
        nuisance: Array = np.asarray(np.linalg.solve(normal, known.T @ aim), float)
        one = problem.only([k])
        residual = one.residuals(x_of(problem.unknowns, z), [nuisance])[0]
        m = problem.measured[k]
        errors.append(residual * problem.noise[m.channel])
        for c in m.usable.tolist():
            at = m.channel == c
            rms = float(np.sqrt(np.mean(errors[-1][at] ** 2)))
            table.append((m.batch_id, problem.channels[c], problem.units[c], int(at.sum()), rms))
    return LeftOutRows(errors, pd.DataFrame(table, columns=list(RMS_COLUMNS)))
