"""When which regime holds, and for how long: the time side of a simulation, prepared once for many runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from data.errors import InputError
from twin.simulation.pieces import Array, Ints, Pieces, cut

_SAME_STEP = 1e-11  # of the longest: steps closer than that are one; differences of large times carry rounding


class Schedule:
    """B batches of up to M intervals: `dt_s` (B, M), `regime` (B, M) from 0, valid for the first `n_rows` (B,).

    What stands behind a batch's valid intervals is never read. Steps may differ from interval to interval; few
    distinct ones are fast, since each frequent one has weights of its own.

    Raises:
        InputError: shapes that disagree, a step that is not positive and finite, a negative regime.
    """

    def __init__(self, dt_s: Array, regime: ArrayLike, n_rows: ArrayLike | None = None) -> None:
        dt, regimes = np.asarray(dt_s, float), np.asarray(regime)
        if dt.ndim != 2 or regimes.shape != dt.shape:
            raise InputError(
                f"schedule: dt_s has shape {dt.shape} and regime {regimes.shape}, "
                "expected (batches, intervals) for both"
            )
        rows = np.full(len(dt), dt.shape[1]) if n_rows is None else np.asarray(n_rows)
        if rows.shape != (len(dt),) or (rows < 0).any() or (rows > dt.shape[1]).any():
            raise InputError(
                f"schedule: n_rows is {rows.tolist()}, expected one number from 0 to {dt.shape[1]} for each of "
                f"{len(dt)} batches"
            )
        valid = np.arange(dt.shape[1]) < rows[:, None]
        _check_steps(dt, valid)
        _check_regimes(regimes, valid)
        self.n_batches, self.n_intervals = dt.shape
        self.n_rows: Ints = rows.astype(np.intp)
        self.regime: Ints = np.where(valid, regimes, 0).astype(np.intp)
        self.n_regimes = int(self.regime.max(initial=0)) + 1
        self.step_s, step = _distinct(dt[valid])
        self.step: Ints = np.zeros(dt.shape, np.intp)
        self.step[valid] = step
        self._pieces: dict[int, Pieces] = {}

    def pieces(self, every: int = 1) -> Pieces:
        """The pieces that keep every `every`-th border, cut at the first call.

        Raises:
            InputError: `every` is not a whole number from 1 to M.
        """
        if every not in self._pieces:
            if every != int(every) or not 1 <= every <= max(self.n_intervals, 1):
                raise InputError(
                    f"schedule: every is {every}, expected a whole number of intervals from 1 to {self.n_intervals}"
                )
            self._pieces[every] = cut(self.step, self.step_s, self.regime, self.n_rows, int(every))
        return self._pieces[every]

    def drive(self, series: Array) -> Drive:
        """Series (Q or 1, J, B, M, 2) for this schedule; see `Drive`."""
        return Drive(self, series)


class Drive:
    """Series (Q or 1, J, B, M, 2): values at the start and the end of every interval, linear in between.

    Shared series (leading axis 1) are sorted into pieces once and kept: use the same `Drive` for many runs.

    Raises:
        InputError: another shape.
    """

    def __init__(self, schedule: Schedule, series: Array) -> None:
        values = np.ascontiguousarray(series, float)
        expected = (schedule.n_batches, schedule.n_intervals, 2)
        if values.ndim != 5 or values.shape[2:] != expected:
            raise InputError(
                f"forcing: series have shape {values.shape}, expected (sets, series, batches, intervals, 2) = "
                f"(…, …, {', '.join(map(str, expected))})"
            )
        self.schedule, self.series = schedule, values
        self._sorted: dict[int, list[Array]] = {}

    @property
    def n_sets(self) -> int:
        return len(self.series)

    @property
    def n_series(self) -> int:
        return self.series.shape[1]

    def rows(self, every: int, sets: slice) -> list[Array]:
        """One matrix per block of `schedule.pieces(every)`: a row's intervals x sets x series x (start, end), flat."""
        if self.n_sets > 1:
            return self._sort(every, sets)
        if every not in self._sorted:
            self._sorted[every] = self._sort(every, slice(0, 1))
        return self._sorted[every]

    def first_bad(self) -> str | None:
        """Where the first value stands that is not finite within the valid intervals, in words."""
        valid = np.arange(self.schedule.n_intervals) < self.schedule.n_rows[:, None]
        bad = np.argwhere(~np.isfinite(self.series) & valid[:, :, None])
        if not len(bad):
            return None
        q, j, b, m, side = bad[0].tolist()
        value = self.series[q, j, b, m, side]
        return f"set {q}, series {j}, batch {b}, interval {m}: {('start', 'end')[side]} value is {value}"

    def _sort(self, every: int, sets: slice) -> list[Array]:
        pieces = self.schedule.pieces(every)
        n_used = self.schedule.n_intervals // every * every
        # (start, end) travel as one complex number: a transposition of 16-byte items is four times as fast
        chosen = self.series[sets]
        pairs = chosen.reshape(len(chosen) * self.n_series, *chosen.shape[2:]).view(np.complex128)[:, :, :n_used, 0]
        by_time = np.ascontiguousarray(pairs.transpose(1, 2, 0))
        return [
            by_time.reshape(-1, block.n_held * len(pairs)).take(block.source, axis=0, mode="clip").view(float)
            for block in pieces.blocks
        ]


def _distinct(dt_s: Array) -> tuple[Array, Ints]:
    """The distinct steps and the number of each interval's; what differs by rounding alone is one step, their mean."""
    values, number = np.unique(dt_s, return_inverse=True)
    group = np.cumsum(np.diff(values, prepend=-np.inf) > _SAME_STEP * values.max(initial=0.0)) - 1
    return np.bincount(group, weights=values) / np.bincount(group), group[number]


def _check_steps(dt: Array, valid: NDArray[np.bool_]) -> None:
    bad = np.argwhere(valid & ~(np.isfinite(dt) & (dt > 0.0)))
    if len(bad):
        b, m = bad[0].tolist()
        raise InputError(
            f"schedule: batch {b}, interval {m}: dt_s is {dt[b, m]:g} s, expected a positive, finite time; "
            "sort the rows by time and drop repeated ones"
        )


def _check_regimes(regime: NDArray[np.generic], valid: NDArray[np.bool_]) -> None:
    used = np.where(valid, regime, 0)
    bad = np.argwhere((used < 0) | (used != np.floor(used)))
    if len(bad):
        b, m = bad[0].tolist()
        raise InputError(f"schedule: batch {b}, interval {m}: regime is {regime[b, m]}, expected a whole number from 0")
