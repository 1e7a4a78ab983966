"""Repair of a time column and resampling of irregular samples to a regular grid; long holes stay empty.

Repair of the time column, in this order
1. unreadable times: the row is dropped (`unparsable_time`);
2. a lone row whose time is far off on both sides, or a first or last one ten recordings away: dropped
   (`time_outliers`);
3. a step back beyond `max_gap_s` into time that is already covered: the clock was restarted or set back; the rest is
   carried on one sampling interval after the last row (`clock_restarts`). The length of the pause is unknown;
4. any other step back: rows out of order, sorted (`backward_steps` counts every step back that was found);
5. equal times: averaged, drivers take the last (`duplicates` counts the rows beyond the first).

Grid: t = 0, step, 2·step, … from the first sample to the last. Where the grid is at least twice as coarse as the
samples, a value is the mean of the samples within ± step/2; the first value takes only samples before the first
source interval has passed, so that the zero is the true start. Where it is finer, values are interpolated linearly.
Drivers are commanded and hold the last value. Inside a hole longer than `max_gap_s`, or than 2.5 usual intervals of a
channel that has fewer samples than the rows, there is nothing (NaN), and none
where the instrument stated that it had no value: a grid row with such a sample, and no other, within ± step/2 is empty.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Index
from data.errors import InputError
from data.units import TIME_UNITS_S

_FAR_INTERVALS = 5.0
_END_SPANS = 10.0
_MANY_JUMPS = 1000
_ENDLESS_S = 1e13  # no clock shows this; keeps differences finite
_EPS = 1e-6  # of a step: 60 s reached by minutes × 60
_LEAST_ROWS = 12  # of a grid on which the checks find a step
_SQUEEZED = 10.0  # samples in a grid row
_FINEST = 5.0  # grid rows for a sample: more are invented
_LOST = 2.5  # usual intervals of a channel: one lost sample is no hole
_SLOWEST_S = 600.0  # a channel that is read less often misses a warm-up: nothing is known between its samples
_NEAR_STEP = 7.5  # times; units of time are 60 apart


@dataclass(frozen=True)
class Repaired:
    """`order` are the rows that stay, in order of time; `time_s` their times from the first one, never falling."""

    order: Index
    time_s: Array
    start: float  # time of the first row as the file gives it
    counts: dict[str, int]


def repair_time(time_s: Array, max_gap_s: float) -> Repaired:
    """Bring a time column into order; shape (n,) in, at most n out. Counts name what was done (see module)."""
    order = np.flatnonzero(np.abs(time_s) < _ENDLESS_S)
    counts = {"unparsable_time": len(time_s) - len(order)}
    t = time_s if len(order) == len(time_s) else time_s[order]
    step = np.diff(t)
    if len(t) > 3:
        far = max(max_gap_s, _FAR_INTERVALS * _interval(t))
        lone = _lone(t, step, far)
        counts["time_outliers"] = int(lone.sum())
        if lone.any():
            order, t = order[~lone], t[~lone]
            step = np.diff(t)
    counts["backward_steps"] = int((step < 0).sum())
    if counts["backward_steps"]:
        t, counts["clock_restarts"] = _carry_on(t, step, max_gap_s)
        by_time = np.argsort(t, kind="stable")
        order, t = order[by_time], t[by_time]
        step = np.diff(t)
    counts["duplicates"] = int((step == 0).sum())
    counts["gaps"] = int((step > max_gap_s * (1 + 1e-9)).sum())
    start = float(t[0]) if len(t) else 0.0
    return Repaired(order, t - start, start, counts)


def _interval(t: Array) -> float:
    """Median of the rising steps, s."""
    step = np.diff(t)
    step = step[step > 0]
    return float(np.median(step)) if len(step) else 0.0


def _lone(t: Array, step: Array, far: float) -> NDArray[np.bool_]:
    lone = np.zeros(len(t), bool)
    before, after = step[:-1], step[1:]
    fits = t[2:] >= t[:-2]
    lone[1:-1] = fits & (((before > far) & (after < -far)) | ((before < -far) & (after > far)))
    lone[0] = abs(step[0]) > max(far, _END_SPANS * np.ptp(t[1:]))
    lone[-1] = abs(step[-1]) > max(far, _END_SPANS * np.ptp(t[:-1]))
    return lone


def _carry_on(t: Array, step: Array, max_gap_s: float) -> tuple[Array, int]:
    """Undo restarts of the clock: stretches that would cover time once more are moved behind the last one."""
    jumps = np.flatnonzero(step < -max_gap_s) + 1
    if len(jumps) > _MANY_JUMPS:
        return t, 0
    t = t.copy()
    interval = _interval(t)
    covered: list[tuple[float, float]] = []
    restarts = 0
    for a, b in zip([0, *jumps], [*jumps, len(t)], strict=True):
        low, high = float(t[a:b].min()), float(t[a:b].max())
        if any(low <= end and high >= begin for begin, end in covered):
            move = max(end for _, end in covered) + interval - t[a]
            t[a:b] += move
            low, high = low + move, high + move
            restarts += 1
        covered.append((low, high))
    return t, restarts


def check_step(time_s: Array, step_s: float, unit: str, where: str, finer: bool) -> None:
    """Refuse a grid that throws most samples of a short recording away, or, unless `finer`, invents most of its rows.

    Raises:
        InputError: fewer than 12 grid rows, each of more than 10 samples, or more than 5 for a sample; the likely unit.
    """
    rows, interval = int(time_s[-1] / step_s + _EPS) + 1, _interval(time_s)
    if interval > _FINEST * step_s * (1 + _EPS) and not finer:
        raise InputError(
            f"{where}: rows are {interval:.4g} s apart but recording.step_s is {step_s:g} s: {rows} grid rows from"
            f" {len(time_s)}; {_other_unit(interval, step_s, unit)}, or raise step_s to {interval:.4g}"
        )
    if 2 <= rows < _LEAST_ROWS and step_s > _SQUEEZED * interval:
        raise InputError(
            f"{where}: {len(time_s)} rows, {interval:.3g} s apart, span {time_s[-1]:.3g} s and leave only {rows} grid"
            f" rows of {step_s:g} s; {_other_unit(interval, step_s, unit)}, or lower recording.step_s"
        )


@dataclass(frozen=True)
class Gridded:
    """`time_s` (m,), `columns` name -> (m,), `used` (n,) rows that went into at least one value, `channel_gaps`."""

    time_s: Array
    columns: dict[str, Array]
    used: NDArray[np.bool_]
    channel_gaps: int


def to_grid(
    time_s: Array,
    values: Mapping[str, Array],
    held: Collection[str],
    step_s: float,
    max_gap_s: float,
    where: str = "",
    unit: str = "",
    invalid: Mapping[str, NDArray[np.bool_]] | None = None,
) -> Gridded:
    """Put samples on the grid t = 0, step_s, …

    time_s (n,) from 0 and never falling, as `repair_time` gives it; values name -> (n,), NaN where nothing; `held`
    names the drivers. `unit` is the one in which the file gives time; `invalid` name -> (n,) marks samples that the
    instrument gave as no value: no value is interpolated there.

    Raises:
        InputError: fewer than 2 grid rows; every hole longer than max_gap_s; a grid out of all proportion.
    """
    if len(time_s) < 2 or time_s[-1] < step_s * (1 - _EPS):
        span = float(time_s[-1]) if len(time_s) else 0.0
        raise InputError(
            f"{where}: {len(time_s)} usable rows over {span:g} s, expected at least 2 rows over one step"
            f" of {step_s:g} s;"
            " record longer or lower recording.step_s"
        )
    interval = _interval(time_s)
    if interval > max_gap_s * (1 + 1e-9):
        raise InputError(
            f"{where}: samples are {interval:g} s apart but recording.max_gap_s is {max_gap_s:g} s: all would be hole;"
            f" {_other_unit(interval, step_s, unit)} or raise max_gap_s"
        )
    ratio = time_s[-1] / step_s
    if ratio > 100.0 * len(time_s) + 100_000:
        raise InputError(
            f"{where}: {len(time_s)} rows span {time_s[-1]:.6g} s, that is {ratio:.3g} grid rows of {step_s:g} s;"
            " correct recording.time.unit or step_s, or repair the time column"
        )
    grid: Array = np.arange(int(np.floor(ratio + _EPS)) + 1, dtype=np.float64) * step_s
    coarse = step_s >= 2.0 * interval * (1 - _EPS)
    full = _Sampled(time_s, grid, step_s, max_gap_s, coarse, interval)
    used = np.zeros(len(time_s), bool)
    result: dict[str, Array] = {}
    full_gaps, channel_gaps = full.gaps, 0
    for name, v in values.items():
        missing = np.isnan(v)
        if not missing.any():
            result[name] = full.held(v) if name in held else full.continuous(v)
            continue
        there = np.flatnonzero(~missing)
        if len(there) == 0:
            result[name] = np.full(len(grid), np.nan)
            continue
        own_s = _interval(time_s[there])
        gap_s = max(max_gap_s, _LOST * own_s) if own_s <= _SLOWEST_S else max_gap_s
        part = _Sampled(time_s[there], grid, step_s, gap_s, coarse, interval)
        result[name] = part.held(v[there]) if name in held else part.continuous(v[there])
        channel_gaps += max(0, part.gaps - full_gaps)
        used[there[part.used]] = True
    used |= full.used
    half_s = 0.5 * max(step_s, interval)
    for name, bad in (invalid or {}).items():
        if name in result and name not in held:
            good = ~np.isnan(values[name])
            result[name][_near(grid, time_s[bad], half_s) & ~_near(grid, time_s[good], half_s)] = np.nan
    return Gridded(grid, result, used, channel_gaps)


def _near(grid: Array, t: Array, half_s: float) -> NDArray[np.bool_]:
    """Grid points with a sample of t (n,) within ± half_s, shape (m,)."""
    slack = _EPS * half_s
    return np.searchsorted(t, grid + half_s - slack) > np.searchsorted(t, grid - half_s + slack)


def _other_unit(interval_s: float, step_s: float, unit: str) -> str:
    """What to do about a time unit: the one in which the samples are nearest to a grid step apart, if that is near."""
    known = TIME_UNITS_S if unit in TIME_UNITS_S else {}
    apart_s = {u: interval_s * s / TIME_UNITS_S[unit] for u, s in known.items() if u != unit}
    near = min(apart_s, key=lambda u: abs(np.log(apart_s[u] / step_s)), default="")
    if not near or not step_s / _NEAR_STEP <= apart_s[near] <= step_s * _NEAR_STEP:
        return "correct recording.time.unit"
    return (
        f"if the time column is in {near} (samples {apart_s[near]:.3g} s apart), set recording.time.unit: {near} in"
        f" place of {unit}"
    )


class _Sampled:
    """Sample times of one or more channels against the grid: who contributes to what is worked out once."""

    def __init__(self, t: Array, grid: Array, step_s: float, max_gap_s: float, coarse: bool, interval: float) -> None:
        self.grid, self.step_s, self.coarse = grid, step_s, coarse
        self.used = np.zeros(len(t), bool)
        self._eps = _EPS * step_s
        first = np.concatenate([[True], np.diff(t) > 0])
        self._first = None if first.all() else np.flatnonzero(first)  # first row of each distinct time
        self._rows = len(t)
        self.t = t = t if self._first is None else t[self._first]
        self.gaps = int((np.diff(t) > max_gap_s * (1 + 1e-9)).sum())
        self._left = np.searchsorted(t, grid + self._eps, side="right") - 1  # last sample at or before
        left = np.maximum(self._left, 0)
        right = np.minimum(self._left + 1, len(t) - 1)
        on = grid - t[left] <= self._eps
        hole = (t[right] - t[left] > max_gap_s * (1 + 1e-9)) & ~on
        self._nothing = (self._left < 0) | hole | ((self._left == len(t) - 1) & ~on)
        self._right = right
        with np.errstate(invalid="ignore", divide="ignore"):
            self._weight = np.where(on | (t[right] == t[left]), 0.0, (grid - t[left]) / (t[right] - t[left]))
        self._on_grid = len(t) == len(grid) and bool(np.abs(t - grid).max() <= self._eps)
        self._no_sample = np.ones(len(grid), bool)
        self._begin = self._end = np.zeros(len(grid), np.int64)
        if coarse:
            border = np.searchsorted(t, np.concatenate([grid - step_s / 2, [grid[-1] + step_s / 2]]))
            self._begin, self._end = border[:-1], border[1:].copy()
            self._end[0] = np.searchsorted(t, interval * (1 - _EPS))
            self._no_sample = self._end <= self._begin
        self._between = self._no_sample & ~self._nothing
        self._marked = {"continuous": False, "held": False}

    def _distinct(self, v: Array) -> Array:
        """One value per distinct time: the mean."""
        if self._first is None:
            return v
        return np.add.reduceat(v, self._first) / np.diff(np.append(self._first, self._rows))

    def _mark(self, distinct: Index | NDArray[np.bool_]) -> None:
        flag = np.zeros(len(self.t), bool)
        flag[distinct] = True
        self.used |= flag if self._first is None else np.repeat(flag, np.diff(np.append(self._first, self._rows)))

    def continuous(self, v: Array) -> Array:
        """Means or interpolated values, shape (m,)."""
        v = self._distinct(v)
        if not self._marked["continuous"]:
            self._marked["continuous"] = True
            self._mark(self._contributing())
        if self._on_grid and not self.coarse:
            return v
        left = np.maximum(self._left, 0)
        out = np.where(self._between, v[left] * (1.0 - self._weight) + v[self._right] * self._weight, np.nan)
        full = np.flatnonzero(~self._no_sample)
        if len(full):
            pairs = np.stack([self._begin[full], self._end[full]], axis=1).ravel()
            pairs = pairs[:-1] if pairs[-1] == len(v) else pairs
            out[full] = np.add.reduceat(v, pairs)[::2] / (self._end[full] - self._begin[full])
        return out

    def held(self, v: Array) -> Array:
        """The last value at or before each grid point, shape (m,)."""
        if self._first is not None:
            v = v[np.append(self._first[1:], self._rows) - 1]
        left = np.maximum(self._left, 0)
        if not self._marked["held"]:
            self._marked["held"] = True
            self._mark(left[~self._nothing])
        return np.where(self._nothing, np.nan, v[left])

    def _contributing(self) -> NDArray[np.bool_]:
        """Which distinct times go into at least one continuous value."""
        flag = np.zeros(len(self.t), bool)
        if self._on_grid and not self.coarse:
            return ~flag
        flag[np.maximum(self._left, 0)[self._between]] = True
        flag[self._right[self._between & (self._weight > 0)]] = True
        if self.coarse:
            full = ~self._no_sample
            edges = np.bincount(self._begin[full], minlength=len(flag) + 1)
            edges -= np.bincount(self._end[full], minlength=len(flag) + 1)
            flag |= np.cumsum(edges[:-1]) > 0
        return flag
