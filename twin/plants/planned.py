"""A run plan (YAML, as a diagnosis proposes it) read as a run of a plant: stages, air, what comes before, a sensor.

Written apart from the twin's own reader; it knows what proposals write: stages with durations and drivers, repeats,
air as a temperature or as [hours, degC] points. Comments say what a shop does before the run.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import yaml

from data.errors import InputError, closest
from data.units import conversion
from twin.plants.casting import Array
from twin.plants.runs import Block, Run

Points = tuple[Array, Array]  # s, degC: straight lines between them
UNITS = {"spindle_rpm": "rpm", "feed": "mm/min"}  # of drivers; all others are switches
DURATIONS = {"hours": ("h", 3600.0), "minutes": ("min", 60.0), "seconds": ("s", 1.0)}
AIR = ("room", "wall")
RESTED_H = 24.0
RIPPLE_K = 0.2  # of a hall that is kept at a temperature
MORNING, EVENING = pd.Timedelta(hours=7), pd.Timedelta(hours=21)  # when a shop begins, and when it goes home

_VALUE = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
_BEFORE = re.compile(r"^#\s*Begin after (.+?)\.\s*$", re.MULTILINE)
_SENSOR = re.compile(r"^#\s*Put one more temperature sensor at (\S+) before\.\s*$", re.MULTILINE)


@dataclass(frozen=True, kw_only=True)
class PlannedRun(Run):
    """A run in air that goes in straight lines, beside its ripple; `wall` is None where the plan says nothing."""

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
    try:
        given = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"{where}: is no YAML ({str(error).splitlines()[0]}); give a run plan") from None
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
    said = _BEFORE.search(text)
    for part in (said[1] if said else f"{RESTED_H:g} h at rest").split(", then "):
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
