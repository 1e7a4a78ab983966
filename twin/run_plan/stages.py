"""Stages of a run plan as written in YAML: durations, the drivers that hold, repeats."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, closest
from data.machine import Machine
from twin.run_plan.values import in_range, quantity

Array = NDArray[np.float64]

_MOST_WRITTEN, _DEEPEST = 100_000, 8
_DURATIONS = {"hours": ("h", 3600.0), "minutes": ("min", 60.0), "seconds": ("s", 1.0)}


@dataclass(frozen=True)
class Stage:
    """How long, and the drivers that it sets, in their channels' units."""

    seconds: float
    drivers: Mapping[str, float]


@dataclass(frozen=True)
class Repeat:
    """Stages that run several times."""

    times: int
    items: Sequence[Stage | Repeat]


def read_stages(given: Sequence[Mapping[str, Any]], machine: Machine, where: str) -> Repeat:
    """The stages as a tree; each is checked once, however often it is repeated.

    Raises:
        InputError: unknown key (with the closest), wrong unit, a duration of 0 or less or none, a value outside the
            channel's range, an odd repeat; with the stage's number.
    """
    written = [0]
    return Repeat(1, [_read(s, f"{where}: stage {k}", machine, 1, written) for k, s in enumerate(given, 1)])


def extent(item: Stage | Repeat) -> tuple[float, int]:
    """Seconds and number of stages, repeats multiplied out."""
    if isinstance(item, Stage):
        return item.seconds, 1
    parts = [extent(i) for i in item.items]
    return item.times * sum(p[0] for p in parts), item.times * sum(p[1] for p in parts)


def flat(item: Stage | Repeat) -> list[Stage]:
    """The stages one after the other."""
    if isinstance(item, Stage):
        return [item]
    return [s for i in item.items for s in flat(i)] * item.times


def held_drivers(stages: Sequence[Stage], machine: Machine, where: str) -> dict[str, Array]:
    """Every driver in every stage, (stages,): its last value, 0 before the first mention.

    Raises:
        InputError: that 0 lies outside the channel's range.
    """
    out = {n: np.zeros(len(stages)) for n in machine.names("driver", "position")}
    for name, values in out.items():
        value = 0.0
        for k, stage in enumerate(stages):
            value = stage.drivers.get(name, value)
            values[k] = value
        in_range(values, name, machine, f"{where}: {name} (0 where no stage gives it)")
    return out


def _read(given: Mapping[str, Any], where: str, machine: Machine, depth: int, written: list[int]) -> Stage | Repeat:
    written[0] += 1
    if depth > _DEEPEST or written[0] > _MOST_WRITTEN:
        raise InputError(f"{where}: more than {_DEEPEST} levels or {_MOST_WRITTEN} stages; use repeat, or a CSV plan")
    if "repeat" in given or "stages" in given:
        for key in given:
            if key not in ("repeat", "stages"):
                raise InputError(f"{where}: unknown key {key!r} beside repeat; allowed: repeat, stages")
        times, inner = given.get("repeat", 1), given.get("stages")
        if not isinstance(times, int) or isinstance(times, bool) or times < 1:
            raise InputError(f"{where}: repeat: got {times!r}, expected a whole number from 1")
        if not isinstance(inner, list) or not inner or not all(isinstance(s, dict) for s in inner):
            raise InputError(f"{where}: repeat needs a list of stages; write stages: [{{minutes: 5, ...}}]")
        return Repeat(times, [_read(s, f"{where}.{k}", machine, depth + 1, written) for k, s in enumerate(inner, 1)])
    driving = machine.names("driver", "position")
    seconds = 0.0
    drivers: dict[str, float] = {}
    for key, value in given.items():
        if key in _DURATIONS:
            unit, factor = _DURATIONS[key]
            part_s = factor * quantity(value, unit, f"{where}: {key}")
            if part_s < 1e-6:
                raise InputError(f"{where}: {key}: got {value!r}, expected more than 0")
            seconds += part_s
        elif key in driving:
            unit = machine.channels[key].unit
            switch = isinstance(value, bool) and unit == "1"  # coolant: on
            number = float(value) if switch else quantity(value, unit, f"{where}: {key}")
            drivers[key] = float(in_range(np.array([number]), key, machine, f"{where}: {key}")[0])
        else:
            raise InputError(f"{where}: unknown key {key!r}; {closest(str(key), (*driving, *_DURATIONS, 'repeat'))}")
    if not seconds:
        raise InputError(f"{where}: no duration; add hours, minutes or seconds")
    return Stage(seconds, drivers)
