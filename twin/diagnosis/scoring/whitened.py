"""A linearised fit as a plain regression: rows of unit noise in which each batch's own unknowns are integrated out.

With nuisances of prior N(0, 1) a batch's rows have the covariance ``I + N Nᵀ``; multiplied by its inverse square root
they are independent again, and what is left is linear in the shared parameters and in the candidates' amplitudes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.calibration.fit_problem import Array, Block, Unknown
from twin.diagnosis.scoring.memory import Memory, Slices, slices_of

SEEN = 1e-9  # sum of squares below which a direction of the nuisances, of variance 1, shows in no row


@dataclass(frozen=True)
class Whitened:
    """One batch: ``target = jacobian z + columns g + noise`` of unit variance; z = (x − prior) / spread ~ N(0, 1).

    target (n,), jacobian (n, p), columns (n, C), channel (n,) of every row, in order of channels; `mixing` (n, q) and
    `damping` (q,) are the nuisances' part: ``(I + N Nᵀ)^(-1/2) = I - mixing diag(damping) mixingᵀ``.
    """

    batch_id: str
    target: Array
    jacobian: Array
    columns: Array
    channel: NDArray[np.int64]
    scale: Array  # (n,) sqrt of the rows' weights
    mixing: Array
    damping: Array
    memory: Memory | None = None  # of each channel's rows; None: they are independent

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """Rows at which each channel begins."""
        return np.flatnonzero(np.r_[True, np.diff(self.channel) != 0])

    @cached_property
    def channels(self) -> NDArray[np.int64]:
        """The numbers of the channels that have rows."""
        return self.channel[self.starts]

    @cached_property
    def slices(self) -> Slices:
        """Every channel's number and rows."""
        return slices_of(self.channel)

    def with_slack(self, loose: Mapping[int, float]) -> Whitened:
        """The same batch in which some columns are shared unknowns too, of the prior sd given, about 0."""
        if not loose:
            return self
        more = self.columns[:, list(loose)] * np.array(list(loose.values()))
        return replace(self, jacobian=np.hstack([self.jacobian, more]))

    def with_own(self, column: Array) -> Whitened:
        """The same batch with one more unknown of its own, of prior N(0, 1); column (n,) is whitened already."""
        square = float(column @ column)
        if square < 1e-18:
            return replace(self, columns=self.columns[:, :0])
        damping = 1.0 - 1.0 / np.sqrt(1.0 + square)
        unit = column / np.sqrt(square)

        def damped(rows: Array) -> Array:
            return np.asarray(rows - damping * np.multiply.outer(unit, unit @ rows))

        return replace(
            self, target=damped(self.target), jacobian=damped(self.jacobian), columns=self.columns[:, :0],
            damping=np.append(self.damping, damping), mixing=np.column_stack([self.mixing, unit]),
        )  # fmt: skip

    def of(self, rows: Array) -> Array:
        """Other quantities of the same rows (n, …), in units of the given noise, whitened alike."""
        rows = self.innovations(rows * self.scale.reshape(-1, *(1,) * (rows.ndim - 1)))
        return np.asarray(rows - self.mixing @ (self.damping * (self.mixing.T @ rows).T).T)

    def innovations(self, rows: Array) -> Array:
        """Rows (n, …) less what each channel's memory of the rows before foretells."""
        if self.memory is None:
            return rows
        return self.memory.filtered(self.slices, rows)

    def restored(self, rows: Array) -> Array:
        """Rows (n, …) as they were before `of`, in units of the weighted noise."""
        back = self.damping / (1.0 - self.damping)
        rows = np.asarray(rows + self.mixing @ (back * (self.mixing.T @ rows).T).T)
        if self.memory is None:
            return rows
        return self.memory.restored(self.slices, rows)


def whitened(
    block: Block, nuisance: Array, z: Array, unknowns: Sequence[Unknown], columns: Sequence[int], weight: Array,
    memory: Memory | None = None,
) -> Whitened:  # fmt: skip
    """A block at z and its nuisances (q,), the unknowns numbered `columns` taken as amplitudes.

    z (p,) of the other unknowns in their order; `weight` (channels,) of the rows, `memory` of each channel's.
    """
    scale = np.sqrt(weight[block.channel])
    bare = np.zeros((len(scale), 0))
    none = Whitened(block.batch_id, scale[:0], bare, bare, block.channel, scale, bare, scale[:0], memory)
    own = none.of(block.nuisance)
    square, turn = np.linalg.eigh(own.T @ own)  # what rounding makes of small ones is damped by no more than that
    kept = square > SEEN
    mixing, damping = own @ (turn[:, kept] / np.sqrt(square[kept])), 1.0 - 1.0 / np.sqrt(1.0 + square[kept])
    chosen = np.zeros(len(unknowns), bool)
    chosen[list(columns)] = True
    spread = np.array([u.spread for u in unknowns])
    out = replace(none, mixing=mixing, damping=damping)
    rows = out.of(
        np.column_stack(
            [block.residual + block.nuisance @ nuisance, block.jacobian[:, ~chosen] * spread[~chosen],
             block.jacobian[:, list(columns)]]
        )
    )  # fmt: skip
    p = int((~chosen).sum())
    jacobian = rows[:, 1 : 1 + p]
    return replace(out, target=rows[:, 0] + jacobian @ z, jacobian=jacobian, columns=rows[:, 1 + p :])
