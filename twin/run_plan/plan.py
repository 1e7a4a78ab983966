"""Run plans: what a machine does over time, for `thermodrift simulate`. From YAML stages or from a table.

    name: rotating-spindle test
    step: 10 s                                       # default; stage borders get a shorter step where needed
    stages:
      - {minutes: 5, spindle_rpm: 0}
      - repeat: 2
        stages:
          - {hours: 2, spindle_rpm: 4 krpm, coolant: 1}
          - {minutes: 30, spindle_rpm: 0}            # the coolant keeps running
    surroundings: {room: {start: 20 degC, drift: 0.4 K/h, ripple: 0.3 K, period: 20 min}}
    start: settled                 # all bodies at the room's first value; or 21 degC; or {bed: 19 degC}

A driver keeps its value until a stage gives another; before its first mention it is 0. A table (CSV, also a recording)
has a time column and one column per driver and surrounding: drivers hold from one row to the next, surroundings go in
straight lines, the last row ends the plan. Drivers without a column are 0, but one must have one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from data.arrays import Array
from data.errors import InputError, closest
from data.machine import Machine
from data.yaml_file import load_yaml
from twin.run_plan.table import fill_short_gaps, in_range, quantity, read_plan_table, surrounding_degC

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
                raise InputError(f"{where}: unknown key {key!r} next to repeat; allowed: repeat, stages")
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


STEP_S = 10.0
MOST_S, MOST_STEPS = 366 * 86400.0, 5_000_000


@dataclass(frozen=True)
class RunPlan:
    """A plan on its time grid: the multiples of the step, the borders at which a driver changes, and the end.

    `time_s` (n + 1,) rises from 0, not always evenly. `drivers` (n,) hold within each interval; every driver of the
    machine is there. `surroundings` (n + 1,), degC, are values at the borders, linear between. `start` has the
    bodies that the plan names, degC; every other body starts at `initial_degC`.
    """

    name: str
    time_s: Array
    drivers: Mapping[str, Array]
    surroundings: Mapping[str, Array]
    start: Mapping[str, float]
    initial_degC: float
    step_s: float = STEP_S
    source: str = ""

    @property
    def on_step(self) -> NDArray[np.bool_]:
        """Which of `time_s` are multiples of the step, (n + 1,): the rows of a regular table."""
        return np.abs(self.time_s / self.step_s - np.rint(self.time_s / self.step_s)) * self.step_s < 1e-5

    def start_degC(self, body: str) -> float:
        """Start temperature of a body."""
        return self.start.get(body, self.initial_degC)


class _Plan(BaseModel):
    """The YAML file as written; stages, surroundings and start are read against the machine afterwards."""

    model_config = ConfigDict(extra="forbid")

    name: str = ""
    step: Any = f"{STEP_S:g} s"
    stages: list[dict[str, Any]] = Field(min_length=1)
    surroundings: dict[str, Any] = {}
    start: Any = "settled"


def load_run_plan(path: Path | str, machine: Machine) -> RunPlan:
    """Read a plan and check it against the machine's drivers, surroundings and, if it has a twin part, bodies.

    Drivers are the machine's driver and position channels; surroundings its ambient channels and the twin part's
    surroundings. Units may be written ("4 krpm"); a bare number is in the channel's unit.

    Raises:
        InputError: file missing or malformed, unknown key, driver or column (with the closest), wrong unit, a value
            outside the channel's range, a duration of 0 or less, times that do not rise, gaps longer than the machine
            file's max_gap_s, more than a year or 5 million steps. One line with file, stage or row, and remedy.
    """
    path = Path(path)
    where = f"run plan {path}"
    if path.suffix.lower() in (".yml", ".yaml"):
        return _from_yaml(path, machine, where)
    return _from_table(path, machine, where)


def _from_yaml(path: Path, machine: Machine, where: str) -> RunPlan:
    plan = load_yaml(path, _Plan, "run plan")
    step_s = quantity(plan.step, "s", f"{where}: step")
    if step_s <= 0:
        raise InputError(f"{where}: step: got {plan.step!r}, expected more than 0 s")
    written = read_stages(plan.stages, machine, where)
    total_s, count = extent(written)
    _check_size(total_s, max(total_s / step_s, count), step_s, where)
    stages = flat(written)
    borders_s = np.cumsum([0.0, *(s.seconds for s in stages)])
    held = held_drivers(stages, machine, where)
    time_s = _grid(borders_s, step_s)
    allowed = _surrounding_names(machine)
    for name in plan.surroundings:
        if name not in allowed:
            raise InputError(f"{where}: unknown surrounding {name!r}; {closest(name, allowed)}")
    surroundings = {
        n: in_range(surrounding_degC(g, n, time_s, path.parent, machine, at), n, machine, at)
        for n, g in plan.surroundings.items()
        for at in (f"{where}: surroundings.{n}",)
    }
    remedy = "add surroundings: {room: 20 degC}, or start: 20 degC"
    start, initial_degC = _start(plan.start, surroundings, machine, where, remedy)
    drivers = _on_grid(borders_s, held, time_s)
    name = plan.name or path.stem
    return RunPlan(name, time_s, drivers, surroundings, start, initial_degC, step_s, path.name)


def _from_table(path: Path, machine: Machine, where: str) -> RunPlan:
    driving = machine.names("driver", "position")
    units = {n: machine.channels[n].unit for n in driving} | dict.fromkeys(_surrounding_names(machine), "degC")
    table = read_plan_table(path, machine, units, where)
    if driving and not any(n in table.columns for n in driving):
        raise InputError(f"{where}: no column of a driver, {' or '.join(driving)}; add one, 0 for a machine at rest")
    total_s = float(table.time_s[-1])
    _check_size(total_s, total_s / STEP_S, STEP_S, where)
    max_gap_s = machine.recording.max_gap_s
    rows: dict[str, Array] = {}
    for n in driving:
        values = table.columns.get(n)
        at = f"{where}: column {n!r}"
        rows[n] = np.zeros(len(table.time_s)) if values is None else values
        if values is not None:
            rows[n] = in_range(fill_short_gaps(values, table.time_s, max_gap_s, True, at), n, machine, at)
    changes = [np.diff(v[:-1]) != 0 for v in rows.values()]
    kept = np.flatnonzero(np.r_[True, np.any(changes, axis=0) if changes else np.zeros(len(table.time_s) - 2, bool)])
    borders_s = np.r_[table.time_s[kept], total_s]
    time_s = _grid(borders_s, STEP_S)
    held = {n: v[kept] for n, v in rows.items()}
    surroundings = {}
    for n in (n for n in table.columns if n not in driving):
        at = f"{where}: column {n!r}"
        filled = fill_short_gaps(table.columns[n], table.time_s, max_gap_s, False, at)
        surroundings[n] = in_range(np.interp(time_s, table.time_s, filled), n, machine, at)
    start, initial_degC = _start("settled", surroundings, machine, where, "add a column for it")
    drivers = _on_grid(borders_s, held, time_s)
    return RunPlan(path.stem, time_s, drivers, surroundings, start, initial_degC, STEP_S, path.name)


def _check_size(total_s: float, steps: float, step_s: float, where: str) -> None:
    if total_s > MOST_S:
        raise InputError(f"{where}: lasts {total_s / 86400:.0f} days, expected at most a year; split the plan")
    if steps > MOST_STEPS:
        raise InputError(
            f"{where}: {steps:.3g} steps of {step_s:g} s, expected at most {MOST_STEPS:,}; lengthen the step"
        )


def _grid(borders_s: Array, step_s: float) -> Array:
    """Multiples of the step and the borders, sorted, each once; times closer than 1 µs are one."""
    multiples = np.arange(int(borders_s[-1] / step_s + 1e-9) + 1) * step_s
    time_s: Array = np.unique(np.round(np.concatenate([multiples, borders_s]), 6))
    return time_s


def _on_grid(borders_s: Array, held: Mapping[str, Array], time_s: Array) -> dict[str, Array]:
    middle = (time_s[:-1] + time_s[1:]) / 2
    which = np.searchsorted(borders_s, middle, side="right") - 1
    return {n: v[which] for n, v in held.items()}


def _twin_names(machine: Machine, key: str) -> Collection[str]:
    part = (machine.twin or {}).get(key)
    return [str(k) for k in part] if isinstance(part, Mapping) else []


def _surrounding_names(machine: Machine) -> list[str]:
    return list(dict.fromkeys([*machine.names("ambient"), *_twin_names(machine, "surroundings")]))


def _start(
    given: Any, surroundings: Mapping[str, Array], machine: Machine, where: str, remedy: str
) -> tuple[dict[str, float], float]:
    """Named bodies' start temperatures, and that of all others."""
    at = f"{where}: start"
    if not (given == "settled" or isinstance(given, Mapping)):
        if isinstance(given, str) and given.isalpha():
            raise InputError(f"{at}: got {given!r}, expected 'settled', a temperature or a mapping of bodies")
        return {}, quantity(given, "degC", at)
    order = ["room", *machine.names("ambient"), *surroundings]
    room = next((n for n in order if n in surroundings), None)
    if room is None:
        raise InputError(f"{at}: bodies are at the room's first value, and no surrounding is given; {remedy}")
    bodies = _twin_names(machine, "bodies")
    named: dict[str, float] = {}
    for body, value in given.items() if isinstance(given, Mapping) else ():
        if bodies and body not in bodies:
            raise InputError(f"{at}: unknown body {body!r}; {closest(str(body), bodies)}")
        named[str(body)] = quantity(value, "degC", f"{at}.{body}")
    return named, float(surroundings[room][0])
