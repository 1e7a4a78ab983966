"""Which thermal test a batch is, told from its drivers: environment, rotating spindle, linear axis."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.batch import Batch
from data.errors import InputError, closest
from data.units import quantity
from twin.iso230_3.axis import Cycle, find_cycle

Array = NDArray[np.float64]
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
    """A stretch that is judged: from `start_s` to `end_s`, where the drivers change.

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
class Told:
    """What the drivers say: the kind, why, and the periods that belong to it; channel names where there are any."""

    kind: Kind
    words: str
    periods: tuple[Period, ...]
    speed: str | None
    feed: str | None
    cycle: Cycle | None


def tell_kind(batch: Batch, start_s: float, end_s: float, kind: str | None, where: str) -> Told:
    """The kind of test between two times of the batch; `kind` overrides what the drivers say.

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
        raise InputError(f"{where}: kind 'spindle' was asked for, but {why[0].lower()}{why[1:]}; leave the kind out")
    if found == "linear_axis" and cycle is None:
        raise InputError(
            f"{where}: kind 'linear_axis' was asked for, but no position channel cycles between two targets"
        )
    if found != "spindle" or running is None or rpm is None:
        told = why if found == guess else f"Taken as asked. {why}"
        return Told(found, told, (whole,), speed, feed, cycle if found == "linear_axis" else None)
    periods = _run_and_stop(time_s, running)
    words = _spindle_words(str(speed), np.abs(rpm), running, periods, time_s)
    return Told(found, words + (f" Meanwhile {axes}." if axes else ""), periods, speed, feed, None)


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
        return "other", "No channel gives the spindle speed, so the kind of test cannot be told."
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


def _spindle_words(
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
