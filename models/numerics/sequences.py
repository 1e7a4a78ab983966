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

from data.arrays import Array
from features.design import Design
from models.numerics.batches import bridged, padded, steps_s

_MOST_PHASES = 4  # that a net learns from: neighbouring rows of a fine recording are redundant


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


_LEAST_SPREAD = 0.1  # inputs that hardly move (K, or the driver's unit) are not blown up to unit size
FEWEST_BATCHES = 3  # of fewer, none can be spared for validation
_LEAST_REST = 1e-3  # of the target's size: below, the residual of the linear part is rounding


@dataclass(frozen=True)
class Stack:
    """Rows of S nets: x (R, S, p, T, B), rest and known (R, S, T, B), n_batches (S,).

    R phases, T steps and B batches, filled up with batches of which nothing is known. x is the input over its rms
    `spread` (S, p), `rest` the residual of the linear part over its rms `sigma_um` (S,), both over the known rows.
    """

    x: Array
    rest: Array
    known: Array
    n_batches: Array
    spread: Array
    sigma_um: Array

    @classmethod
    def of(cls, sequences: Sequences, fold: Sequence[int], rest_um: Array) -> Self:
        """One net's: a fold of a design's batches; `rest_um` (K, R, T) is the target less the linear part."""
        batches = list(fold)
        x, known = sequences.x[batches], sequences.known[batches]
        count = known.sum()

        def rms(values: Array) -> float:
            return float(np.sqrt(np.where(known, values[batches] ** 2, 0.0).sum() / count))

        spread = np.maximum(np.sqrt(np.einsum("brtp,brt->p", x**2, known) / count), _LEAST_SPREAD)
        sigma_um = max(rms(rest_um), _LEAST_REST * rms(sequences.y_um)) or 1.0
        rest = np.where(known, rest_um[batches], 0.0) / sigma_um
        one = np.newaxis
        return cls(np.ascontiguousarray((x / spread).transpose(1, 3, 2, 0))[:, one], rest.transpose(1, 2, 0)[:, one],
                   known.transpose(1, 2, 0)[:, one].astype(float), np.array([len(batches)]), spread[one],
                   np.array([sigma_um]))  # fmt: skip

    @classmethod
    def joined(cls, stacks: Sequence[Self]) -> Self:
        """One stack of all nets; phases, inputs and steps must agree."""
        most = max(s.x.shape[-1] for s in stacks)

        def filled(values: Array) -> Array:
            return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, most - values.shape[-1])])

        x, rest, known = (
            np.concatenate([filled(v) for v in part], axis=1)
            for part in zip(*((s.x, s.rest, s.known) for s in stacks), strict=True)
        )
        n_batches, spread, sigma_um = (
            np.concatenate(part) for part in zip(*((s.n_batches, s.spread, s.sigma_um) for s in stacks), strict=True)
        )
        return cls(x, rest, known, n_batches, spread, sigma_um)

    def halves(self) -> Self:
        """Twice the nets: first each with its batches of even place, then each with those of odd place."""
        filled = [(0, self.x.shape[-1] % 2)]
        x, rest, known = (
            np.concatenate([v[..., 0::2], np.pad(v, [(0, 0)] * (v.ndim - 1) + filled)[..., 1::2]], axis=1)
            for v in (self.x, self.rest, self.known)
        )
        n_batches = np.concatenate([(self.n_batches + 1) // 2, self.n_batches // 2])
        return type(self)(x, rest, known, n_batches, np.tile(self.spread, (2, 1)), np.tile(self.sigma_um, 2))

    def unit_directions(self, directions: Array) -> Array:
        """Directions (h, p) as (S, h, p), each scaled so that its sum has rms 1 over a net's known rows."""
        along = np.einsum("hp,rsptb->rshtb", directions, self.x) * self.known[:, :, None]
        rms = np.sqrt((along**2).sum(axis=(0, 3, 4)) / self.known.sum(axis=(0, 2, 3))[:, None])
        return np.asarray(directions / np.where(rms > 0, rms, 1.0)[:, :, None])


def alike(n_batches: Sequence[int], most: int) -> list[list[int]]:
    """Nets to train as one stack: places in the order of their numbers of batches, cut where these are half as many
    again, where validation becomes possible, or where `most` batches are together."""
    groups: list[list[int]] = []
    size = 0
    for i in sorted(range(len(n_batches)), key=lambda i: n_batches[i]):
        least = n_batches[groups[-1][0]] if groups else 0
        size += n_batches[i]
        if not groups or size > most or n_batches[i] > 1.5 * least or least < FEWEST_BATCHES <= n_batches[i]:
            groups.append([])
            size = n_batches[i]
        groups[-1].append(i)
    return groups


LAG_STEPS = (1.0, 2.5, 6.3, 16.0)  # time constants, in steps of the sequence


def memory_columns(x: Array) -> Array:
    """Sequences x (…, T, p) and lag_l x − x of every lag, (…, T, (L + 1) p).

    lag is the first-order lag τ dv/dt + v = x, exact for x held over the step before, at rest (0) before the start.
    """
    keep = np.exp(-1.0 / np.array(LAG_STEPS))[:, None]
    out = np.empty((*x.shape[:-1], len(LAG_STEPS) + 1, x.shape[-1]))
    state = np.zeros_like(out[..., 0, 1:, :])
    for t in range(x.shape[-2]):
        now = x[..., t, None, :]
        state = keep * state + (1.0 - keep) * now
        out[..., t, :1, :], out[..., t, 1:, :] = now, state - now
    return out.reshape(*x.shape[:-1], -1)


Weights = dict[str, Any]  # name -> array (S, …) of S nets, numpy's or torch's
