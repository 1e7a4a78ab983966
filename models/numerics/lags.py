"""Delayed and lagged inputs, batch by batch: the basis on which every lag family is fitted.

A response is a pair (delay in s, time constant in s): a first-order lag, then a delay; (0, 0) is the input itself.
Nothing passes the border of a batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design
from models.numerics.batches import padded, steps_s, unpadded

Response = tuple[float, float]


def behind(laid: Array, tau_s: float, step_s: Array, before: Array | float = 0.0) -> Array:
    """τ dv/dt + v = u along batches as `padded` lays them out, (K, n, …), exact for u held over the step before it.

    v is `before` (K, 1, …) in the first row, of one row alone too. step_s (K,). A time constant of 0 gives u.
    """
    from scipy.signal import lfilter  # takes long to load

    if tau_s == 0:
        return laid
    out = laid - before
    out[:, :1] = 0.0
    for step, which in _by_step(step_s):
        keep = float(np.exp(-step / tau_s))
        out[which] = lfilter([1.0 - keep], [1.0, -keep], out[which], axis=1)
    out += before
    return out


def lag_responses(
    design: Design, x: Array, responses: Sequence[Response], at_rest: bool | NDArray[np.bool_] = True
) -> Array:
    """Every response of every column of x (n, p) without holes, (n, m, p).

    Before a batch a column `at_rest` (p,) is 0, another one has its first value. A delay that is no multiple of the
    batch's step is interpolated. A column that is NaN throughout a batch stays so.
    """
    laid, step_s = padded(design, x), steps_s(design)
    before = laid[:, :1] * np.logical_not(at_rest)  # NaN stays NaN
    out = np.empty((len(x), len(responses), x.shape[1]))
    for i, (delay_s, tau_s) in enumerate(responses):
        out[:, i] = unpadded(design, _delayed(behind(laid, tau_s, step_s, before), delay_s, step_s, before))
    return out


def _delayed(laid: Array, delay_s: float, step_s: Array, before: Array) -> Array:
    """Batches (K, n, p) a delay later, `before` (K, 1, p) until then."""
    if delay_s == 0:
        return laid
    out = laid.copy()
    for step, which in _by_step(step_s):
        delay = delay_s / step
        whole = int(delay + 1e-9)
        part = delay - whole if delay - whole > 1e-6 else 0.0
        still = np.repeat(before[which], whole + 1, axis=1)
        earlier = np.concatenate([still, laid[which]], axis=1)[:, : laid.shape[1] + 1]
        out[which] = (1.0 - part) * earlier[:, 1:] + part * earlier[:, :-1]
    return out


def _by_step(step_s: Array) -> Iterator[tuple[float, NDArray[np.bool_]]]:
    """Every step and its batches; one of a single row has none."""
    for step in np.unique(step_s[np.isfinite(step_s)]):
        yield float(step), step_s == step


def with_columns(design: Design, x: Array) -> Design:
    """The same usable rows with other inputs, x (n, m), in one unit."""
    y_um = np.where(design.usable, design.y_um, np.nan)
    return replace(design, inputs=tuple(map(str, range(x.shape[1]))), x=x, y_um=y_um, input_units=(),
                   about_start=False, _columns=None, _parent=None)  # fmt: skip
