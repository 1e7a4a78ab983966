"""Training sets as pooled sums over blocks of rows, with leave-block-out scores from the sums alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Mask
from features.design import Moments

FLAT = 1e-12  # an input whose relative variation is below this counts as constant
AT_ONCE = 4_000_000  # numbers in a stack of covariances


@dataclass(frozen=True)
class Pool:
    """Centred sums of S sets of rows: count (S,), mean_x (S, p), mean_y (S,), xx (S, p, p), xy (S, p).

    xx and xy are of the inputs divided by `scale` (S, p), which is 1 where all inputs are in K. `loss` (S,) is
    how much the sums about the common origin exceed the centred ones: the digits that centring cost.
    """

    count: Array
    mean_x: Array
    mean_y: Array
    xx: Array
    xy: Array
    scale: Array
    loss: Array

    def correlation(self) -> tuple[Array, Array]:
        """xx of the inputs over their own spread (S, p, p), and that spread (S, p); a constant input is
        uncorrelated."""
        spread = np.sqrt(np.einsum("sjj->sj", self.xx))
        flat = spread == 0
        spread = np.where(flat, 1.0, spread)
        out = self.xx / (spread[:, :, None] * spread[:, None, :])
        np.einsum("sjj->sj", out)[flat] = 1.0
        return out, spread


CoefPath = Callable[
    [Pool], Array
]  # coefficients (S, p, G) per unit of the inputs for all settings on every set of a pool


def ridge_path(pool: Pool, penalties: Sequence[float] | Array) -> Array:
    """Coefficients (S, p, G) that solve (XX + k trace(XX)/p) β = Xy for every penalty k."""
    alpha = mean_diagonal(pool.xx)
    out = np.empty((*pool.xy.shape, len(penalties)))
    matrix = pool.xx.copy()
    diagonal = np.einsum("sjj->sj", matrix)
    own = diagonal.copy()
    for g, k in enumerate(penalties):
        diagonal[:] = own + k * alpha[:, None]
        out[:, :, g] = np.linalg.solve(matrix, pool.xy[:, :, None])[:, :, 0]
    return out


def mean_diagonal(xx: Array) -> Array:
    """trace(XX)/p (S,), the mean sum of squares of the inputs; 1 where none moves."""
    mean = np.einsum("sjj->s", xx) / xx.shape[1]
    return np.where(mean > 0, mean, 1.0)


@dataclass(frozen=True)
class Blocks:
    """Sums over B blocks of rows, each about its own mean, so that pooling them cancels nothing.

    Of moments about the start the means are 0 here and in every `Pool`: fits have no intercept.
    """

    count: Array
    mean_x: Array
    mean_y: Array
    xx: Array
    xy: Array
    yy: Array
    raw: Array  # (B, p) sums of squares about the moments' origin
    origin: Array  # (p,)

    @classmethod
    def of(cls, m: Moments) -> Blocks:
        n = np.maximum(m.count, 1.0)
        mean_x, mean_y = m.sum_x / n[:, None], m.sum_y / n
        if m.about_start:
            mean_x, mean_y = np.zeros_like(mean_x), np.zeros_like(mean_y)
        xx = m.xx - m.sum_x[:, :, None] * mean_x[:, None, :]
        xy = m.xy - m.sum_x * mean_y[:, None]
        raw = np.einsum("bjj->bj", m.xx)
        moves = np.einsum("bjj->bj", xx) > FLAT * raw
        xx *= moves[:, :, None] & moves[:, None, :]
        yy = np.maximum(m.yy - m.sum_y * mean_y, 0.0)
        return cls(m.count, mean_x, mean_y, xx, xy * moves, yy, raw, m.shift_x)

    def pool(self, masks: Mask, scaled: bool) -> Pool:
        """Sets of blocks, masks (S, B), each as one training set; `scaled` divides inputs by their std there."""
        sets, p = len(masks), self.mean_x.shape[1]
        take = masks.astype(float)
        weight = take * self.count
        count = weight.sum(axis=1)
        n = np.maximum(count, 1.0)
        mean_x, mean_y = weight @ self.mean_x / n[:, None], weight @ self.mean_y / n
        root = np.sqrt(weight)
        between = root[:, :, None] * (self.mean_x - mean_x[:, None, :])
        between_y = root * (self.mean_y - mean_y[:, None])
        across = between.transpose(0, 2, 1)
        xx = (take @ self.xx.reshape(len(self.xx), -1)).reshape(sets, p, p) + across @ between
        xy = take @ self.xy + (across @ between_y[:, :, None])[:, :, 0]
        raw = take @ self.raw
        square = np.einsum("sjj->sj", xx)
        moves = square > n[:, None] * (FLAT * (np.abs(self.origin) + np.sqrt(raw / n[:, None]))) ** 2
        if not moves.all():
            xx *= moves[:, :, None] & moves[:, None, :]
            xy *= moves
        safe = np.where(moves, square, 1.0)
        loss = np.where(moves, raw / safe, 1.0).max(axis=1, initial=1.0)
        scale = np.sqrt(np.where(moves, square, n[:, None]) / n[:, None]) if scaled else np.ones((sets, p))
        if scaled:
            xx, xy = xx / (scale[:, :, None] * scale[:, None, :]), xy / scale
        return Pool(count, mean_x, mean_y, xx, xy, scale, loss)

    def left_out_S_um(self, block: NDArray[np.int64], pool: Pool, which: NDArray[np.int64], coef: Array) -> Array:
        """S (V, G) in µm of left-out blocks (V,) under the models coef (S, p, G) fitted on pool[which]."""
        return self.S_um(block, pool.mean_x[which], pool.mean_y[which], coef[which])

    def S_um(self, block: NDArray[np.int64], at_x: Array, at_y: Array, beta: Array) -> Array:
        """S (V, G) in µm of blocks (V,) under slopes beta (V, p, G), by which at_x (V, p) has the error at_y (V,)."""
        square = np.einsum("vjg,vjg->vg", beta, self.xx[block] @ beta)
        cross = (self.xy[block][:, None, :] @ beta)[:, 0]
        away = (self.mean_x[block] - at_x)[:, None, :] @ beta
        bias = (self.mean_y[block] - at_y)[:, None] - away[:, 0]
        n = self.count[block][:, None]
        sse = self.yy[block][:, None] - 2.0 * cross + square + n * bias**2
        return np.sqrt(np.maximum(sse, 0.0) / np.maximum(n - 1.0, 1.0))


def left_out_mean_S_um(
    blocks: Blocks, masks: Mask, scaled: bool, path: CoefPath, place: NDArray[np.int64] | None = None
) -> Array:
    """For every training set, masks (F, B), the mean S over its blocks, each left out once, by setting; (F, G) in µm.

    `place`: as for `inner_sets`.
    """
    outer, left, sets, which = inner_sets(masks, place)
    parts = [
        (some, blocks.left_out_S_um(left[some], pool, at, coef))
        for some, at, pool, coef in fitted_paths(blocks, sets, which, scaled, path)
    ]
    S_um = np.concatenate([part for _, part in parts])[np.argsort(np.concatenate([some for some, _ in parts]))]
    border = np.searchsorted(outer, np.arange(len(masks)))
    total = np.add.reduceat(S_um, border, axis=0)
    return np.asarray(total / np.bincount(outer, minlength=len(masks))[:, None])


def fitted_paths(
    blocks: Blocks, sets: Mask, which: NDArray[np.int64], scaled: bool, path: CoefPath
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64], Pool, Array]]:
    """All settings on every one of the training sets (S, B), so many at a time as memory holds.

    Yields:
        places in `which` (V,) of the sets at hand, which of these each is, their pool, coefficients (S, p, G).
    """
    step = max(1, AT_ONCE // blocks.mean_x.shape[1] ** 2)
    for start in range(0, len(sets), step):
        pool = blocks.pool(sets[start : start + step], scaled)
        some = np.flatnonzero((which >= start) & (which < start + step))
        yield some, which[some] - start, pool, path(pool)


def inner_sets(
    masks: Mask, place: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64], Mask, NDArray[np.int64]]:
    """Every training set, masks (F, B), without each of its blocks in turn; V in all.

    With the blocks' `place` (B,) in time the set keeps only what is earlier than the block, at least two blocks.

    Returns:
        outer set (V,) and block left out (V,), the distinct inner sets, and which of these it is (V,).
    """
    outer, left = np.nonzero(masks)
    inner = masks[outer]
    inner[np.arange(len(left)), left] = False
    if place is not None:
        inner &= place < place[left][:, None]
        some = inner.sum(axis=1) >= 2
        outer, left, inner = outer[some], left[some], inner[some]
    packed = np.packbits(inner, axis=1)
    key = np.ascontiguousarray(packed).view(np.dtype((np.void, packed.shape[1])))[:, 0]
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return outer, left, inner[first], which
