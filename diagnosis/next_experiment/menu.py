"""Runs that a shop can do with a machine: the menu from which a diagnosis chooses the one that distinguishes causes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import yaml

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from data.units import quantity
from diagnosis.formatting import as_given, with_unit
from diagnosis.policy import POLICY
from twin.run_plan import RunPlan
from twin.run_plan.plan import Stage

Points = tuple[tuple[float, float], ...]  # (s, degC), straight lines between them


@dataclass(frozen=True)
class Run:
    """One run: what the machine does in `stages`, after what it did `before`, which is not recorded.

    `label` names it in a sentence: "… would distinguish them". `surroundings` are the recorded channels over time; rows
    and changes are at multiples of `row_s`. `clock_h` is the time of day at which it begins, `initial_degC` where a
    machine without recorded surroundings has been at rest.
    """

    label: str
    stages: tuple[Stage, ...]
    surroundings: Mapping[str, Points]
    row_s: float
    before: tuple[Stage, ...]
    clock_h: float = POLICY.morning_h
    initial_degC: float = 20.0

    @property
    def hours(self) -> float:
        return sum(s.seconds for s in self.stages) / 3600.0

    @property
    def rows(self) -> int:
        """How many rows come after the first."""
        return sum(round(s.seconds / self.row_s) for s in self.stages)

    @property
    def begins(self) -> dict[str, float]:
        """The surroundings, degC, at the start."""
        return {n: points[0][1] for n, points in self.surroundings.items()}

    @property
    def preparation(self) -> Run:
        """What comes before it as a run of its own, the surroundings held where this run finds them."""
        held: dict[str, Points] = {n: ((0.0, T),) for n, T in self.begins.items()}
        return replace(self, label=f"before {self.label}", stages=self.before, surroundings=held)

    def plan(self, machine: Machine, start: Mapping[str, float] | None = None) -> RunPlan:
        """The run on its rows; `start` has bodies' temperatures, degC, all others begin at `initial_degC`."""
        counts = [round(s.seconds / self.row_s) for s in self.stages]
        time_s = self.row_s * np.arange(sum(counts) + 1.0)
        drivers = {n: np.zeros(sum(counts)) for n in machine.names("driver", "position")}
        held = dict.fromkeys(drivers, 0.0)
        for stage, begin, count in zip(self.stages, np.cumsum([0, *counts]), counts, strict=False):
            held |= stage.drivers
            for name, value in held.items():
                drivers[name][begin : begin + count] = value
        air = {n: np.interp(time_s, *np.transpose(points)) for n, points in self.surroundings.items()}
        return RunPlan(self.label, time_s, drivers, air, dict(start or {}), self.initial_degC, self.row_s)

    def text(self, start: Mapping[str, float] | None = None, comments: Sequence[str] = ()) -> str:
        """The run as a run plan file, which reads back as `plan(machine, start)`; `comments` come first."""
        given: dict[str, object] = {
            "name": self.label,
            "step": f"{self.row_s:g} s",
            "stages": [{**_duration(s.seconds), **_plains(s.drivers)} for s in self.stages],
        }
        if self.surroundings:
            given["surroundings"] = {n: _points(points) for n, points in self.surroundings.items()}
            given["start"] = _plains(start) if start else "settled"
        else:
            given["start"] = f"{self.initial_degC:g} degC"
        body = yaml.safe_dump(given, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
        return "".join(f"# {line}\n" for line in comments) + body


def menu(machine: Machine, batches: Sequence[Batch], drivers: Sequence[str], row_s: float = 300.0) -> list[Run]:
    """What a shop can do: each of the `drivers` by itself, cooling down, a night, a heated hall.

    Speeds go up to the highest recorded one, the room begins at its recorded median; `row_s` is the spacing of rows.
    None where some driver cannot be 0: it shows what happens and is not set by the shop.

    Raises:
        InputError: no batches.
    """
    if not batches:
        raise InputError(
            f"machine {machine.machine}: no recordings to take speeds and temperatures from; name at least one"
        )
    shop = _Shop.of(machine, batches, row_s)
    if any(shop.rest.get(n) is None for n in drivers):
        return []
    switched = [n for n in drivers if machine.channels[n].role == "driver" and shop.highest[n] != 0]
    turning = [n for n in switched if quantity(machine.channels[n].unit) == "rotation"]
    out: list[Run] = []
    for name in turning:
        out += shop.turning(name)
    for name in switched:
        if name not in turning:
            out.append(shop.alone(name))
    out += [shop.cooling(name) for name in (turning or switched)[:1]]
    return out + list(shop.around())


@dataclass(frozen=True)
class _Shop:
    """What a machine can do, by its recordings."""

    machine: Machine
    row_s: float
    pace: float  # of all durations
    highest: Mapping[str, float]  # by driver, the largest value recorded
    switches: frozenset[str]  # drivers that are on or off
    rest: Mapping[str, float | None]  # value of a driver while another runs
    room_degC: Mapping[str, float]  # by recorded surrounding
    initial_degC: float

    @classmethod
    def of(cls, machine: Machine, batches: Sequence[Batch], row_s: float) -> _Shop:
        longest_h = max(float(b.time_s[-1]) for b in batches) / 3600.0
        highest, switches, rest = {}, set(), {}
        for name in machine.names("driver", "position"):
            values = _recorded(batches, name)
            channel = machine.channels[name]
            low, high = channel.range or (-math.inf, math.inf)
            top = float(values[np.argmax(np.abs(values))]) if len(values) else 0.0
            highest[name] = float(np.clip(float(f"{top:.3g}"), low, high))
            if channel.unit == "1" and set(np.unique(values)) <= {0.0, 1.0}:
                switches.add(name)
            rest[name] = 0.0 if low <= 0 <= high else None
            if rest[name] is None and channel.role == "position" and len(values):
                rest[name] = float(f"{np.median(values):.3g}")
        room = {n: _half(float(np.median(v))) for n in machine.names("ambient") if len(v := _recorded(batches, n))}
        sensed = [v[0] for n in machine.names("temperature") for b in batches if len(v := _recorded([b], n))]
        order = sorted(room, key=lambda n: n != "room")
        initial_degC = room[order[0]] if order else _half(float(np.median(sensed))) if sensed else 20.0
        pace = min(1.0, longest_h / POLICY.short_recording_h)
        return cls(
            machine, row_s, pace, highest, frozenset(switches), rest, room, initial_degC
        )  # fmt: skip

    def turning(self, name: str) -> Iterator[Run]:
        """A step and its cool-down, a staircase, a slow run."""
        top, low = self.highest[name], float(f"{POLICY.slow_run_speed_share * self.highest[name]:.2g}")
        stairs = [float(f"{share * top:.3g}") for share in POLICY.staircase_speed_shares]
        step = [(3.0, {name: top}), (2.0, {name: 0.0})]
        yield self._run(f"{self._span(3)} at {self._level(name, top)} and {self._span(2)} at rest", step)
        climb = [*((1.0, {name: v}) for v in stairs), (1.0, {name: 0.0})]
        yield self._run(f"a staircase of speeds up to {self._level(name, top)} and {self._span(1)} at rest", climb)
        yield self._run(f"{self._span(4)} at {self._level(name, low)}", [(4.0, {name: low})])

    def alone(self, name: str) -> Run:
        subject = "the feed" if quantity(self.machine.channels[name].unit) == "feed" else name
        label = f"{subject} alone, {self._span(3)} {self._working(name)} and {self._span(1)} off"
        return self._run(label, [(3.0, {name: self.highest[name]}), (1.0, {name: 0.0})])

    def cooling(self, name: str) -> Run:
        """From as hot as the machine gets; the warming up is a shift's work and is not recorded."""
        turns = quantity(self.machine.channels[name].unit) == "rotation"
        work = f"{self._span(POLICY.warm_up_h)} {'' if turns else f'of {name} '}{self._working(name)}"
        label = f"a cool-down of {self._span(5)} after {work}"
        return self._run(label, [(5.0, {name: 0.0})], before=[(POLICY.warm_up_h, {name: self.highest[name]})])

    def around(self) -> Iterator[Run]:
        """The machine at rest and the room moving."""
        if not self.room_degC:
            return
        night = {
            n: ((0.0, T), (self._s(8), self._within(n, T - POLICY.night_drop_K))) for n, T in self.room_degC.items()
        }
        yield self._run("a night switched off", [(8.0, {})], night, clock_h=POLICY.evening_h)
        on_s, warm_s, end_s = self._s(0.5), self._s(0.5) + self._s(1), self._s(8)
        heated = {}
        for name, cool in self.room_degC.items():
            warm = self._within(name, cool + POLICY.hall_heating_K)
            heated[name] = ((0.0, cool), (on_s, cool), (warm_s, warm), (end_s, warm))
        yield self._run(
            f"{self._span(8)} at rest in a hall that is heated by {POLICY.hall_heating_K:g} K", [(8.0, {})], heated
        )

    def _run(
        self,
        label: str,
        stages: Sequence[tuple[float, Mapping[str, float]]],
        air: Mapping[str, Points] | None = None,
        before: Sequence[tuple[float, Mapping[str, float]]] = (),
        clock_h: float = POLICY.morning_h,
    ) -> Run:
        room = {n: ((0.0, T),) for n, T in self.room_degC.items()} if air is None else air
        stages_before = self._stages([(POLICY.rest_before_run_h, {}), *before])
        return Run(label, self._stages(stages), room, self.row_s, stages_before, clock_h, self.initial_degC)

    def _stages(self, given: Sequence[tuple[float, Mapping[str, float]]]) -> tuple[Stage, ...]:
        held = {n: v for n, v in self.rest.items() if v}
        return tuple(Stage(self._s(hours), held | dict(drivers)) for hours, drivers in given)

    def _within(self, name: str, degC: float) -> float:
        """No farther than the channel's range."""
        low, high = self.machine.channels[name].range or (-math.inf, math.inf)
        return float(np.clip(degC, low, high))

    def _s(self, hours: float) -> float:
        """So long at the machine's pace, in whole rows."""
        return self.row_s * max(1, round(3600.0 * hours * self.pace / self.row_s))

    def _span(self, hours: float) -> str:
        seconds = self._s(hours)
        number, unit = (
            (seconds / 3600, "h") if seconds >= 3600 else (seconds / 60, "min") if seconds >= 60 else (seconds, "s")
        )
        return f"{as_given(float(f'{number:.2g}'))} {unit}"

    def _working(self, name: str) -> str:
        return "on" if name in self.switches else f"at {self._level(name, self.highest[name])}"

    def _level(self, name: str, value: float) -> str:
        return with_unit(as_given(value), self.machine.channels[name].unit)


def _recorded(batches: Sequence[Batch], name: str) -> Array:
    """All usable values of a channel."""
    values = [b.masked(name) for b in batches if name in b.table.columns]
    joined = np.concatenate(values) if values else np.zeros(0)
    return joined[np.isfinite(joined)]


def _half(degC: float) -> float:
    return round(2.0 * degC) / 2.0


def _points(points: Points) -> object:
    """A temperature, or [hours, degC] points."""
    if len(points) == 1:
        return f"{points[0][1]:g} degC"
    return [[_plain(s / 3600.0), _plain(T)] for s, T in points]


def _duration(seconds: float) -> dict[str, float | int]:
    return {"minutes": int(seconds // 60)} if seconds % 60 == 0 else {"seconds": _plain(seconds)}


def _plains(values: Mapping[str, float]) -> dict[str, float | int]:
    return {k: _plain(v) for k, v in values.items()}


def _plain(value: float) -> float | int:
    """Without an idle ``.0``."""
    value = round(float(value), 9)
    return int(value) if value.is_integer() else value
