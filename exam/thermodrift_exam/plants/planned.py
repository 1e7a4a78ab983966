"""A run plan (YAML, as a diagnosis proposes it) read as a run of a plant: stages, air, what comes before, a sensor.

Independent of the twin's own reader; it knows what proposals write: stages with durations and drivers, repeats,
air as a temperature or as [hours, degC] points. Comments say what a shop does before the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from data.machine import Machine
from data.units import conversion
from data.yaml_file import parse_plain
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.plant import Posed, posed, with_amounts
from thermodrift_exam.plants.runs import Block, Run, earlier
from thermodrift_exam.plants.simulation import gridded, simulated, written
from thermodrift_exam.plants.structure import Plant, Sensor

Points = tuple[Array, Array]  # s, degC: straight lines between them
UNITS = {"spindle_rpm": "rpm", "feed": "mm/min"}  # of drivers; all others are switches
DURATIONS = {"hours": ("h", 3600.0), "minutes": ("min", 60.0), "seconds": ("s", 1.0)}
AIR = ("room", "wall")
RESTED_H = 24.0
RIPPLE_K = 0.2  # of a hall that is kept at a temperature
MORNING, EVENING = pd.Timedelta(hours=7), pd.Timedelta(hours=21)  # begin and end of work in a shop

_VALUE = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
_BEFORE = re.compile(r"^#\s*Begin after (.+?)\.\s*$", re.MULTILINE)
_SENSOR = re.compile(r"^#\s*Put one more temperature sensor at (\S+) before\.\s*$", re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class PlannedRun(Run):
    """A run in air that goes in straight lines with a ripple; `wall` is None where the plan does not state it."""

    room: Points
    wall: Points | None

    def room_degC(self, time_s: Array) -> Array:
        ripple = sum(np.sin(2 * np.pi * time_s / p) for p in self.ripple_s) * self.ripple_K / 2
        return np.asarray(np.interp(time_s, *self.room) + ripple)

    def wall_degC(self, time_s: Array) -> Array:
        if self.wall is None:
            return np.full(np.shape(time_s), self.room[1][0] + self.wall_K)
        return np.interp(time_s, *self.wall)


@dataclass(frozen=True)
class Plan:
    """Blocks of every driver from `before_h` before the start on, air, and the body that gets one more sensor."""

    name: str
    hours: float
    before_h: float
    blocks: Mapping[str, tuple[Block, ...]]
    air: Mapping[str, Points]
    sensor: str | None

    def run(self, start: pd.Timestamp, friction: float = 1.0) -> PlannedRun:
        """On the day of `start`, in the morning; what is called a night begins in the evening."""
        begin = start.normalize() + (EVENING if "night" in self.name else MORNING)
        return PlannedRun(
            start=begin, hours=self.hours,
            speed=self.blocks.get("spindle_rpm", ()), feed=self.blocks.get("feed", ()),
            coolant=self.blocks.get("coolant", ()), idle=self.blocks,
            room_mean_degC=float(self.air["room"][1][0]), day_K=0.0, warmest_h=15.0,
            ripple_K=RIPPLE_K, ripple_s=(2700.0, 1100.0), wall_K=0.0, slow_K=0.0, friction=friction,
            room=self.air["room"], wall=self.air.get("wall"),
        )  # fmt: skip


def read_plan(text: str, drivers: Sequence[str], where: str = "run plan") -> Plan:
    """The plan of a text; `drivers` are the channels that the machine has.

    Raises:
        InputError: no YAML mapping, no stages, an unknown key, a value that is none, no room; one line.
    """
    given = parse_plain(text, where)
    if not isinstance(given, Mapping) or not isinstance(given.get("stages"), list):
        raise InputError(f"{where}: has no list of stages; write stages: [{{minutes: 5, spindle_rpm: 0}}]")
    before = list(_before(text, drivers, where))
    own = list(_stages(given["stages"], drivers, where))
    first_s = -sum(seconds for seconds, _ in before)
    stages = [*before, (0.0, dict.fromkeys(drivers, 0.0)), *own]
    held: dict[str, list[Block]] = {name: [] for name in drivers}
    at_s = first_s
    for seconds, values in stages:
        for name, value in values.items():
            held[name].append(Block(at_s, value))
        at_s += seconds
    sensor = _SENSOR.search(text)
    return Plan(
        str(given.get("name", "")), at_s / 3600.0, -first_s / 3600.0,
        {name: _latest(blocks) for name, blocks in held.items()},
        _air(given.get("surroundings"), where), sensor[1] if sensor else None,
    )  # fmt: skip


def _latest(blocks: Sequence[Block]) -> tuple[Block, ...]:
    """Of blocks at the same time the last one."""
    return tuple(Block(t, v) for t, v in {b.from_s: b.value for b in blocks}.items())


def _before(text: str, drivers: Sequence[str], where: str) -> Iterator[tuple[float, dict[str, float]]]:
    """Stages of the comment "Begin after 24 h at rest, then 4 h spindle_rpm 8000."; without it a day at rest."""
    begin = _BEFORE.search(text)
    for part in (begin[1] if begin else f"{RESTED_H:g} h at rest").split(", then "):
        hours, _, rest = part.partition(" h ")
        values = dict.fromkeys(drivers, 0.0)
        for piece in () if rest == "at rest" else re.split(r", and |, | and ", rest):
            name, _, value = piece.partition(" ")
            values |= _driver(name, value, drivers, f"{where}: begin after")
        yield 3600.0 * _number(hours, "h", f"{where}: begin after"), values


def _stages(given: Sequence[Any], drivers: Sequence[str], where: str) -> Iterator[tuple[float, dict[str, float]]]:
    for k, stage in enumerate(given, 1):
        at = f"{where}: stage {k}"
        if not isinstance(stage, Mapping):
            raise InputError(f"{at}: got {stage!r}, expected a mapping; write {{minutes: 5, spindle_rpm: 0}}")
        if "stages" in stage:
            for _ in range(int(stage.get("repeat", 1))):
                yield from _stages(stage["stages"], drivers, at)
            continue
        seconds, values = 0.0, dict[str, float]()
        for name, value in stage.items():
            if name in DURATIONS:
                unit, factor = DURATIONS[name]
                seconds += factor * _number(value, unit, f"{at}: {name}")
            else:
                values |= _driver(str(name), value, drivers, at)
        if seconds <= 0:
            raise InputError(f"{at}: lasts {seconds:g} s, expected more than 0; add hours, minutes or seconds")
        yield seconds, values


def _driver(name: str, value: Any, drivers: Sequence[str], where: str) -> dict[str, float]:
    if name not in drivers:
        raise InputError(f"{where}: unknown key {name!r}; {closest(name, (*drivers, *DURATIONS))}")
    return {name: _number(value, UNITS.get(name, "1"), f"{where}: {name}")}


def _air(given: Any, where: str) -> dict[str, Points]:
    if not isinstance(given, Mapping) or "room" not in given:
        raise InputError(f"{where}: surroundings have no room; write surroundings: {{room: 20 degC}}")
    out = {}
    for name, course in given.items():
        at = f"{where}: surroundings.{name}"
        if name not in AIR:
            raise InputError(f"{at}: unknown surrounding {name!r}; {closest(str(name), AIR)}")
        points = course if isinstance(course, list) else [[0.0, course]]
        if not points or any(not isinstance(p, list) or len(p) != 2 for p in points):
            raise InputError(f"{at}: got {course!r}, expected a temperature or points [hours, degC]; write [[0, 20]]")
        hours = np.array([_number(p[0], "h", at) for p in points])
        if np.any(np.diff(hours) <= 0):
            raise InputError(f"{at}: hours {hours.tolist()} do not rise; put the points in order")
        out[name] = (3600.0 * hours, np.array([_number(p[1], "degC", at) for p in points]))
    return out


def _number(given: Any, unit: str, where: str) -> float:
    """The number in `unit` of "4 krpm", of a switch or of a bare number."""
    found = _VALUE.fullmatch(str(float(given)) if isinstance(given, int | float) else str(given))
    if found is None:
        raise InputError(f"{where}: got {given!r}, expected a number in {unit}; write e.g. '1 {unit}'")
    factor, offset = conversion(found[2], unit, where) if found[2] else (1.0, 0.0)
    return factor * float(found[1]) + offset


@dataclass(frozen=True)
class Executed:
    """`machine` is the case's, with the new sensor where there is one; `table` are the rows that the recorder wrote."""

    machine: Machine
    batch: Batch
    table: pd.DataFrame


def execute(seed: int, sizes: Mapping[str, float], plan_text: str, plant: str = "volumes", **given: Any) -> Executed:
    """Runs a plan on the plant that `draw` simulates for the same arguments, on the day after the case's last run.

    Effects, everyday physics, instruments and noise are the case's own. The shop does what the plan's comments say
    comes before, and its hall keeps the plan's air within a ripple. A sensor on a body that the plant or its file does
    not have is not put on.

    Raises:
        InputError: as `draw` and `read_plan`.
    """
    at = posed(seed, sizes, plant, **given)
    options = at.options
    plan = read_plan(plan_text, at.machine.names("driver"))
    rng = stream(seed, f"executed {plan.name}")
    friction = 1.0 + options.friction_scatter * float(rng.uniform(-1.0, 1.0))
    run = earlier(plan.run(at.runs[-1].start + pd.Timedelta(days=1), friction), options.early_s)
    ready = _with_sensor(at, plan.sensor, rng) if plan.sensor else at
    shown, channels = with_amounts(ready.plant, at.effects), ready.machine.batch_channels()
    course = simulated(shown, [run], [*at.effects, *at.everyday], options.solver_s, plan.before_h)
    noise = int(rng.integers(2**62))
    (table,) = written(shown, course, at.effects, noise, channels, options)
    return Executed(ready.machine, gridded(at.machine.machine, run, table, channels, options), table)


def _with_sensor(at: Posed, body: str, rng: np.random.Generator) -> Posed:
    """The case with one more sensor on a body, away from its joints, as good as the others."""
    known, channel = (at.machine.twin or {}).get("bodies", {}), f"t_{body}"
    if body not in known or body not in at.plant.structure.bodies or channel in at.machine.channels:
        return at
    cells = at.plant.part(body).cells
    free = np.setdiff1d(cells, list(at.plant.structure.joined()))
    cell = int(rng.choice(free if len(free) else cells))
    sensor = Sensor(channel, body, cell, float(rng.uniform(30.0, 60.0)), float(rng.uniform(-0.15, 0.15)))
    new: Plant = replace(at.plant, sensors=(*at.plant.sensors, sensor))
    return replace(at, plant=new, machine=_sensed(at.machine, channel, body))


def _sensed(machine: Machine, channel: str, body: str) -> Machine:
    """The machine file with one more sensor, stated as its other ones are."""
    plain = machine.model_dump(mode="json", exclude_defaults=True)
    like = next(n for n in machine.names("temperature"))
    plain["channels"] = {channel: plain["channels"][like], **plain["channels"]}
    plain["twin"]["sensors"][channel] = {**plain["twin"]["sensors"][like], "at": body}
    return Machine.model_validate(plain)
