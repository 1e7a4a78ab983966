"""A proposed run done on the plant of a case: one more batch, and one more sensor if the plan asks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from data.batch import Batch
from data.machine import Machine
from twin.plants.machine import Plant, Sensor
from twin.plants.physics import simulated
from twin.plants.planned import read_plan
from twin.plants.plant import Posed, posed, with_amounts
from twin.plants.recorded import gridded, written
from twin.plants.runs import earlier
from twin.plants.seeds import stream


@dataclass(frozen=True)
class Executed:
    """`machine` is the case's, with the new sensor where there is one; `table` are the rows that the recorder wrote."""

    machine: Machine
    batch: Batch
    table: pd.DataFrame


def execute(
    seed: int, sizes: Mapping[str, float], plan_text: str, plant: str = "volumes", **options: Any
) -> Executed:  # fmt: skip
    """Runs a plan on the plant that `draw` simulates for the same arguments, on the day after the case's last run.

    Effects, everyday physics, instruments and noise are the case's own. The shop does what the plan's comments say
    comes before, and its hall keeps the plan's air within a ripple. A sensor on a body that the plant or its file does
    not have is not put on.

    Raises:
        InputError: as `draw` and `read_plan`.
    """
    at = posed(seed, sizes, plant, **options)
    asked = at.options
    plan = read_plan(plan_text, at.machine.names("driver"))
    rng = stream(seed, f"executed {plan.name}")
    friction = 1.0 + asked.friction_scatter * float(rng.uniform(-1.0, 1.0))
    run = earlier(plan.run(at.runs[-1].start + pd.Timedelta(days=1), friction), asked.early_s)
    ready = _with_sensor(at, plan.sensor, rng) if plan.sensor else at
    shown, channels = with_amounts(ready.plant, at.effects), ready.machine.batch_channels()
    course = simulated(shown, [run], [*at.effects, *at.everyday], asked.solver_s, plan.before_h)
    noise = int(rng.integers(2**62))
    (table,) = written(shown, [run], course, at.effects, noise, channels, asked)
    return Executed(ready.machine, gridded(at.machine.machine, run, table, channels, asked), table)


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
