"""Mean temperatures of intervals, exactly: what a straight line between the borders gets wrong on average."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.solved import Solved

Array = NDArray[np.float64]

_SLOW = 0.1  # rate * dt below which the difference of the exact mean would cancel


def bulge_K(solved: Solved, cells_degC: Array) -> Array:
    """Mean over each interval less the mean of its two borders, (B, M, N), from all borders (B, M + 1, N).

    Exact for one parameter set: a mode's mean is ``(mean heat - change / dt) / rate``, and where it hardly decays the
    trapezoid corrected by the end slopes (Euler and Maclaurin), right to ``(rate dt)^4 / 720``.
    """
    balance, modes = solved.balance, solved.response.modes
    terms = list(balance.known)
    if solved.coupled is not None:
        into = np.stack([s.direction for s in solved.sources], axis=1)
        terms.append((np.repeat(into[:, None], balance.regimes.count, axis=1), solved.coupled.series_W))
    out = np.zeros((*balance.inputs.valid.shape, balance.network.n_cells))
    for r in range(balance.regimes.count):
        here = (balance.regimes.of == r) & balance.inputs.valid
        dt_s = balance.inputs.dt_s[here][:, None]
        rate, shape, inverse = modes.rate_per_s[0, r], modes.shape[0, r], modes.inverse[0, r]
        before, after = cells_degC[:, :-1][here] @ inverse.T, cells_degC[:, 1:][here] @ inverse.T
        heat = sum(np.einsum("jie,jn->ien", series[0][:, here], d[0, r] @ shape) for d, series in terms)
        slope_before, slope_after = (np.asarray(heat)[:, e] - rate * z for e, z in ((0, before), (1, after)))
        slow = rate * dt_s < _SLOW
        change = (after - before) / dt_s
        mean = (np.asarray(heat).mean(axis=1) - change) / np.where(rate > 0, rate, 1.0)
        bulge = np.where(slow, dt_s / 12.0 * (slope_before - slope_after), mean - (before + after) / 2.0)
        out[here] = bulge @ shape.T
    return out
