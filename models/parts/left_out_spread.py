"""How far a linear model lies from batches that it has not seen: a standard deviation from left-out residuals."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from models.metrics import SIDE_OF_90
from models.parts.kernel_expansion import unit_scale
from models.parts.pooled_sums import AT_ONCE, Blocks, Mask, Pool, inner_sets

Array = NDArray[np.float64]
_ENOUGH_BATCHES = 3
_MOST_ROWS = 120  # of a batch that residuals are taken at
_LEAST_SHARE = 0.01  # of the mean square residual, that a keeps: no recorded value is free of noise


def mean_square(x: Array, design: Design) -> Array:
    """Mean over the inputs of their square (n,), each over the scale of its unit (10 K, 1000 rpm, …)."""
    return np.asarray(((x / unit_scale(design)) ** 2).mean(axis=1))


def left_out_spread(
    design: Design, square: Array, masks: Mask, scaled: bool, path: Callable[[Pool], Array], chosen: NDArray[np.int64]
) -> tuple[Array, Array]:
    """(a, b) of variance = a + b · square for every training set, masks (F, K); NaN below three batches.

    Every batch of a set is predicted by the set's own setting `chosen` (F,) of `path`, learned without that batch.
    a > 0 and b ≥ 0 are least squares of the squared residuals, then made larger until nine tenths of them lie inside
    the 90 % interval and their mean square is as stated. A batch that goes astray does so in proportion to its rises
    (random slopes: Laird and Ware 1982); a stands for noise and for the zero of a batch, which has noise too.

    Args:
        square: what the variance grows with, on every row of the design, (n,).
    """
    a, b = np.full(len(masks), np.nan), np.full(len(masks), np.nan)
    many = np.flatnonzero(masks.sum(axis=1) >= _ENOUGH_BATCHES)
    if not len(many):
        return a, b
    error = _left_out_um(design, masks[many], scaled, path, chosen[many])
    for f, column in zip(many, error.T, strict=True):
        judged = np.isfinite(column)
        a[f], b[f] = _fitted(column[judged] ** 2, square[judged])
    return a, b


def _left_out_um(
    design: Design, masks: Mask, scaled: bool, path: Callable[[Pool], Array], chosen: NDArray[np.int64]
) -> Array:
    """Residuals (n, F) of each set's batches, each left out; NaN on other rows."""
    moments = design.moments
    blocks = Blocks.of(moments)
    outer, left, sets, which = inner_sets(masks)
    coef, constant = np.empty((len(which), len(design.inputs))), np.empty(len(which))
    step = max(1, AT_ONCE // len(design.inputs) ** 2)
    for start in range(0, len(sets), step):
        pool = blocks.pool(sets[start : start + step], scaled)
        here = np.flatnonzero((which >= start) & (which < start + step))
        at = which[here] - start
        coef[here] = path(pool)[at, :, chosen[outer[here]]]
        mean_x, mean_y = pool.mean_x[at] + moments.shift_x, pool.mean_y[at] + moments.shift_y
        constant[here] = mean_y - np.einsum("vj,vj->v", mean_x, coef[here])
    out = np.full((len(design.y_um), len(masks)), np.nan)
    for k in range(design.n_batches):
        here = np.flatnonzero(left == k)
        rows = np.flatnonzero(design.usable[design.rows(k)]) + design.offsets[k]
        rows = rows[:: -(-len(rows) // _MOST_ROWS) or 1]  # neighbours tell the same, and a fold must not cost rows
        out[rows[:, None], outer[here]] = design.y_um[rows, None] - design.x[rows] @ coef[here].T - constant[here]
    return out


def _fitted(squared: Array, grows: Array) -> tuple[float, float]:
    """Least squares a + b · grows, b ≥ 0 and a above its least share, in the size that holds nine tenths of them."""
    n, q, qq = float(len(squared)), grows.sum(), grows @ grows
    s, sq = squared.sum(), grows @ squared
    determinant = n * qq - q * q
    a, b = ((qq * s - q * sq) / determinant, (n * sq - q * s) / determinant) if determinant > 0 else (s / n, 0.0)
    least = _LEAST_SHARE * s / n
    if b <= 0:
        a, b = s / n, 0.0
    elif a < least:
        a, b = least, max(sq - least * q, 0.0) / qq
    if s == 0:
        return 0.0, 0.0
    with np.errstate(over="ignore"):  # residuals of rounding alone
        ratio = squared / (a + b * grows)
    size = max(float(ratio.mean()), float(np.quantile(ratio, 0.9)) / SIDE_OF_90**2)
    return float(a * size), float(b * size)
