"""Grey system theory: relational degrees of two curves, and least squares of the grey model GM(1,N).

The relational degree compares distances row by row; over several batches it uses the stacked rows with common scaling.
The absolute, relative and synthetic degrees compare areas over time and are defined within one batch; for several
batches use the mean over the batches.

Sources: J. L. Deng (1989), Introduction to grey system theory, J. Grey System 1, 1–24 (relational degree);
S. Liu and Y. Lin (2006), Grey Information, ch. 3 (absolute, relative and synthetic degree).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from features.rises import hold_last

START_SHIFT = 100.0  # rises and errors start at 0; the relative degree divides by the start


def relational_degree(x: Array, y: Array, rho: float = 0.5, scaling: Literal["interval", "mean"] = "interval") -> Array:
    """Deng's degree of every sequence x (n, p) with y (n,), each in 0..1, shape (p,).

    `interval` scales a sequence by its smallest and largest value to 0..1, `mean` divides it by its mean; never
    by the first value, which is 0 for a rise. A sequence that runs against y is mirrored (1 − x, 2 − x).
    The smallest and largest distance are taken over all sequences and rows. The degree of a constant
    sequence is 0, and it does not enter those distances.

    Raises:
        InputError: shapes that do not match, values that are not finite, or a mean of 0 under `mean`.
    """
    if x.ndim != 2 or y.shape != (len(x),) or len(x) == 0:
        raise InputError(f"grey relational degree: got x {x.shape} and y {y.shape}; expected (n, p) and (n,), n > 0")
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        row = int(np.argmin(np.isfinite(x).all(axis=1) & np.isfinite(y)))
        raise InputError(f"grey relational degree: row {row} is not finite; leave such rows out")
    out = np.zeros(x.shape[1])
    low, high = x.min(axis=0), x.max(axis=0)
    varies = high > low
    if not varies.any():
        return out
    if not varies.all():
        x, low, high = x[:, varies], low[varies], high[varies]
    y_low, y_high = float(y.min()), float(y.max())
    with_y = (y - y.mean()) @ x
    if scaling == "interval":
        slope = 1.0 / (high - low)
        offset, mirror = -low * slope, 1.0
        y_scaled = (y - y_low) / (y_high - y_low) if y_high > y_low else np.zeros_like(y)
    else:
        mean, y_mean = x.mean(axis=0), float(y.mean())
        _mean_not_zero(mean, np.maximum(-low, high), "x")
        _mean_not_zero(np.array([y_mean]), np.array([max(-y_low, y_high)]), "y")
        slope, offset, mirror = 1.0 / mean, np.zeros(len(mean)), 2.0
        y_scaled = y / y_mean
        with_y = with_y * np.sign(mean) * np.sign(y_mean)
    against = with_y < 0
    slope, offset = np.where(against, -slope, slope), np.where(against, mirror - offset, offset)
    distance = np.abs(x * slope + (offset - y_scaled[:, None]))
    largest = rho * float(distance.max())
    out[varies] = ((float(distance.min()) + largest) / (distance + largest)).mean(axis=0) if largest > 0 else 1.0
    return out


def absolute_degree(x: Array, y: Array) -> Array:
    """ε = (1+|s0|+|si|) / (1+|s0|+|si|+|si−s0|) of every sequence x (n, p) with y (n,) of one batch, shape (p,).

    s is the area below the curve measured from its own start: Σ_{k=2}^{n−1} x⁰(k) + x⁰(n)/2. Curves are taken in the
    unit they come in (µm with µm); NaN where a value is not finite.
    """
    return _from_areas(_area(x), float(_area(y)))


def relative_degree(x: Array, y: Array, shift: float = START_SHIFT) -> Array:
    """The same on x/x(1): shapes (n, p) and (n,) of one batch, result (p,).

    Rises and errors start at 0, so every curve is first shifted by `shift` (100, in its unit). NaN for a curve that
    starts at exactly −shift.
    """
    start, y_start = x[0] + shift, float(y[0]) + shift
    start = np.where(start == 0, np.nan, start)
    return _from_areas(_area(x) / start, float(_area(y)) / y_start if y_start else np.nan)


def synthetic_degree(a: Array, b: Array, theta: float = 0.5, shift: float = START_SHIFT) -> Array:
    """θ · absolute + (1−θ) · relative degree of a (n,) with b (n,) or many curves b (n, p), all of one batch.

    In 0..1, 1 = equal areas; a float for one curve, (p,) for many; NaN for values not finite.

    Raises:
        InputError: different lengths or no rows.
    """
    if a.ndim != 1 or b.ndim not in (1, 2) or len(a) != len(b) or len(a) == 0:
        raise InputError(f"grey synthetic degree: got shapes {a.shape} and {b.shape}; expected (n,) and (n,) or (n, p)")
    x = b if b.ndim == 2 else b[:, None]
    degree = theta * absolute_degree(x, a) + (1.0 - theta) * relative_degree(x, a, shift)
    return degree if b.ndim == 2 else degree[0]


def _area(x: Array) -> Array:
    """s along the first axis; (n, p) gives (p,), (n,) a scalar array."""
    with np.errstate(invalid="ignore"):
        return np.asarray(x.sum(axis=0) - len(x) * x[0] - 0.5 * (x[-1] - x[0]))


def _from_areas(s: Array, s0: float) -> Array:
    with np.errstate(invalid="ignore"):
        size = 1.0 + np.abs(s) + abs(s0)
        return np.asarray(size / (size + np.abs(s - s0)))


def _mean_not_zero(mean: Array, size: Array, name: str) -> None:
    if (np.abs(mean) <= 1e-9 * size).any():
        column = int(np.argmax(np.abs(mean) <= 1e-9 * size))
        where = f"column {column} of x" if name == "x" else "y"
        raise InputError(f"grey relational degree: the mean of {where} is 0, so it cannot scale; use interval scaling")


_RCOND = 1e-4  # sums of sensors of 0.1 K: directions weaker than this are rounding, and wreck other batches


@dataclass(frozen=True)
class GreyFit:
    """Development coefficient a per row, driving coefficients b (p,) in µm per K and row.

    `size` (p,) is the root of the sum of squares of every cumulated input, so that |b| · size compares the inputs
    whatever their units; `condition` is that of the columns, each scaled to unit size.
    """

    a: float
    b: Array
    size: Array
    condition: float


def equations(design: Design, k: int, recent_rows: int | None = None) -> Array:
    """Rows [−z, x_i¹ | x1⁰] of one batch from its second row on, (m, p + 2), usable rows only.

    `recent_rows`: of its last so many usable rows alone, and the sums begin with the first of them. The sums bridge
    holes by the last input and by a straight line in the error.
    """
    rows = design.rows(k)
    usable, y_um = design.usable[rows], design.y_um[rows]
    if usable.sum() < 2:
        return np.empty((0, len(design.inputs) + 2))
    n = np.arange(len(y_um))
    known = np.isfinite(y_um)
    y_um = np.interp(n, n[known], y_um[known])
    x = np.column_stack([hold_last(column) for column in design.x[rows].T]) if design.inputs else np.empty((len(n), 0))
    first = 0 if recent_rows is None else int(np.flatnonzero(usable)[-recent_rows:][0])
    usable, y_um, x = usable[first:], y_um[first:], x[first:]
    cumulated = np.cumsum(y_um)
    z = (cumulated[1:] + cumulated[:-1]) / 2.0
    return np.column_stack([-z, np.cumsum(x, axis=0)[1:], y_um[1:]])[usable[1:]]


def least_squares(rows: Array, a: float | None = None) -> GreyFit:
    """(a, b) from equations (m, p + 2) or their R factor, by a truncated SVD of the columns scaled to unit size.

    Directions below 1e-4 of the strongest are dropped. `a` given: b alone is fitted; the condition stays that of all.
    """
    size = np.linalg.norm(rows[:, :-1], axis=0)
    size[size == 0] = 1.0
    left, right = rows[:, :-1] / size, rows[:, -1]
    solution, _, _, singular = np.linalg.lstsq(left, right, rcond=_RCOND)
    if a is not None:
        solution = np.concatenate([[0.0], np.linalg.lstsq(left[:, 1:], right - a * rows[:, 0], rcond=_RCOND)[0]])
    least = singular[singular > 0]
    condition = float(singular[0] / least[-1]) if len(least) else float("inf")
    b = solution[1:] / size[1:]
    return GreyFit(float(solution[0] / size[0]) if a is None else a, b, size[1:], condition)
