"""Thermal tests in the style of ISO 230-3: ranges, tilts, d(60 min) and d(t) from a recording or a simulation.

For every displacement and tilt, over every period: range = greatest minus least reading; d(t) = change from the last
reading before the period's start to its end, with sign; d(60 min) = the same to 60 min after the start. Readings are
taken as they are, not smoothed; masked ones are left out. The evaluation follows the standard's quantities;
no compliance with it is claimed.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from data.units import quantity

_NEAR, _ON_TARGET, _LEAST_SHARE, _LEAST_STAYS = 0.1, 0.02, 0.3, 2  # of the stroke; of the readings


@dataclass(frozen=True)
class Cycle:
    """Positioning cycle: `stay` (rows,) numbers the stays, -1 while moving; `at_high` (stays,) marks the far end."""

    channel: str
    low_mm: float
    high_mm: float
    stay: NDArray[np.int64]
    at_high: NDArray[np.bool_]
    rows: NDArray[np.bool_]

    @property
    def n(self) -> int:
        """How many stays at the farther target."""
        return int(self.at_high.sum())


def find_cycle(batch: Batch, channel: str, rows: NDArray[np.bool_]) -> Cycle | None:
    """The cycle of a position channel over the given rows of the batch; None where it does not go to and fro.

    A reading is at a target within 2 % of the stroke. At least two stays at either target and 30 % of the readings
    there make a cycle.
    """
    position = batch.values(channel)[rows]
    finite = position[np.isfinite(position)]
    if len(finite) < 4:
        return None
    least, stroke = float(finite.min()), float(np.ptp(finite))
    if stroke <= 2 * (batch.channels[channel].resolution or 0.0) or stroke <= 1e-3:
        return None
    low = float(np.median(finite[finite <= least + _NEAR * stroke]))
    high = float(np.median(finite[finite >= least + (1 - _NEAR) * stroke]))
    side = np.zeros(len(position), int)
    side[np.abs(position - low) <= _ON_TARGET * stroke] = -1
    side[np.abs(position - high) <= _ON_TARGET * stroke] = 1
    there = np.flatnonzero(side)
    if len(there) < _LEAST_SHARE * len(position):
        return None
    new = np.r_[True, np.diff(side[there]) != 0]
    stay = np.full(len(position), -1)
    stay[there] = np.cumsum(new) - 1
    at_high = side[there][new] > 0
    if min(at_high.sum(), (~at_high).sum()) < _LEAST_STAYS:
        return None
    return Cycle(channel, low, high, stay, at_high, rows)


def stays(cycle: Cycle, time_s: Array, values: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """(times, means) of the readings of every stay at the lower target, then at the farther one; empty stays left out.

    `time_s` and `values` (batch rows,).
    """
    t, v = time_s[cycle.rows], values[cycle.rows]
    good = (cycle.stay >= 0) & np.isfinite(v)
    n = len(cycle.at_high)
    count = np.bincount(cycle.stay[good], minlength=n)
    with np.errstate(invalid="ignore"):
        when = np.bincount(cycle.stay[good], t[good], n) / count
        mean = np.bincount(cycle.stay[good], v[good], n) / count
    low, high = (count > 0) & ~cycle.at_high, (count > 0) & cycle.at_high
    return (when[low], mean[low]), (when[high], mean[high])


def span(low: tuple[Array, Array], high: tuple[Array, Array]) -> tuple[Array, Array]:
    """(times, error at the farther target minus that at the lower one), the latter taken linearly between its stays."""
    (low_s, at_low), (high_s, at_high) = low, high
    if not len(low_s) or not len(high_s):
        return np.empty(0), np.empty(0)
    inside = (high_s >= low_s[0]) & (high_s <= low_s[-1])
    return high_s[inside], at_high[inside] - np.interp(high_s[inside], low_s, at_low)


Kind = Literal["environment", "spindle", "linear_axis", "other"]
KINDS: tuple[str, ...] = get_args(Kind)

TITLES = {
    "environment": "Environmental variation error",
    "spindle": "Rotating-spindle test",
    "linear_axis": "Linear-axis test",
    "other": "Thermal drift",
}
_STILL_RPM, _STILL_SHARE = 1.0, 0.01


@dataclass(frozen=True)
class Period:
    """An evaluated interval from `start_s` to `end_s`, where the drivers change.

    `zero_s` is the reading that changes count from, the last one before the start if there is one; `last_s` the last
    reading that still belongs to it.
    """

    name: str
    start_s: float
    end_s: float
    zero_s: float
    last_s: float

    @property
    def length_s(self) -> float:
        return self.end_s - self.start_s


@dataclass(frozen=True)
class TestKind:
    """The kind of test that the drivers show, an explanation, its periods, and the channels involved if any."""

    kind: Kind
    explanation: str
    periods: tuple[Period, ...]
    speed: str | None
    feed: str | None
    cycle: Cycle | None


def kind_of_test(batch: Batch, start_s: float, end_s: float, kind: str | None, where: str) -> TestKind:
    """The kind of test between two times of the batch; `kind` overrides the drivers.

    The spindle counts as running above 1 rpm and 1 % of its highest speed. An axis test needs a position channel that
    goes back and forth between two targets.

    Raises:
        InputError: an unknown kind, or one that the drivers contradict (no run, no cycle).
    """
    if kind is not None and kind not in KINDS:
        raise InputError(f"{where}: unknown kind of test {kind!r}; {closest(kind, KINDS)}")
    rows = (batch.time_s >= start_s - 1e-6) & (batch.time_s <= end_s + 1e-6)
    time_s = batch.time_s[rows]
    speed, rpm = _held(batch, "rotation", rows)
    feed, per_min = _held(batch, "feed", rows)
    top = float(np.abs(rpm).max()) if rpm is not None else 0.0
    resolution = (batch.channels[speed].resolution or 0.0) if speed else 0.0
    running = np.abs(rpm) > max(_STILL_RPM, resolution / 2, _STILL_SHARE * top) if rpm is not None else None
    ran = running is not None and bool(running.any())
    fed = per_min is not None and bool((np.abs(per_min) > 0).any())
    cycles = (find_cycle(batch, name, rows) for name in batch.names("position"))
    cycle = next((c for c in cycles if c is not None), None)
    axes = f"the axes moved ({feed} up to {np.abs(per_min).max():g} mm/min)" if per_min is not None and fed else ""
    whole = Period("whole period", float(time_s[0]), float(time_s[-1]), float(time_s[0]), float(time_s[-1]))
    guess, why = _guess(ran, speed, axes, cycle)
    found: Kind = kind or guess  # type: ignore[assignment]
    if found == "spindle" and (running is None or rpm is None or not ran):
        raise InputError(f"{where}: kind 'spindle' was requested, but {why[0].lower()}{why[1:]}; leave the kind out")
    if found == "linear_axis" and cycle is None:
        raise InputError(
            f"{where}: kind 'linear_axis' was requested, but no position channel cycles between two targets"
        )
    if found != "spindle" or running is None or rpm is None:
        explanation = why if found == guess else f"As requested. {why}"
        return TestKind(found, explanation, (whole,), speed, feed, cycle if found == "linear_axis" else None)
    periods = _run_and_stop(time_s, running)
    explanation = _spindle_text(str(speed), np.abs(rpm), running, periods, time_s)
    return TestKind(found, explanation + (f" Meanwhile {axes}." if axes else ""), periods, speed, feed, None)


def _held(batch: Batch, measured: str, rows: NDArray[np.bool_]) -> tuple[str | None, Array | None]:
    """The first driver of that quantity with its last value held over holes, (rows,); None where none was recorded."""
    for name in batch.names("driver"):
        if quantity(batch.channels[name].unit) == measured:
            values = np.asarray(pd.Series(batch.values(name)[rows]).ffill().bfill(), np.float64)
            if len(values) and np.isfinite(values).all():
                return name, values
    return None, None


def _guess(ran: bool, speed: str | None, axes: str, cycle: Cycle | None) -> tuple[Kind, str]:
    if cycle is not None:
        moved = f"{cycle.channel} went {cycle.n} times between {cycle.low_mm:g} and {cycle.high_mm:g} mm"
        if ran:
            return "other", f"The spindle ran while {moved}: a mixed run, none of the single tests."
        return "linear_axis", f"The axis {moved}{', spindle stopped' if speed else ''}."
    if ran:
        return "spindle", ""
    if axes:
        stood = "The spindle stood still" if speed else "No channel gives the spindle speed"
        return "other", f"{stood} while {axes}, and no position was recorded."
    if speed is None:
        return "other", "No channel gives the spindle speed, so the kind of test is unknown."
    return "environment", "The spindle stood still all the time."


def _run_and_stop(time_s: Array, running: NDArray[np.bool_]) -> tuple[Period, ...]:
    """From the first to the last running reading, short stops inside included; then what follows."""
    on = np.flatnonzero(running)
    first, last = int(on[0]), int(on[-1])
    stop = min(last + 1, len(time_s) - 1)
    warm = Period(
        "warm-up", float(time_s[first]), float(time_s[stop]), float(time_s[max(first - 1, 0)]), float(time_s[last])
    )
    if stop == last or stop == len(time_s) - 1:
        return (warm,)
    end_s = float(time_s[-1])
    return warm, Period("after the stop", float(time_s[stop]), end_s, float(time_s[last]), end_s)


def _spindle_text(
    speed: str, rpm: Array, running: NDArray[np.bool_], periods: tuple[Period, ...], time_s: Array
) -> str:
    levels = np.unique(np.round(rpm[running]))
    warm = periods[0]
    first, last = np.flatnonzero(running)[[0, -1]]
    rest_s = float(np.diff(time_s)[first:last][~running[first:last]].sum())
    if len(levels) == 1:
        at = f"{levels[0]:g} rpm"
    elif np.ptp(levels) <= 0.05 * levels[-1]:
        at = f"about {np.median(rpm[running]):.0f} rpm"
    else:
        at = f"{levels[0]:g} to {levels[-1]:g} rpm (speed spectrum)"
    parts = [f"stood still for {clock(warm.start_s - float(time_s[0]))} h"] if first > 0 else []
    parts.append(f"ran at {at} for {clock(warm.length_s)} h{f', {clock(rest_s)} h of it at rest' if rest_s else ''}")
    parts += [f"stood still for {clock(p.length_s)} h" for p in periods[1:]]
    return f"The spindle ({speed}) {', then '.join(parts)}{'' if len(periods) > 1 else ', to the end'}."


def clock(time_s: float) -> str:
    """Hours and minutes: 4:05."""
    minutes = round(time_s / 60)
    return f"{minutes // 60}:{minutes % 60:02d}"


HOUR_S = 3600.0
QUANTITIES = ("range", "range in 60 min", "d(60 min)", "d(t)")
_REACH_S = 300.0  # a reading is taken linearly across a hole up to this long
_STUCK = 10  # equal readings one after the other; noise alone would move a live probe
_AXIS = re.compile(r"(?:disp|error|err|d)?[_ ]?([xyz]\d?)(?:_um)?", re.IGNORECASE)


@dataclass(frozen=True)
class ProbePair:
    """Two probes at a distance along the spindle: tilt = (first - second) / distance. Name it A (Y) or B (X)."""

    name: str
    first: str
    second: str
    distance_mm: float


@dataclass(frozen=True)
class Trace:
    """One displacement or tilt over the test, `value` (n,) zeroed at the test's start; NaN where nothing was read."""

    name: str
    unit: str
    time_s: Array
    value: Array
    digits: int
    every_stay: bool = False  # one value a stay at a target, not one a row


@dataclass(frozen=True)
class ThermalTest:
    """A test with its numbers.

    `quantities` has one row per period, trace and quantity (simulated, period, start_s, end_s, channel, quantity,
    value, unit); `temperatures` one row per channel (channel, role, start_degC, end_degC, least_degC, greatest_degC).
    """

    machine: str
    batch_id: str
    simulated: bool
    kind: Kind
    explanation: str
    start_s: float
    end_s: float
    periods: tuple[Period, ...]
    traces: tuple[Trace, ...]
    quantities: pd.DataFrame
    temperatures: pd.DataFrame
    speed: str | None
    feed: str | None
    position: str | None
    pairs: tuple[ProbePair, ...]
    notes: tuple[str, ...]

    @property
    def title(self) -> str:
        """The kind's name, marked if simulated."""
        return TITLES[self.kind] + (" (SIMULATED)" if self.simulated else "")

    def value(self, channel: str, quantity: str, period: str | None = None) -> float:
        """One number; the first period where none is named.

        Raises:
            InputError: no such channel, quantity or period.
        """
        table = self.quantities
        wanted = {"channel": channel, "quantity": quantity, "period": period or self.periods[0].name}
        for column, name in wanted.items():
            if name not in set(table[column]):
                raise InputError(
                    f"thermal test of {self.batch_id}: no {column} {name!r}; {closest(name, set(table[column]))}"
                )
            table = table[table[column] == name]
        return float(table["value"].iloc[0])


def thermal_test(
    batch: Batch,
    pairs: Sequence[ProbePair] = (),
    axes: Mapping[str, str] | None = None,
    kind: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> ThermalTest:
    """Evaluate a batch as the thermal test that its drivers show, or as `kind`.

    `axes` maps labels to error channels ({"X": "disp_x"}); without it every error channel is taken, x, disp_y, z1
    under the labels X, Y, Z1. `pairs` name channels or labels. `start_s` and `end_s` state the period; default all.

    Raises:
        InputError: no displacement, an unknown channel, a distance of 0 or less, a period outside of the record or
            with fewer than two readings, a kind that the drivers contradict.
    """
    where = f"batch {batch.batch_id} of {batch.machine}"
    begin, end = _stated(batch, start_s, end_s, where)
    labels = _labels(batch, axes, where)
    found = kind_of_test(batch, begin, end, kind, where)
    raw = {
        label: (batch.masked(name), batch.channels[name].unit, _digits(batch, name)) for label, name in labels.items()
    }
    raw |= {p.name: (_tilt(batch, p, labels, where), "um/m", 1) for p in pairs}
    rows = (batch.time_s >= begin - 1e-6) & (batch.time_s <= end + 1e-6)
    empty = set(batch.names("error")) - set(labels.values()) if axes is None else ()
    notes = [f"{n}: no reading, left out." for n in batch.names("error") if n in empty]
    traces: list[Trace] = []
    for name, (values, unit, digits) in raw.items():
        missing = int(np.isnan(values[rows]).sum())
        if rows.sum() - missing < 2:
            raise InputError(
                f"{where}: {name} has {rows.sum() - missing} readings from {clock(begin)} to {clock(end)} h,"
                " expected at least 2; choose another period, or leave it out by axes"
            )
        if missing and found.cycle is None:
            notes.append(f"{name}: {missing} of {rows.sum()} readings are missing or masked.")
        if found.cycle is None:
            traces.append(Trace(name, unit, batch.time_s[rows], values[rows], digits))
            continue
        low, high = stays(found.cycle, batch.time_s, values)
        parts = {f"{found.cycle.low_mm:g} mm": low, f"{found.cycle.high_mm:g} mm": high, "span": span(low, high)}
        traces += [
            Trace(f"{name} {n}" if n == "span" else f"{name} at {n}", unit, t, v, digits, True)
            for n, (t, v) in parts.items()
        ]  # fmt: skip
    records = [r for p in found.periods for t in traces for r in _records(t, p, batch.step_s, batch.simulated)]
    notes += [
        f"{t.name} did not change at all {p.name if p.name.startswith('after') else f'in the {p.name}'}; was it read?"
        for p in found.periods
        for t in traces
        if _stuck(t, p)
    ]
    notes += [
        f"{p.name[0].upper()}{p.name[1:]}: {clock(p.length_s)} h, shorter than 60 min, so there is no d(60 min)."
        for p in found.periods
        if p.length_s < HOUR_S - batch.step_s / 2
    ]
    return ThermalTest(
        batch.machine, batch.batch_id, batch.simulated, found.kind, found.explanation, begin, end, found.periods,
        tuple(_zeroed(t, found.periods[0], batch.step_s) for t in traces),
        pd.DataFrame(records), _temperatures(batch, rows), found.speed, found.feed,
        found.cycle.channel if found.cycle else None, tuple(pairs), tuple(notes),
    )  # fmt: skip


def _stated(batch: Batch, start_s: float | None, end_s: float | None, where: str) -> tuple[float, float]:
    last = float(batch.time_s[-1]) if batch.n_rows else 0.0
    if batch.n_rows < 2:
        raise InputError(f"{where}: {batch.n_rows} rows, expected at least 2; record longer")
    begin, end = 0.0 if start_s is None else start_s, last if end_s is None else end_s
    if not 0 <= begin < end <= last + 1e-6:
        raise InputError(
            f"{where}: the period {begin:g} to {end:g} s does not lie in the record, 0 to {last:g} s; correct it"
        )
    if (rows := int(((batch.time_s >= begin - 1e-6) & (batch.time_s <= end + 1e-6)).sum())) < 2:
        raise InputError(f"{where}: the period {begin:g} to {end:g} s holds {rows} readings, expected at least 2")
    return begin, end


def _labels(batch: Batch, axes: Mapping[str, str] | None, where: str) -> dict[str, str]:
    """Label -> error channel."""
    errors = batch.names("error")
    if not errors:
        raise InputError(f"{where}: no channel of role error, so no displacement to evaluate; record or simulate one")
    if axes is not None:
        for name in axes.values():
            if name not in errors:
                raise InputError(f"{where}: no error channel {name!r}; {closest(name, errors)}")
        return dict(axes)
    found = {name: _AXIS.fullmatch(name) for name in errors if np.isfinite(batch.masked(name)).any()}
    if not found:
        raise InputError(f"{where}: {', '.join(errors)} hold no reading; record the displacement or lift the masks")
    labels = {m[1].upper() if m else name: name for name, m in found.items()}
    return labels if len(labels) == len(found) else {n: n for n in found}


def _tilt(batch: Batch, pair: ProbePair, labels: Mapping[str, str], where: str) -> Array:
    """(first - second) / distance in um/m, (n,)."""
    if not (np.isfinite(pair.distance_mm) and pair.distance_mm > 0):
        raise InputError(f"{where}: tilt {pair.name}: distance {pair.distance_mm:g} mm, expected more than 0")
    both = []
    for given in (pair.first, pair.second):
        name = labels.get(given, given)
        if name not in batch.names("error"):
            raise InputError(
                f"{where}: tilt {pair.name}: no error channel {given!r}; {closest(given, batch.names('error'))}"
            )
        if batch.channels[name].unit != "um":
            raise InputError(f"{where}: tilt {pair.name}: {name} is in {batch.channels[name].unit}, expected um")
        both.append(batch.masked(name))
    tilt: Array = 1000.0 * (both[0] - both[1]) / pair.distance_mm
    return tilt


def _digits(batch: Batch, name: str) -> int:
    """Decimals that the instrument's resolution carries."""
    resolution = batch.channels[name].resolution
    return 1 if resolution is None else int(np.clip(np.ceil(-np.log10(resolution) - 1e-9), 0, 2))


def _zeroed(trace: Trace, period: Period, step_s: float) -> Trace:
    zero = float("nan") if trace.every_stay else _at(trace, period.zero_s, step_s)
    if not np.isfinite(zero):
        good = trace.value[np.isfinite(trace.value)]
        zero = good[0] if len(good) else np.nan
    return Trace(trace.name, trace.unit, trace.time_s, trace.value - zero, trace.digits, trace.every_stay)


def _at(trace: Trace, time_s: float, step_s: float) -> float:
    """The reading at a time, linearly between readings no farther apart than 5 min (or two steps); else NaN."""
    good = np.isfinite(trace.value)
    t, v = trace.time_s[good], trace.value[good]
    if not len(t):
        return float("nan")
    reach_s = max(_REACH_S, 2 * step_s)
    k = int(np.searchsorted(t, time_s - 1e-6))
    if k < len(t) and abs(t[k] - time_s) < 1e-3:
        return float(v[k])
    if 0 < k < len(t):
        return float(np.interp(time_s, t, v)) if t[k] - t[k - 1] <= reach_s + 1e-6 else float("nan")
    near = min(k, len(t) - 1)
    return float(v[near]) if abs(t[near] - time_s) <= reach_s / 2 else float("nan")


def _records(trace: Trace, period: Period, step_s: float, simulated: bool) -> list[dict[str, object]]:
    inside = (trace.time_s >= period.zero_s - 1e-6) & (trace.time_s <= period.last_s + 1e-6)
    values = trace.value[inside]
    first_hour = trace.time_s[inside] <= period.start_s + HOUR_S + 1e-6
    long_enough = period.length_s >= HOUR_S - step_s / 2
    if trace.every_stay:  # stays are not at fixed times: the first one is the zero
        good = np.flatnonzero(np.isfinite(values))
        zero, last = (values[good[0]], values[good[-1]]) if len(good) else (np.nan, np.nan)
        t = trace.time_s[inside]
        hour = np.interp(period.start_s + HOUR_S, t, values) if len(t) and t[-1] >= period.start_s + HOUR_S else np.nan
    else:
        zero, last = _at(trace, period.zero_s, step_s), _at(trace, period.last_s, step_s)
        hour = _at(trace, min(period.start_s + HOUR_S, period.last_s), step_s)
    numbers = (
        _range(values),
        _range(values[first_hour]) if long_enough else np.nan,
        hour - zero if long_enough else np.nan,
        last - zero,
    )
    head = {"simulated": simulated, "period": period.name, "start_s": period.start_s, "end_s": period.end_s}
    return [
        {**head, "channel": trace.name, "quantity": q, "value": float(v), "unit": trace.unit}
        for q, v in zip(QUANTITIES, numbers, strict=True)
    ]


def _stuck(trace: Trace, period: Period) -> bool:
    inside = (trace.time_s >= period.start_s) & (trace.time_s <= period.last_s) & np.isfinite(trace.value)
    return inside.sum() >= _STUCK and _range(trace.value[inside]) < 1e-9


def _range(values: Array) -> float:
    good = values[np.isfinite(values)]
    return float(np.ptp(good)) if len(good) > 1 else float("nan")


def _temperatures(batch: Batch, rows: NDArray[np.bool_]) -> pd.DataFrame:
    columns = ["channel", "role", "start_degC", "end_degC", "least_degC", "greatest_degC"]
    out = []
    for name in batch.names("temperature", "ambient"):
        values = batch.masked(name)[rows]
        good = values[np.isfinite(values)]
        numbers = (good[0], good[-1], good.min(), good.max()) if len(good) else (np.nan,) * 4
        out.append(dict(zip(columns, (name, batch.channels[name].role, *numbers), strict=True)))
    return pd.DataFrame(out, columns=columns)
