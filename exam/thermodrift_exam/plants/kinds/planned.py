"""A proposed run plan executed on the plant of a case: same machine, effects and instruments, another run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import yaml

from data.arrays import Array
from data.errors import InputError
from data.machine import Machine
from data.yaml_file import parse_plain
from thermodrift_exam.plants.kinds.case import KindPosed, ahead_s, all_effects, posed, variants
from thermodrift_exam.plants.kinds.plant import Dice
from thermodrift_exam.plants.kinds.runs import KindRun
from thermodrift_exam.plants.kinds.simulation import gridded, shown, simulated, written
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.planned import EVENING, MORNING, RIPPLE_K, Executed, Plan, Points, read_plan
from thermodrift_exam.plants.structure import Sensor

OF_A_HALL = ("room", "wall")  # surroundings that a shop can set


@dataclass(frozen=True)
class Kept:
    """Air that goes in straight lines between points, with the ripple of a hall that is kept so."""

    points: Points
    ripple_K: float

    def __call__(self, time_s: Array) -> Array:
        ripple = np.sin(2 * np.pi * time_s / 2300.0) + np.sin(2 * np.pi * time_s / 900.0)
        return np.asarray(np.interp(time_s, *self.points) + self.ripple_K / 2 * ripple)


def execute(
    seed: int, effects: Mapping[str, float], plan_text: str, kind: str, *, decoys: bool = False,
    runs: int | None = None,
) -> Executed:  # fmt: skip
    """Runs a plan on the plant that `draw_kind_case` simulates for the same arguments, on the day after its last run.

    The shop does what the plan's comments say comes before, and its hall keeps the plan's air within a ripple. A
    sensor on a body that the plant or its file does not have, or that has one, is not put on.

    Raises:
        InputError: as `draw_kind_case` and `plants.planned.read_plan`.
    """
    at = posed(seed, kind, effects, decoys=decoys, runs=runs)
    plan = read_plan(_in_a_hall(plan_text), at.machine.names("driver"))
    rng = stream(seed, f"executed {plan.name}")
    ready = _with_sensor(at, plan.sensor, Dice(rng)) if plan.sensor else at
    run, s = _run(at, plan, rng), at.plant.setting
    sizes = variants(at)[:1]
    course = simulated(ready.plant, [run], all_effects(at), sizes, s.solver_s, plan.before_h)
    true = shown(ready.plant, course, all_effects(at), sizes[0].tolist(), 0)
    channels = ready.machine.batch_channels()
    ahead = ahead_s(at.effects, at.sizes)
    (table,) = written(ready.plant, course, true, ahead, int(rng.integers(2**31)), channels, at.recorder)
    return Executed(ready.machine, gridded(at.machine.machine, run, table, channels, s.row_s), table)


def _in_a_hall(text: str) -> str:
    """The plan without surroundings other than those of a hall, such as the inlet of a coolant, which are unchanged."""
    try:
        given = parse_plain(text, "run plan")
    except InputError:
        return text  # the reader reports the error
    if not isinstance(given, dict) or not isinstance(given.get("surroundings"), dict):
        return text
    given["surroundings"] = {k: v for k, v in given["surroundings"].items() if k != "inlet"}
    comments = [line for line in text.splitlines() if line.startswith("#")]
    return "\n".join([*comments, yaml.safe_dump(given, sort_keys=False, allow_unicode=True)])


def _run(at: KindPosed, plan: Plan, rng: np.random.Generator) -> KindRun:
    last, s = at.runs[-1], at.plant.setting
    begin = (last.start + pd.Timedelta(days=1)).normalize() + (EVENING if "night" in plan.name else MORNING)
    room = Kept(plan.air["room"], RIPPLE_K)
    first_degC = float(plan.air["room"][1][0])
    wall = plan.air.get("wall", (np.zeros(1), np.array([first_degC])))
    own: dict[str, Callable[[Array], Array]] = {"room": room, "wall": Kept(wall, 0.0)}
    air = {name: own.get(name, last.air[name]) for name in at.plant.airs}
    hours = s.row_s * round(3600.0 * plan.hours / s.row_s) / 3600.0
    if hours <= 0:
        raise InputError(f"run plan: lasts {plan.hours:g} h, expected more than a row of {s.row_s:g} s; add stages")
    scatter = 1.0 + s.scatter * float(rng.uniform(-1.0, 1.0))
    return KindRun(begin, hours, plan.blocks, air, first_degC, 0.0, scatter)


def _with_sensor(at: KindPosed, body: str, dice: Dice) -> KindPosed:
    channel = f"t_{body}"
    if body not in at.plant.bodies or channel in at.machine.channels:
        return at
    s = at.plant.setting
    cell = int(dice.pick(at.plant.bodies[body].tolist()))
    sensor = Sensor(channel, body, cell, s.sensor_lag_s * dice.span(0.6, 1.6), dice.even(-1.0, 1.0) * s.offset_K)
    plant = replace(at.plant, sensors=(*at.plant.sensors, sensor))
    return replace(at, plant=plant, machine=_sensed(at.machine, channel, body))


def _sensed(machine: Machine, channel: str, body: str) -> Machine:
    """The machine file with one more sensor, stated as its others are."""
    plain = machine.model_dump(mode="json", exclude_defaults=True)
    like = next(iter(machine.names("temperature")))
    plain["channels"] = {channel: plain["channels"][like], **plain["channels"]}
    plain["twin"]["sensors"][channel] = {**plain["twin"]["sensors"][like], "at": body}
    return Machine.model_validate(plain)
