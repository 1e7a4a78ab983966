"""Inputs as they were a while ago, or behind a first-order lag: what distributed lags are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.signal import lfilter

from features.design import Design
from models.base import Array
from models.batchwise import bridged, steps_s

Response = tuple[float, float]  # delay in s, time constant in s


def lag_responses(design: Design, responses: Sequence[Response]) -> Array:
    """Every response of every input, (n, m, p): a first-order lag, then a delay; of 0 and 0 it is the input itself.

    Before a batch starts an input has its first value, which is 0 for a rise; a driver is at rest (0). A delay that is
    no multiple of the batch's step is interpolated. Holes are bridged by the last value; NaN throughout a batch that
    lacks the input wholly.
    """
    x, steps = bridged(design, design.x), steps_s(design)
    drives = np.array([name.partition("@")[0] in design.driver_names for name in design.inputs], bool)
    out = np.empty((len(x), len(responses), x.shape[1]))
    for k in range(design.n_batches):
        own = x[design.rows(k)]
        if np.isnan(own).all():
            out[design.rows(k)] = np.nan
            continue
        before = np.where(drives, 0.0, own[0])
        for i, (delay_s, tau_s) in enumerate(responses):
            out[design.rows(k), i] = _delayed(_lagged(own, before, tau_s / steps[k]), before, delay_s / steps[k])
    return out


def _lagged(x: Array, before: Array, tau: float) -> Array:
    """τ dv/dt + v = x (n, p) from v = `before` in the first row, exact for x held over each step; τ in steps."""
    if tau == 0 or len(x) < 2:
        return x
    keep = float(np.exp(-1.0 / tau))
    rest, _ = lfilter([1.0 - keep], [1.0, -keep], x[1:], axis=0, zi=keep * before[None])
    return np.vstack([before, rest])


def _delayed(x: Array, before: Array, delay: float) -> Array:
    """x (n, p) a delay (in steps) later, `before` until then."""
    if delay == 0 or len(x) < 2:
        return x
    whole = int(delay + 1e-9)
    part = max(delay - whole, 0.0) if delay - whole > 1e-6 else 0.0
    earlier = np.vstack([np.tile(before, (whole + 1, 1)), x])[: len(x) + 1]
    return (1.0 - part) * earlier[1:] + part * earlier[:-1]
