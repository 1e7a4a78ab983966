"""What several laws share: sizes and powers that the complex step can differentiate, and lengths of intervals."""

from __future__ import annotations

from typing import Any

import numpy as np

from twin.mechanisms.base import Array, View, real

ZERO_DEGC_K = 273.15


def size(x: Any) -> Array:
    """|x| by the sign of the real part, any shape."""
    return np.asarray(np.where(real(x) < 0, -x, x))


def power(x: Any, exponent: Any) -> Array:
    """|x| ** exponent for exponents above 0, exactly 0 where x is 0; the arguments broadcast."""
    rests = real(x) == 0
    return np.asarray(np.where(rests, 0.0, np.where(rests, 1.0, size(x)) ** exponent))


def steps_s(view: View) -> Array:
    """Length of the interval that follows each time, s, shape of `time_s`; the last is as long as the one before it."""
    if view.time_s.shape[-1] < 2:
        return np.full(view.time_s.shape, view.step_s)
    steps = np.diff(view.time_s, axis=-1)
    return np.concatenate([steps, steps[..., -1:]], axis=-1)
