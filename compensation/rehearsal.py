"""Rehearsal: recordings played to a compensation in a closed loop, with sensors failing and a probe reading.

The plant is a recording: its temperatures do not depend on what is sent, so that its error plus the correction is what
a compensated machine would have shown. Rows are interpolated to the rate at which samples arrive at a machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from compensation.contracts import Correction, Sample
from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from features.rises import zeroed_error_um
from models.selection.updating import Readings

HOW = ("lost", "frozen", "stepping")
STEP_K = 15.0  # of a sensor that steps: a loose plug
_PAUSE_S = 10 * 3600.0  # between two recordings: a night
_FADE_S = 3600.0  # of it, at most, until what was sent has faded
_EPOCH_S = 1.7e9
GAP_S = 3600.0  # that is shown in its place


@dataclass(frozen=True)
class Failure:
    """A sensor that fails: `how` is one of `HOW`, from `start_s` to `end_s` after the start of the rehearsal."""

    channel: str
    how: str
    start_s: float
    end_s: float

    def applied(self, values: dict[str, float], time_s: float, frozen: dict[str, float]) -> None:
        """Changes the values of a sample."""
        if not (self.start_s <= time_s < self.end_s and self.channel in values):
            frozen.pop(self.channel, None)
        elif self.how == "lost":
            del values[self.channel]
        elif self.how == "frozen":
            values[self.channel] = frozen.setdefault(self.channel, values[self.channel])
        else:
            values[self.channel] += STEP_K


@dataclass(frozen=True)
class Rehearsal:
    """What came of it, n samples.

    Attributes:
        time_s: since the start, (n,); pauses between the recordings are cut to a gap of an hour.
        starts_s: of each recording, with its name.
        before_um, after_um, sent_um: error without and with compensation, and what was sent, by axis (n,).
        state, reason: by axis, of each sample.
        readings_s: times of the readings of a probe.
        failures: of sensors.
        simulated: whether the recordings are.
    """

    machine: str
    time_s: Array
    starts_s: Mapping[str, float]
    before_um: Mapping[str, Array]
    after_um: Mapping[str, Array]
    sent_um: Mapping[str, Array]
    state: Mapping[str, tuple[str, ...]]
    reason: Mapping[str, tuple[str, ...]]
    readings_s: tuple[float, ...]
    failures: tuple[Failure, ...]
    simulated: bool

    def band_um(self, axis: str) -> tuple[float, float]:
        """Width of the band that holds nineteen rows in twenty, before and after, µm."""
        return _band_um(self.before_um[axis]), _band_um(self.after_um[axis])

    def rms_um(self, axis: str) -> tuple[float, float]:
        """Root mean square, before and after, µm."""
        before, after = (float(np.sqrt(np.nanmean(e[axis] ** 2))) for e in (self.before_um, self.after_um))
        return before, after


def rehearse(
    batches: Sequence[Batch],
    axes: Sequence[str],
    exchange: Callable[[Sample], Correction],
    sample_s: float = 10.0,
    tick_s: float = 10.0,
    failures: Sequence[Failure] = (),
    readings: Readings | None = None,
    done: Callable[[int, int], None] = lambda n, of: None,
) -> Rehearsal:
    """Plays batches one after the other, a night apart.

    A correction acts from the sample after the one that it answers. A reading is the error that is left, as a probe
    finds it, and goes out with the sample of its time.

    Args:
        exchange: sends a sample and returns the answer.
        sample_s: time between two samples, s.
        tick_s: time between two looks at what is sent, s; at a machine it moves on between samples that are further
            apart.
        readings: when a probe reads the error of each recording; None: never.
        done: called with rows done and rows in all.

    Raises:
        InputError: an error channel or a failing sensor that the batches do not have.
    """
    for name in (*axes, *(f.channel for f in failures)):
        if any(name not in b.table for b in batches):
            raise InputError(
                f"rehearsal: the recordings have no channel {name!r}; {closest(name, batches[0].channels)}"
            )
    times, names = [], [c for c, spec in batches[0].channels.items() if c in batches[0].table and spec.role != "error"]
    series: dict[str, list[float]] = {f"{what} {a}": [] for what in ("before", "after", "sent") for a in axes}
    state: dict[str, list[str]] = {a: [] for a in axes}
    reason: dict[str, list[str]] = {a: [] for a in axes}
    starts_s, readings_s, shown_s, clock_s, frozen = {}, [], 0.0, _EPOCH_S, dict[str, float]()
    total = sum(int(b.time_s[-1] / sample_s) + 1 for b in batches)
    for batch in batches:
        at_s = np.arange(0.0, batch.time_s[-1] + 1e-9, sample_s)
        columns = {c: np.interp(at_s, batch.time_s, batch.masked(c)) for c in names}
        error_um = {a: np.interp(at_s, batch.time_s, zeroed_error_um(batch, a)) for a in axes}
        starts_s[batch.batch_id] = shown_s
        acting, due_s = dict.fromkeys(axes, 0.0), readings.first_s if readings else math.inf
        for k, t in enumerate(at_s):
            now_s = shown_s + float(t)
            for part in range(1, math.ceil(sample_s / tick_s - 1e-9) if k else 1):
                moved = exchange(Sample(clock_s + float(t) - sample_s + part * tick_s, {})).offset_um
                if all(moved[a] == acting[a] for a in axes):
                    break
                acting = {a: moved[a] for a in axes}
            values = {c: float(v[k]) for c, v in columns.items() if np.isfinite(v[k])}
            for f in failures:
                f.applied(values, now_s, frozen)
            left = {a: float(error_um[a][k]) + acting[a] for a in axes}
            reading = {}
            if readings and t >= due_s:
                due_s += readings.every_s
                reading = {a: v for a, v in left.items() if np.isfinite(v)}
                readings_s.append(now_s)
            answer = exchange(Sample(clock_s + float(t), values, reading))
            times.append(now_s)
            for a in axes:
                series[f"before {a}"].append(float(error_um[a][k]))
                series[f"after {a}"].append(left[a])
                series[f"sent {a}"].append(answer.offset_um[a])
                state[a].append(answer.state[a])
                reason[a].append(answer.reasons.get(a, ""))
                acting[a] = answer.offset_um[a]
            if k % 100 == 0:
                done(len(times), total)
        clock_s += float(at_s[-1])
        for k in range(1, int(_FADE_S / sample_s)):  # at night nothing arrives, and what is sent fades
            if not any(exchange(Sample(clock_s + k * sample_s, {})).offset_um.values()):
                break
        clock_s += _PAUSE_S
        shown_s += float(at_s[-1]) + GAP_S
    found = {what: {a: np.array(series[f"{what} {a}"]) for a in axes} for what in ("before", "after", "sent")}
    return Rehearsal(
        machine=batches[0].machine, time_s=np.array(times), starts_s=starts_s,
        before_um=found["before"], after_um=found["after"], sent_um=found["sent"],
        state={a: tuple(v) for a, v in state.items()}, reason={a: tuple(v) for a, v in reason.items()},
        readings_s=tuple(readings_s), failures=tuple(failures), simulated=any(b.simulated for b in batches),
    )  # fmt: skip


def failure(text: str) -> Failure:
    """`front:lost@3h+45min`: the sensor, how it fails, when and for how long.

    Raises:
        InputError: another form.
    """
    channel, _, rest = text.partition(":")
    how, _, when = rest.partition("@")
    start, _, length = when.partition("+")
    try:
        start_s, length_s = _seconds(start), _seconds(length)
    except ValueError:
        start_s = length_s = math.nan
    if how not in HOW or not channel or not (start_s >= 0 and length_s > 0):
        raise InputError(
            f"failure {text!r}: expected SENSOR:HOW@START+DURATION with HOW one of {', '.join(HOW)}, e.g. "
            "front:lost@3h+45min"
        )
    return Failure(channel, how, start_s, start_s + length_s)


def readings_of(text: str) -> Readings:
    """`1h`: one reading of each recording after an hour; `every 90 min`: one each 90 min.

    Raises:
        InputError: another form.
    """
    every, length = text.strip().startswith("every "), text.strip().removeprefix("every ")
    try:
        due_s = _seconds(length)
    except ValueError:
        due_s = math.nan
    if not 0 < due_s < math.inf:
        raise InputError(
            f"readings {text!r}: expected a time above 0 for one reading or an interval, e.g. 1h, every 90min"
        )
    return Readings(due_s, due_s if every else math.inf)


def _seconds(text: str) -> float:
    for unit, factor in (("min", 60.0), ("h", 3600.0), ("s", 1.0)):
        if text.endswith(unit):
            return float(text.removesuffix(unit)) * factor
    raise ValueError(text)


def _band_um(error_um: Array) -> float:
    low, high = np.nanquantile(error_um, (0.025, 0.975))
    return float(high - low)
