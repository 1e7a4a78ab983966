"""The blocks that a training set is cut into for choices inside it: its batches, as sums over their rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from features.design import Design

Array = NDArray[np.float64]
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
        batches = batches[m.count[batches] > 0]
        sum_z = np.column_stack([m.sum_y[batches], m.sum_x[np.ix_(batches, columns)]])
        zz = np.empty((len(batches), len(columns) + 1, len(columns) + 1))
        zz[:, 0, 0] = m.yy[batches]
        zz[:, 0, 1:] = zz[:, 1:, 0] = m.xy[np.ix_(batches, columns)]
        zz[:, 1:, 1:] = m.xx[np.ix_(batches, columns, columns)]
        count = m.count[batches]
        energy = np.einsum("bjj->bj", zz) - sum_z**2 / count[:, None]
        order = np.lexsort((np.log(np.maximum(energy[:, 1:], 1e-300)).sum(axis=1), energy[:, 0]))
        return cls(count[order], sum_z[order], zz[order])

    def pooled(self, sets: NDArray[np.bool_]) -> tuple[Array, Array, Array]:
        """Of S sets of blocks (S, B): rows (S,), means (S, p + 1), centred products (S, p + 1, p + 1)."""
        take = sets.astype(float)
        count = np.maximum(take @ self.count, 1.0)
        mean = take @ self.sum_z / count[:, None]
        size = self.zz.shape[1]
        zz = (take @ self.zz.reshape(len(self.zz), -1)).reshape(-1, size, size)
        return count, mean, zz - count[:, None, None] * mean[:, :, None] * mean[:, None, :]
