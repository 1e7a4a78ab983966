"""Readings of errors along an axis, and their place on the grid. A sweep reads every position once.

Every reading gets a grid row of its own: the row nearest to its time, in the original order. A sweep under one time
stamp therefore occupies consecutive rows around it. Readings of one position that fall into one row are averaged: a
sweep there and back under one stamp becomes its mean. Rows between readings have neither position nor error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from data.arrays import Array, Index
from data.errors import InputError
from data.machine import Machine

Columns = Mapping[str, Sequence[tuple[str, float]]]  # error channel -> (column's key, position) one by one
_SAME = 1e-3  # of the travel: a control comes back to a position far closer, and nobody measures that densely
_PAUSE = 3.0  # times the usual time between readings


def position_bins(position: Array) -> Index:
    """A number for each reading, equal for those at one position (to a thousandth of the travel), (n,)."""
    travel = float(np.ptp(position)) if len(position) else 0.0
    if travel == 0.0:
        return np.zeros(len(position), np.int64)
    return np.rint((position - position.min()) / (_SAME * travel)).astype(np.int64)


def sweep_numbers(time_s: Array, position: Array) -> Index:
    """The sweep of each reading, counted from 0, (n,): a new one begins where a position comes back.

    Readings that follow each other at one position without a pause (a dwell, the turn at an end) come back nowhere.
    """
    bins = position_bins(position)
    between_s = np.diff(time_s, prepend=time_s[:1])
    pause_s = _PAUSE * float(np.median(between_s[1:])) if len(time_s) > 1 else 0.0
    out = np.zeros(len(bins), np.int64)
    seen: set[int] = set()
    for k, here in enumerate(bins.tolist()):
        dwells = k > 0 and here == bins[k - 1] and between_s[k] <= pause_s
        starts = here in seen and not dwells
        seen = {here} if starts else seen | {here}
        out[k] = (out[k - 1] if k else 0) + starts
    return out


@dataclass(frozen=True)
class Readings:
    """Readings along one axis as a file gives them: time_s, position and each error channel (n,), `row` of the file."""

    channel: str  # of the positions
    time_s: Array
    position: Array
    errors: Mapping[str, Array]
    row: Index

    def since(self, first_s: float) -> Readings:
        """The readings from that time on."""
        later = self.time_s >= first_s
        if later.all():
            return self
        errors = {n: v[later] for n, v in self.errors.items()}
        return replace(
            self, time_s=self.time_s[later], position=self.position[later], errors=errors, row=self.row[later]
        )

    def on_grid(self, step_s: float, n_rows: int, most_s: float, where: str) -> dict[str, Array]:
        """Position and error channels on the rows t = 0, step_s, …, shape (n_rows,), NaN between the readings.

        Raises:
            InputError: more readings than rows, or one whose row is more than `most_s` from its time.
        """
        from scipy.optimize import isotonic_regression  # takes long to load

        time_s, position, errors = self._averaged(step_s)
        step_hint = f"recording.step_s is {step_s:g} s; lower it, a sweep takes one row for each position"
        if len(time_s) > n_rows:
            raise InputError(f"{where}: {len(time_s)} readings along {self.channel} for {n_rows} rows: {step_hint}")
        count = np.arange(len(time_s))
        # rows that rise by one or more and are nearest to the times in the sum of squares
        first = isotonic_regression(time_s / step_s - count).x
        rows = np.clip(np.rint(first), 0, n_rows - len(count)).astype(np.int64) + count
        away_s = float(np.abs(rows * step_s - time_s).max(initial=0.0))
        if away_s > most_s:
            raise InputError(
                f"{where}: a reading along {self.channel} would stand {away_s:g} s from its time, expected at most "
                f"recording.max_gap_s ({most_s:g} s): {step_hint}"
            )
        out = {}
        for name, values in {self.channel: position, **errors}.items():
            out[name] = np.full(n_rows, np.nan)
            out[name][rows] = values
        return out

    def _averaged(self, step_s: float) -> tuple[Array, Array, dict[str, Array]]:
        """Time, position and errors with one reading for each position and row, in order of first appearance."""
        key = np.stack([np.rint(self.time_s / step_s).astype(np.int64), position_bins(self.position)])
        _, first, which = np.unique(key, axis=1, return_index=True, return_inverse=True)
        order = np.argsort(first, kind="stable")

        def mean(values: Array) -> Array:
            there = np.isfinite(values)
            count = np.bincount(which[there], minlength=len(first))
            total = np.bincount(which[there], values[there], minlength=len(first))
            return np.where(count > 0, total / np.maximum(count, 1), np.nan)[order]

        return mean(self.time_s), mean(self.position), {n: mean(v) for n, v in self.errors.items()}


def take_readings(
    values: dict[str, Array], time_s: Array, machine: Machine, columns: Columns, where: str
) -> tuple[list[Readings], dict[str, int]]:
    """The readings along each axis, and how many; their channels are taken out of `values`.

    `values` holds the file's columns (n,) by channel, a column of its own for each position by the keys in `columns`.
    Where no error was read along an axis (a recording to predict), its positions stay as they are.

    Raises:
        InputError: errors that should stand at positions which the file does not have.
    """
    taken: list[Readings] = []
    lost = 0
    for channel, names in machine.axes().items():
        wide = next((columns[n] for n in names if n in columns), None)
        if wide is not None:
            found = _from_columns(channel, names[0], wide, values, time_s)
        else:
            errors = {n: values[n] for n in names if n in values and np.isfinite(values[n]).any()}
            if errors and channel not in values:
                raise InputError(
                    f"{where}: {next(iter(errors))} is measured along {channel!r}, which the file does not have; "
                    f"correct column: of {channel!r}"
                )
            if not errors:
                continue
            position = values.pop(channel)
            read = np.logical_or.reduce([np.isfinite(v) for v in errors.values()])
            row = np.flatnonzero(read & np.isfinite(position))
            errors = {n: values.pop(n)[row] for n in errors}
            found = Readings(channel, time_s[row], position[row], errors, row)
            lost += int(read.sum()) - len(row)
        taken.append(found)
    counts = {"readings": sum(len(r.time_s) for r in taken), "readings_without_position": lost}
    return taken, {k: v for k, v in counts.items() if v}


def _from_columns(
    channel: str, name: str, columns: Sequence[tuple[str, float]], values: dict[str, Array], time_s: Array
) -> Readings:
    """Readings of an error channel that has one column for each position, row by row in the columns' order."""
    table = np.column_stack([values.pop(key) for key, _ in columns])
    row, column = np.nonzero(np.isfinite(table))
    position = np.array([p for _, p in columns])[column]
    return Readings(channel, time_s[row], position, {name: table[row, column]}, row)
