"""Compensation as it runs: samples in, corrections out.

One `Compensator` serves one machine. A sample passes the guard of the sensors, then every axis runs its model as a
program on a grid of `period_s`, corrects it by what a probe has measured, weighs it by how far the machine is outside
the trained region, and hands it to the state machine of `compensation.safety`. Nothing of a run is kept but the states,
so memory does not grow, and `as_plain` is all that a restart needs.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from compensation import safety
from compensation.contracts import Correction, Sample
from compensation.safety import ENDS, STOPPED, Axis, Limits, SampleClock
from compensation.substitutes import Guard, Substitutes, Watch
from data.arrays import Array
from data.errors import InputError
from models.numerics.kernels import scale_of
from models.program import Program, State
from models.selection.conformal import RunBound
from models.selection.trust import Region, worth
from models.selection.updating import State as Learned
from models.selection.updating import Updater

SCHEMA = "thermodrift.compensation/2"
_ODD_READING_SD = 4.0  # of what the filter expects: beyond it a reading is a failed probing, not thermal error
_MOST_BOUNDS = 5.0  # times what nine in ten runs stay below: no machine changes so much between two readings
_INTERVALS = 20  # of samples, whose median is how often they arrive
_LOST_SAMPLES = 5  # in a row are silence
_LEAST_UM2 = 1e-12  # a variance of rounding alone
_NEW_RUN_S = 4 * 3600.0  # of silence: the machine has cooled down unseen, so that the model starts again at 0
_MOST_BEATS = 2**31  # what a counter of a control holds
_MM_PER_M = 1000.0


@dataclass(frozen=True)
class AxisModel:
    """One error channel's model, ready to run.

    Attributes:
        axis: error channel.
        program: gives the error in µm, along an axis also its slope in µm/mm.
        inputs, units: features of the family, with the unit of each, that readings scale with.
        region, watched: where the model was trained, and the program of the quantities it watches.
        bound: how the error grows outside of it; None where that is not known.
        updater: the filter of readings; None where it could not be learned.
        limits: of what is sent; along an axis they hold at the reference position and at its farther end.
        lever_mm: of an error along an axis the greatest distance from the reference position, at which a change of the
            slope moves the tool the most.
        share: of the correction that the measured trust in the model supports, above 0 up to 1.
        remark: on the model, in every record; empty: none.
        readings_um: least and greatest plausible reading of a probe, µm.
    """

    axis: str
    program: Program
    inputs: tuple[str, ...]
    units: tuple[str, ...]
    region: Region
    watched: Program
    bound: RunBound | None = None
    updater: Updater | None = None
    limits: Limits = field(default_factory=Limits)
    lever_mm: float = 1000.0
    share: float = 1.0
    remark: str = ""
    readings_um: tuple[float, float] = (-math.inf, math.inf)

    def __post_init__(self) -> None:
        """Raises InputError where the share is not above 0 up to 1."""
        if not 0.0 < self.share <= 1.0:
            raise InputError(f"axis {self.axis}: got authority {self.share!r}, expected above 0 up to 1; train again")

    def authority(self, distance: float) -> float:
        """Share of the correction that is applied so far outside of the trained region, in widths, at most `share`."""
        return min(self.share, float(worth(distance, self.tested)))

    @property
    def tested(self) -> float:
        """How far outside of their training's region runs were that were left out, in widths."""
        return self.bound.tested if self.bound is not None else 0.0

    @property
    def largest_surprise_um(self) -> float:
        """How far a reading may be from what is expected, µm: beyond it the probing failed, however often it is so."""
        bound_um = self.bound.bound_um if self.bound is not None else math.nan
        return _MOST_BOUNDS * bound_um if math.isfinite(bound_um) else self.limits.max_offset_um


@dataclass
class _Running:
    """State of one axis."""

    model: State
    region: State
    learned: Learned | None
    safety: Axis
    slope_safety: Axis  # of the slope's part at the lever
    error_um: float = 0.0  # of the last row, with readings
    free_um: float = math.nan  # of the last row, of the model alone, times its share
    scaled: Array = field(default_factory=lambda: np.zeros(0))  # inputs of the last row, for the filter
    slope_um_per_mm: float = 0.0
    odd_um: float = math.nan  # of the last reading, where it was rejected: how far it was off
    trust: float = 1.0  # what the distance from the trained region leaves of the share
    why: str = ""
    at_s: float = 0.0  # since the start of the run


class Compensator:
    """The corrections of a machine's axes.

    Args:
        machine: name.
        axes: their models.
        substitutes: learned at training; None: sensors are not guarded.
        period_s: grid on which the models run, s; they are made for it.
        log: called with one line for everything that is noticed.
    """

    def __init__(
        self,
        machine: str,
        axes: Sequence[AxisModel],
        substitutes: Substitutes | None = None,
        period_s: float = 10.0,
        log: Callable[[str], None] = lambda line: None,
    ) -> None:
        if not axes:
            raise InputError(f"compensation of {machine}: no axis given; name at least one model")
        for a in axes:
            if a.program.step_s != period_s or a.watched.step_s != period_s:
                raise InputError(
                    f"compensation of {machine}: axis {a.axis} is made for {a.program.step_s:g} s, got a period of "
                    f"{period_s:g} s; make the program for that period"
                )
        self.machine, self.axes, self.period_s, self.log = machine, tuple(axes), period_s, log
        self.guard = Guard(substitutes) if substitutes is not None else None
        self._watch = self.guard.begin() if self.guard is not None else None
        self._steps = {a.axis: (a.program.runner(), a.watched.runner(), a.region.row()) for a in axes}
        # places of the inputs among the watched quantities, and what each is divided by
        self._inputs = {
            a.axis: ([list(a.region.ranges).index(i) for i in a.inputs], np.array([scale_of(u) for u in a.units]))
            for a in axes
        }
        self._wanted = tuple(dict.fromkeys(c for a in axes for c in a.program.channels))
        self._run = {a.axis: self._fresh(a) for a in axes}
        self.stopped = False  # by the operator
        self._clock = SampleClock()
        self._grid_s: float | None = None  # time of the grid's last row: a time stamp less `SampleClock.shift_s`
        self._held: dict[str, float] = {}
        self._arrived_s: dict[str, float] = {}  # when each channel last had a value
        self._patience_s = max(a.limits.stale_s for a in axes)
        self.rejected = 0
        self._intervals_s: deque[float] = deque(maxlen=_INTERVALS)  # between samples, on the monotonic clock
        self._last_clock_s: float | None = None
        self._limits = {a.axis: a.limits for a in axes}
        self._heartbeat = 0

    @property
    def tick_s(self) -> float:
        """The least `Limits.tick_s` of the axes, s."""
        return min(a.limits.tick_s for a in self.axes)

    @property
    def behind_um(self) -> float:
        """How far what is sent is from where its limits let it go, µm."""
        return max(s.behind_um for run in self._run.values() for s in (run.safety, run.slope_safety))

    def _fresh(self, a: AxisModel, was: _Running | None = None) -> _Running:
        learned = a.updater.begin() if a.updater is not None else None
        sent = (was.safety, was.slope_safety) if was is not None else (Axis(), Axis())
        return _Running(a.program.begin(), a.watched.begin(), learned, *sent)

    def begin_run(self) -> None:
        """Starts a new run: the error is 0 from here on, as after a new reference of the tool. What is sent returns
        there within its limits."""
        self._run = {a.axis: self._fresh(a, self._run[a.axis]) for a in self.axes}
        self._grid_s = None

    def confirm(self, levels: bool = False) -> None:
        """The operator confirms the sensors as they are from here on: a new run begins, none counts as failed. Their
        levels are compared no more, unless `levels`."""
        self._watch = self.guard.begin(levels) if self.guard is not None else None
        self._held, self._arrived_s = {}, {}
        self.begin_run()

    def take(self, sample: Sample, clock_s: float) -> Correction:
        """The correction after a sample; `clock_s` is the monotonic clock of the runtime, s.

        A sample without values only brings readings.
        """
        if not sample.values or sample.time_s == self._clock.last_s:  # one that is repeated is no new sample
            self._read_all(sample)
            return self.silence(clock_s, sample.time_s)
        if self._last_clock_s is not None and clock_s > self._last_clock_s:
            self._intervals_s.append(clock_s - self._last_clock_s)
            self._limits = self._limits_now()
        self._last_clock_s = clock_s if math.isfinite(clock_s) else self._last_clock_s
        narrowest = min(self._limits.values(), key=lambda limits: limits.stale_s)
        self._clock, fault = self._clock.judged(narrowest, self._last_clock_s or 0.0, sample.time_s)
        notes = ""
        if fault is None:  # no other sample moves the models
            fault, notes = self._advance(sample.values, sample.time_s - self._clock.shift_s)
            self._read_all(sample)
        elif sample.readings_um:
            self.log(f"reading of {', '.join(sample.readings_um)} not used: {fault}")
        wanted = {}
        for a in self.axes:
            run = self._run[a.axis]
            wanted[a.axis] = (-run.error_um, -run.slope_um_per_mm * a.lever_mm)
        return self._sent(
            sample.time_s,
            lambda a, was, k: safety.step(
                was, self._limits[a.axis], clock_s, wanted[a.axis][k], self._run[a.axis].trust, fault, self._stop
            ),
            notes,
        )

    def silence(self, clock_s: float, time_s: float, ends: bool = False) -> Correction:
        """The correction while nothing arrives; `time_s` is stamped on it.

        `ends`: the compensation ends and every axis fades out. That is no stop: a restart begins with warm-up.
        """
        stop = self._stop or (ENDS if ends else "")
        return self._sent(time_s, lambda a, was, k: safety.silence(was, self._limits[a.axis], clock_s, stop))

    def fault(self, clock_s: float, time_s: float, why: str) -> Correction:
        """The correction where nothing else can be computed: every axis holds what it has, and fades after hold_s."""
        return self._sent(
            time_s, lambda a, was, k: safety.step(was, self._limits[a.axis], clock_s, 0.0, 1.0, why, self._stop)
        )

    def _limits_now(self) -> dict[str, Limits]:
        """The axes' limits; input is stale after a few of the stream's own intervals where that is sooner."""
        if len(self._intervals_s) < _INTERVALS:
            return self._limits
        own_s = max(_LOST_SAMPLES * float(np.median(self._intervals_s)), Limits.stale_s)
        return {a.axis: replace(a.limits, stale_s=own_s) if own_s < a.limits.stale_s else a.limits for a in self.axes}

    def stop(self) -> None:
        """The operator stops: every axis fades out and stays off, also after a restart."""
        self.stopped = True

    def start(self) -> None:
        """The operator ends a stop: every axis becomes active after warm-up."""
        self.stopped = False

    @property
    def _stop(self) -> str:
        return STOPPED if self.stopped else ""

    def _sent(
        self, time_s: float, step: Callable[[AxisModel, Axis, int], tuple[Axis, float, str]], notes: str | None = None
    ) -> Correction:
        """The correction from a step of every state machine: number 0 of an axis is its offset, 1 its slope."""
        offset: dict[str, float] = {}
        slope: dict[str, float] = {}
        state, reasons = {}, {}
        for a in self.axes:
            run = self._run[a.axis]
            run.safety, offset[a.axis], reason = step(a, run.safety, 0)
            if a.program.along:
                run.slope_safety, part_um, _ = step(a, run.slope_safety, 1)
                slope[a.axis] = part_um / a.lever_mm * _MM_PER_M
            state[a.axis] = run.safety.state
            why = run.why if notes is not None else ""
            behind_um = run.safety.behind_um
            limited = f"rate limited: {behind_um:.3g} um behind" if behind_um > self._limits[a.axis].step_um else ""
            reasons[a.axis] = "; ".join(r for r in (reason, limited, why, notes, a.remark) if r)
        self._heartbeat = (self._heartbeat + 1) % _MOST_BEATS
        until_s = time_s + min(self._limits[a.axis].stale_s for a in self.axes)
        return Correction(time_s, offset, slope, state, reasons, self._heartbeat, until_s)

    def _advance(self, given: Mapping[str, float], time_s: float) -> tuple[str | None, str]:
        """Takes the models to the time of a sample: why it cannot be used, and what was replaced in it."""
        since_s = 0.0 if self._grid_s is None else time_s - self._grid_s
        if since_s < -self._patience_s:
            self.log(f"the clock is {-since_s / 3600:.1f} h behind the saved state: a new run begins")
            self.confirm(levels=True)
        values, fault, notes = dict(given), None, ""
        if self.guard is not None and self._watch is not None:
            self._watch, checked = self.guard.step(self._watch, time_s, given)
            values, fault, notes = dict(checked.values), checked.fault, checked.reason
        clean = {c: float(v) for c, v in values.items() if v is not None and math.isfinite(v)}
        self._arrived_s |= dict.fromkeys(clean, time_s)
        if fault is None and self._grid_s is not None and (lost := self._lost(time_s)):
            fault = f"lost: {', '.join(lost)}"  # channels that no regression replaces
        if fault is not None:
            return fault, notes
        if since_s > _NEW_RUN_S:
            self.log(f"silent for {since_s / 3600:.1f} h: a new run begins")
            self.begin_run()
        if self._grid_s is None:
            self._held = clean
            if missing := [c for c in self._wanted if c not in clean]:
                return f"not yet seen: {', '.join(missing)}", notes
            self._rows(time_s, [clean])
            return None, notes
        rows = int((time_s - self._grid_s) / self.period_s + 1e-9)
        if rows > 0:
            whole = {**self._held, **clean}
            shares = (np.arange(rows) + 1) / rows  # a longer gap is bridged by a straight line
            between = [{c: (h := self._held.get(c, v)) + w * (v - h) for c, v in whole.items()} for w in shares]
            self._held = whole
            self._rows(self._grid_s + rows * self.period_s, between)
        return None, notes

    def _lost(self, time_s: float) -> list[str]:
        return [c for c in self._wanted if time_s - self._arrived_s.get(c, time_s) > self._patience_s]

    def _rows(self, time_s: float, rows: Sequence[Mapping[str, float]]) -> None:
        """Steps every model through rows of the grid, the last one at `time_s`."""
        self._grid_s = time_s
        for a in self.axes:
            run, (step, watch, far) = self._run[a.axis], self._steps[a.axis]
            for values in rows:
                run.at_s += self.period_s if run.model.started else 0.0
                out = step(run.model, _row(a.program, values))
                seen = watch(run.region, _row(a.watched, values))
            # A reading corrects what is sent, so that the filter follows the share of the prediction and not the whole.
            out = a.share * out
            run.free_um, run.scaled = float(out[0]), self._scaled(a, seen, float(out[0]))
            run.slope_um_per_mm = float(out[1]) if len(out) > 1 else 0.0
            distance, quantity = far(seen)
            run.trust = a.authority(distance) / a.share
            run.why = f"{quantity} outside the trained region by {distance:.2g} widths" if run.trust < 1.0 else ""
            run.error_um = run.free_um
            if a.updater is not None and run.learned is not None and math.isfinite(run.free_um):
                run.error_um, _, run.learned = a.updater.step(run.learned, run.at_s, run.free_um, run.scaled)

    def _scaled(self, a: AxisModel, seen: Array, predicted_um: float) -> Array:
        places, scale = self._inputs[a.axis]
        return seen[places] / scale if a.inputs else np.array([predicted_um])

    def _read_all(self, sample: Sample) -> None:
        for axis, measured_um in sample.readings_um.items():
            self._read(axis, measured_um)

    def _read(self, axis: str, measured_um: float) -> None:
        """A reading of the error that is left with the correction that is being sent."""
        a = next((a for a in self.axes if a.axis == axis), None)
        if a is None:
            self.log(f"{axis}: reading not used: no such axis; compensated are {', '.join(self._run)}")
            return
        run = self._run[axis]
        if a.updater is None or run.learned is None or not run.learned.started or not math.isfinite(run.free_um):
            self.log(f"{axis}: reading of {measured_um:g} µm not used: no filter, or no prediction yet")
            return
        low, high = a.readings_um
        if not low <= measured_um <= high:
            self.rejected += 1
            self.log(f"{axis}: reading of {measured_um:g} µm rejected: outside {low:g} to {high:g} µm; probe again")
            return
        total_um = measured_um - run.safety.sent_um  # the machine's own error: what is left less what was added
        known, row = run.learned, (run.at_s, run.free_um, run.scaled)
        expected_um, sd_um, _ = a.updater.step(known, *row)
        if a.share < 1.0 and not known.mean.any():  # the first reading also finds what the share leaves out
            left_out_um2, own_um2 = (run.free_um * (1.0 / a.share - 1.0)) ** 2, sd_um**2 - a.updater.noise_um2
            known = replace(known, cov=known.cov * (1.0 + left_out_um2 / max(own_um2, _LEAST_UM2)))
            expected_um, sd_um, _ = a.updater.step(known, *row)
        off_um = total_um - expected_um
        if not abs(off_um) <= _ODD_READING_SD * sd_um:
            again = abs(off_um - run.odd_um) <= _ODD_READING_SD * sd_um and abs(off_um) <= a.largest_surprise_um
            run.odd_um = off_um if math.isfinite(off_um) else math.nan
            if not again:
                self.rejected += 1
                self.log(
                    f"{axis}: reading of {measured_um:g} µm rejected: {off_um:+.3g} µm from what is expected, more "
                    f"than {_ODD_READING_SD:g} standard deviations of {sd_um:.3g} µm; probe again"
                )
                return
            self.log(f"{axis}: two readings in a row are {off_um:+.3g} µm off: the machine has changed, both count")
            known = replace(known, cov=known.cov * (off_um / sd_um) ** 2)
        run.odd_um = math.nan
        _, _, run.learned = a.updater.step(known, *row, total_um)
        run.error_um, _, _ = a.updater.step(run.learned, *row)

    def as_plain(self) -> dict[str, Any]:
        """Everything that a restart needs, numbers, strings and lists; `heartbeat` is the record's number."""
        axes = {}
        for name, run in self._run.items():
            learned = run.learned and {
                "mean": run.learned.mean.tolist(), "cov": run.learned.cov.tolist(), "time_s": run.learned.time_s,
                "started": run.learned.started,
            }  # fmt: skip
            axes[name] = {
                "model": run.model.as_plain(), "region": run.region.as_plain(), "learned": learned,
                "error_um": _or_none(run.error_um),
                "free_um": _or_none(run.free_um), "scaled": [_or_none(v) for v in run.scaled.tolist()],
                "slope_um_per_mm": _or_none(run.slope_um_per_mm), "trust": run.trust, "at_s": run.at_s,
            }  # fmt: skip
        watch = self._watch.as_plain() if self._watch is not None else None
        return {"schema": SCHEMA, "machine": self.machine, "heartbeat": self._heartbeat, "stopped": self.stopped,
                "sent": self.sent(), "period_s": self.period_s, "grid_s": self._grid_s,
                "shift_s": self._clock.shift_s, "held": self._held, "watch": watch, "axes": axes}  # fmt: skip

    def sent(self) -> dict[str, Any]:
        """What a restart needs to go on from what was sent, by axis."""
        return {
            n: {"safety": r.safety.as_plain(), "slope_safety": r.slope_safety.as_plain()} for n, r in self._run.items()
        }

    def restore(self, plain: Mapping[str, Any]) -> None:
        """Goes on from `as_plain` of another process: what is sent does not jump, what was learned is kept.

        What was sent and a stop by the operator are taken over also where the models are others and the rest is not.

        Raises:
            InputError: the state of another machine, period or set of axes.
        """
        got = plain.get("schema"), plain.get("machine"), plain.get("period_s"), sorted(plain.get("axes", ()))
        expected = SCHEMA, self.machine, self.period_s, sorted(self._run)
        if got[:2] == expected[:2]:
            self._restore_sent(plain)
        if got != expected:
            raise InputError(
                f"state of a compensation: got {got}, expected {expected}; delete the file, the compensation then "
                "starts afresh"
            )
        self._restore_models(plain)

    def _restore_sent(self, plain: Mapping[str, Any]) -> None:
        sent = plain["sent"]
        known = {
            n: (Axis.from_plain(sent[n]["safety"]), Axis.from_plain(sent[n]["slope_safety"]))
            for n in self._run if n in sent
        }  # fmt: skip
        for name, (offset, slope) in known.items():
            self._run[name].safety, self._run[name].slope_safety = offset, slope
        self.stopped, self._heartbeat = bool(plain["stopped"]), int(plain["heartbeat"])

    def _restore_models(self, plain: Mapping[str, Any]) -> None:
        runs = {}
        for name, one in plain["axes"].items():
            kept = one["learned"]
            learned = kept and Learned(
                np.array(kept["mean"], float), np.array(kept["cov"], float), float(kept["time_s"]), kept["started"]
            )
            runs[name] = _Running(
                State.from_plain(one["model"]), State.from_plain(one["region"]), learned,
                self._run[name].safety, self._run[name].slope_safety,
                _or_nan(one["error_um"]), _or_nan(one["free_um"]),
                np.array([_or_nan(v) for v in one["scaled"]]), _or_nan(one["slope_um_per_mm"]), float(one["trust"]),
                at_s=float(one["at_s"]),
            )  # fmt: skip
        held = {c: float(v) for c, v in plain["held"].items()}
        watch = (
            Watch.from_plain(plain["watch"]) if self.guard is not None and plain["watch"] is not None else self._watch
        )
        grid_s, shift_s = plain["grid_s"], float(plain["shift_s"])
        self._clock = SampleClock(None if grid_s is None else grid_s + shift_s, shift_s)
        self._run, self._held, self._watch, self._grid_s = runs, held, watch, grid_s


def _row(program: Program, values: Mapping[str, float]) -> Array:
    return np.array([values.get(c, math.nan) for c in program.channels])


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)
