"""Leave-batch-out error of least squares on subsets of inputs, from per-batch sums alone.

Every block of a training set is left out once. For it two matrices over [target, inputs] are kept: `learned`, the
centred products of the other blocks, and `left`, the products of the left-out block about the others' mean. To take
input j into the model, the part along j, as estimated on the other blocks, is eliminated from every remaining column of
both matrices (one step of Gaussian elimination). The target's diagonal element of `left` then is the sum of squared
errors that least squares on the taken inputs makes on the left-out block: no system is solved, no row is read.

Source: G. Furnival and R. Wilson (1974), Regressions by leaps and bounds, Technometrics 16, 499–511, for the
elimination through all subsets; the left-out matrix is an addition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design, Moments
from features.selectors.statistics import DIGITS

_FEWEST_BATCHES = 3


@dataclass(frozen=True)
class Blocks:
    """Sums over B blocks of rows z = [target, inputs]: count (B,), sum_z (B, p + 1), zz (B, p + 1, p + 1)."""

    count: Array
    sum_z: Array
    zz: Array

    @classmethod
    def of(cls, design: Design, train: Sequence[int], columns: NDArray[np.int64]) -> Blocks:
        """The training batches with usable rows; of fewer than 3 batches the contiguous quarters.

        `columns` names the inputs that take part. Blocks come in an order of their own (by the energy of
        their error, then of their inputs), so that what is drawn from them does not depend on how batches are listed.
        """
        batches = np.asarray(sorted(train), int)
        m = design.moments
        if np.count_nonzero(m.count[batches]) < _FEWEST_BATCHES:
            m, batches = design.quarters, (4 * batches[:, None] + np.arange(4)).ravel()
        own = cls.of_moments(m, batches[m.count[batches] > 0], columns)
        energy = np.einsum("bjj->bj", own.zz) - own.sum_z**2 / own.count[:, None]
        order = np.lexsort((np.log(np.maximum(energy[:, 1:], 1e-300)).sum(axis=1), energy[:, 0]))
        return cls(own.count[order], own.sum_z[order], own.zz[order])

    @classmethod
    def of_moments(cls, m: Moments, blocks: NDArray[np.int64], columns: NDArray[np.int64]) -> Blocks:
        """Blocks (b,) of a design's moments, in the order given, of its `columns` (p,)."""
        sum_z = np.column_stack([m.sum_y[blocks], m.sum_x[np.ix_(blocks, columns)]])
        zz = np.empty((len(blocks), len(columns) + 1, len(columns) + 1))
        zz[:, 0, 0] = m.yy[blocks]
        zz[:, 0, 1:] = zz[:, 1:, 0] = m.xy[np.ix_(blocks, columns)]
        zz[:, 1:, 1:] = m.xx[np.ix_(blocks, columns, columns)]
        return cls(m.count[blocks], sum_z, zz)

    def pooled(self, sets: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Of S sets of blocks (S, B): rows (S,), means (S, p + 1), centred products (S, p + 1, p + 1)."""
        take = sets.astype(float)
        count = np.maximum(take @ self.count, 1.0)
        mean = take @ self.sum_z / count[:, None]
        size = self.zz.shape[1]
        zz = (take @ self.zz.reshape(len(self.zz), -1)).reshape(-1, size, size)
        return count, mean, zz - count[:, None, None] * mean[:, :, None] * mean[:, None, :]


Sets = NDArray[np.bool_]
_TAKEN = 1e-10  # share of an input's variance left by the taken ones, below which it adds nothing


@dataclass(frozen=True)
class LeftOut:
    """Stacks of `learned` and `left`, both (S, B, p + 1, p + 1): S models that have taken some inputs, B blocks.

    Inputs are scaled to unit size in `learned`, the target to unit spread over all blocks. `rows` (B,) is n − 1.
    """

    learned: Array
    left: Array
    rows: Array

    @classmethod
    def of(cls, design: Design, train: Sequence[int], columns: NDArray[np.int64]) -> LeftOut:
        """One model that has taken nothing."""
        return cls.of_blocks(Blocks.of(design, train, columns))

    @classmethod
    def of_blocks(cls, blocks: Blocks) -> LeftOut:
        """The same from sums over blocks."""
        n_blocks = len(blocks.count)
        _, mean, learned = blocks.pooled(~np.eye(n_blocks, dtype=bool))
        crossed = mean[:, :, None] * (blocks.sum_z - 0.5 * blocks.count[:, None] * mean)[:, None, :]
        left = blocks.zz - crossed - np.swapaxes(crossed, 1, 2)
        size = np.sqrt(np.maximum(np.einsum("bjj->bj", learned), 0.0))
        count, _, whole = blocks.pooled(np.ones((1, n_blocks), bool))
        size[:, 0] = np.sqrt(max(float(whole[0, 0, 0]), 0.0) / count[0])
        size[size == 0.0] = 1.0
        scale = size[:, :, None] * size[:, None, :]
        return cls((learned / scale)[None], (left / scale)[None], np.maximum(blocks.count - 1.0, 1.0))

    def error(self) -> Array:
        """Mean over the blocks of S = sqrt(Σ e² / (n − 1)), over the target's spread, of every model; (S,)."""
        return self._mean_S(self.left[..., 0, 0])

    def error_with(self) -> Array:
        """The same after taking one input more, for each input (S, p); a taken one changes nothing."""
        gain = _share(self.learned[..., 0, 1:], np.einsum("sbjj->sbj", self.learned)[..., 1:])
        own = np.einsum("sbjj->sbj", self.left)
        return self._mean_S(own[..., :1] - 2.0 * gain * self.left[..., 0, 1:] + gain**2 * own[..., 1:])

    def error_with_two(self) -> Array:
        """The same after taking two inputs more, for each first and second one (S, p, p)."""
        learned, left = self.learned, self.left
        along, across = learned[..., 1:, :], left[..., 1:, :]
        own, size = np.einsum("sbjj->sbj", learned)[..., None, :], np.einsum("sbjj->sbj", left)[..., None, :]
        gain = _share(along, np.swapaxes(own, -1, -2)[..., 1:, :])
        squares = size - 2.0 * gain * across + gain**2 * np.swapaxes(size, -1, -2)[..., 1:, :]
        first, rest = gain[..., :1], gain[..., 1:]
        more = _share(learned[..., :1, 1:] - first * along[..., 1:], (own - gain * along)[..., 1:])
        crossed = left[..., :1, 1:] - first * across[..., 1:] - rest * across[..., :1]
        crossed += first * rest * np.swapaxes(size, -1, -2)[..., 1:, :]
        return self._mean_S(squares[..., :1] - 2.0 * more * crossed + more**2 * squares[..., 1:])

    def taking(self, model: NDArray[np.int64], column: NDArray[np.int64]) -> LeftOut:
        """Models `model` (N,), each with its input `column` (N,) taken: row and column of it become 0."""
        n, j = np.arange(len(model)), column + 1
        learned, left = self.learned[model], self.left[model]
        along, across = learned[n, :, j], left[n, :, j]
        gain = _share(along, along[n, :, j][..., None])
        crossed = gain[..., :, None] * (across - 0.5 * across[n, :, j][..., None] * gain)[..., None, :]
        learned -= gain[..., :, None] * along[..., None, :]
        left -= crossed
        left -= np.swapaxes(crossed, -1, -2)
        return LeftOut(learned, left, self.rows)

    def _mean_S(self, squares: Array) -> Array:
        rows = self.rows.reshape(-1, *(1,) * (squares.ndim - 2))
        mean: Array = np.sqrt(np.maximum(squares, 0.0) / rows).mean(axis=1)
        return mean


def errors_of_all(nothing: LeftOut) -> Array:
    """Left-out error of every subset of p inputs, (2^p,): bit p − 1 − j of the index says whether input j is taken.

    Inputs are decided from the last to the first. A decided one leaves the matrices, so most of the work is in small
    ones: about 2^p times 30 numbers per block in all.
    """
    learned, left = nothing.learned, nothing.left
    while learned.shape[-1] > 1:
        along, across = learned[..., :-1, -1], left[..., :-1, -1]
        gain = _share(along, learned[..., -1:, -1])
        crossed = gain[..., :, None] * (across - 0.5 * left[..., -1:, -1] * gain)[..., None, :]
        learned, left = learned[..., :-1, :-1], left[..., :-1, :-1]
        learned = np.concatenate([learned, learned - gain[..., :, None] * along[..., None, :]])
        left = np.concatenate([left, left - crossed - np.swapaxes(crossed, -1, -2)])
    return LeftOut(learned, left, nothing.rows).error()


def beam(nothing: LeftOut, width: int) -> list[tuple[Sets, Array]]:
    """For 1 to p inputs the `width` best sets found, best first: (sets (≤ width, p), errors).

    Every set grows by every input; of the results the best `width` grow on. Width 1 is forward selection.
    Equal errors go by the order of the inputs.
    """
    p = nothing.learned.shape[-1] - 1
    state, sets = nothing, np.zeros((1, p), bool)
    found = []
    for _ in range(p):
        model, column = np.nonzero(~sets)
        grown = sets[model]
        grown[np.arange(len(grown)), column] = True
        _, first = np.unique(np.packbits(grown, axis=1), axis=0, return_index=True)  # many ways lead to a set
        model, column, grown = model[first], column[first], grown[first]
        error = state.error_with()[model, column]
        order = np.lexsort((*(~grown.T)[::-1], np.round(error, DIGITS)))[:width]
        state, sets = state.taking(model[order], column[order]), grown[order]
        found.append((sets, error[order]))
    return found


def _share(along: Array, own: Array) -> Array:
    """`along` / `own`, 0 where `own`, what is left of an input's unit size, is nothing."""
    enough = own > _TAKEN
    out: Array = np.where(enough, along / np.where(enough, own, 1.0), 0.0)
    return out
