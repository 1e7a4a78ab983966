"""Mean temperatures of intervals, exactly: what a straight line between the borders gets wrong on average."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.simulation.coupling import outlets
from twin.simulation.solved import Solved

Array = NDArray[np.float64]

_SLOW = 0.1  # rate * dt below which the difference of the exact mean would cancel


def bulge_K(solved: Solved, cells_degC: Array) -> Array:
    """Mean over each interval less the mean of its two borders, (P, B, M, N), from all borders (P, B, M + 1, N).

    A mode's mean is exactly ``(mean heat - change / dt) / rate``; where it hardly decays, the trapezoid corrected by
    the end slopes (Euler and Maclaurin) is right to ``(rate dt)^4 / 720``.
    """
    balance, modes = solved.balance, solved.response.modes
    terms = list(balance.known)
    if solved.coupled is not None:
        terms.append((outlets(balance, solved.sources), solved.coupled.series_W))
    out = np.zeros((*cells_degC.shape[:2], *balance.inputs.dt_s.shape[1:], balance.network.n_cells))
    for r in range(balance.regimes.count):
        here = (balance.regimes.of == r) & balance.inputs.valid
        dt_s = balance.inputs.dt_s[here][:, None]
        rate, shape = modes.rate_per_s[:, None, r], modes.shape[:, r]
        inverse = np.swapaxes(modes.inverse[:, r], -1, -2)
        before, after = cells_degC[:, :, :-1][:, here] @ inverse, cells_degC[:, :, 1:][:, here] @ inverse
        heat = np.zeros((2, *before.shape))
        for directions, series in terms:
            heat += np.moveaxis(series[:, :, here], (1, 3), (3, 0)) @ (directions[:, r] @ shape)
        change = (after - before) / dt_s
        mean = (heat.mean(axis=0) - change) / np.where(rate > 0, rate, 1.0)
        slopes = heat[0] - rate * before - (heat[1] - rate * after)
        bulge = np.where(rate * dt_s < _SLOW, dt_s / 12.0 * slopes, mean - (before + after) / 2.0)
        out[:, here] = bulge @ np.swapaxes(shape, -1, -2)
    return out
