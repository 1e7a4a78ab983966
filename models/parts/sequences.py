"""Batches as sequences for nets that run along them: thinned to a wide spacing, yet with every row in one of them.

A batch recorded every step and thinned `stride` to one gives `stride` interleaved sequences, its phases: row r is
step r // stride of phase r % stride. A net runs along each phase by itself, so a prediction exists at every row and
rests on rows at and before it alone; nothing is interpolated from a later one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from models.base import Array
from models.batchwise import bridged, padded, steps_s

_MOST_PHASES = 4  # that a net learns from: neighbouring rows of a fine recording tell the same


@dataclass(frozen=True)
class Sequences:
    """Phases of a design's batches: x (K, R, T, p), y_um, known and row (K, R, T).

    Holes of x are bridged by the last value; an input that a batch lacks wholly is NaN there. `known` marks the rows
    that are usable for training; y_um is 0 elsewhere. Behind a batch's end x is 0 and `row`, the row in the design,
    is −1. `units` are those of x's columns: the design's inputs, then the drivers.
    """

    design: Design
    units: tuple[str, ...]
    x: Array
    y_um: Array
    known: NDArray[np.bool_]
    row: NDArray[np.int64]

    @classmethod
    def of(cls, design: Design, stride: int, drivers: Sequence[str] = ()) -> Self:
        """All `stride` phases, with the named drivers, each averaged over the `stride` rows up to its row."""
        x, usable = bridged(design, design.x), design.usable
        if drivers:
            speeds = bridged(design, _named(design, drivers))
            usable = usable & np.isfinite(speeds).all(axis=1)
            x = np.column_stack([x, _trailing_mean(design, speeds, stride)])
        of_driver = dict(zip(design.driver_names, design.driver_units, strict=True))
        units = (*(design.input_units or ("K",) * len(design.inputs)), *(of_driver.get(name, "") for name in drivers))
        row = np.arange(1.0, len(design.y_um) + 1.0)
        return cls(design, units, _phases(padded(design, x), stride),
                   _phases(padded(design, np.where(usable, design.y_um, 0.0)), stride),
                   _phases(padded(design, usable.astype(float)), stride) > 0,
                   _phases(padded(design, row), stride).astype(np.int64) - 1)  # fmt: skip

    def for_training(self) -> Self:
        """At most 4 of the phases, evenly spread, and 0 for what is missing: such rows are not `known`."""
        stride = self.x.shape[1]
        kept = np.unique(np.round(np.linspace(0, stride - 1, min(stride, _MOST_PHASES))).astype(int))
        return replace(self, x=np.nan_to_num(self.x[:, kept]), y_um=self.y_um[:, kept], known=self.known[:, kept],
                       row=self.row[:, kept])  # fmt: skip

    @cached_property
    def _order(self) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        inside = self.row >= 0
        return inside, np.argsort(self.row[inside])

    def rows(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values (K, R, T, …) as rows (n, …), batch after batch in the order of time."""
        inside, order = self._order
        return values[inside][order]

    def as_design(self, columns: Array) -> Design:
        """A design on these rows with other inputs, columns (K, R, T, c p), all of x's units c times over.

        The target is NaN where it is not known.
        """
        inside, _ = self._order
        offsets = np.concatenate([[0], np.cumsum(inside.sum(axis=(1, 2)))]).astype(np.int64)
        d, x = self.design, self.rows(columns)
        y_um = np.where(self.rows(self.known), self.rows(self.y_um), np.nan)
        names = tuple(map(str, range(x.shape[1])))
        return Design(names, d.target, d.batch_ids, x, y_um, d.time_s[self.rows(self.row)], offsets, d.step_s,
                      input_units=self.units * (len(names) // len(self.units)))  # fmt: skip


def strides(design: Design, spacing_s: float) -> NDArray[np.int64]:
    """Rows per step of every batch, (K,), for a net whose steps are `spacing_s` apart; 1 for a batch of one row."""
    step_s = np.nan_to_num(steps_s(design), nan=spacing_s)
    return np.maximum(np.round(spacing_s / step_s), 1).astype(np.int64)


def _phases(values: Array, stride: int) -> Array:
    """Rows per batch (K, n, …) as phases (K, stride, T, …), zeros behind the last row."""
    n_batches, n_rows = values.shape[:2]
    steps = -(-n_rows // stride)
    ends = [(0, 0), (0, steps * stride - n_rows)] + [(0, 0)] * (values.ndim - 2)
    return np.swapaxes(np.pad(values, ends).reshape(n_batches, steps, stride, *values.shape[2:]), 1, 2)


def _named(design: Design, drivers: Sequence[str]) -> Array:
    """The drivers' columns (n, d), NaN for one that the design has not."""
    place = {name: c for c, name in enumerate(design.driver_names)}
    nothing = np.full(len(design.y_um), np.nan)
    return np.column_stack([design.drivers[:, place[name]] if name in place else nothing for name in drivers])


def _trailing_mean(design: Design, values: Array, window: int) -> Array:
    """Mean over the last `window` rows (n, d), at rest (0) before a batch's start."""
    out = np.empty_like(values)
    for k in range(design.n_batches):
        before = np.zeros((window - 1, values.shape[1]))
        padded_values = np.vstack([before, values[design.rows(k)]])
        out[design.rows(k)] = np.lib.stride_tricks.sliding_window_view(padded_values, window, axis=0).mean(axis=2)
    return out
