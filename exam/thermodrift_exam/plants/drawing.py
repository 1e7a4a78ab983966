"""A plant from a seed: its castings by one of the kinds, spindle losses, sensors off the middle of their bodies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from data.arrays import Array
from data.registry import Registry
from thermodrift_exam.plants.options import stream, wider
from thermodrift_exam.plants.runs import STANDING_S, Block, Run
from thermodrift_exam.plants.structure import AIR, FEATURES, Layout, Part, Plant, Sensor, Source, Structure

PLANTS = Registry(
    "plant",
    {
        "elements": "thermodrift_exam.plants.elements.layout:draw_layout",
        "volumes": "thermodrift_exam.plants.volumes.layout:draw_layout",
    },
)

CHANCE = {
    "feed": 0.5, "coolant": 0.5, "walls": 0.4, "layers": 0.4,
    "motor_loss": 0.75, "bending": 0.75, "growth": 0.85, "mandrel": 0.5,
}  # fmt: skip
WATTS = (
    (70.0, 160.0), (20.0, 60.0), (35.0, 80.0), (10.0, 30.0),  # front and rear bearings, viscous and by load
    (20.0, 60.0), (60.0, 140.0), (40.0, 100.0),  # the motor's
)  # fmt: skip
UNSENSED = ("shaft", "mandrel", AIR)
SELDOM_SENSED = ("saddle", "table", "screw")


def draw_plant(
    seed: int, has: frozenset[str], lacks: frozenset[str], kind: str = "volumes", spread: float = 1.0, finer: int = 1
) -> Plant:
    """The plant of a seed; `has` and `lacks` overrule what the seed draws of `FEATURES`, `kind` is of `PLANTS`.

    `spread` makes the ranges wider from which sizes, masses, joints, films and losses are drawn; `finer` cuts every
    cell so many times along each axis, and the machine stays the same.

    Raises:
        InputError: an unknown kind.
    """
    dice = stream(seed, "features").random(len(FEATURES))
    drawn = {f for f, d in zip(FEATURES, dice, strict=True) if d < CHANCE[f]}
    features = frozenset((drawn | has) - lacks)
    return plant_of(PLANTS[kind](seed, features, spread, finer), seed, features, spread)


def plant_of(layout: Layout, seed: int, features: frozenset[str], spread: float = 1.0) -> Plant:
    """The plant of a seed with these castings."""
    rng = stream(seed, "spindle")
    rated_rpm = float(rng.choice([6000.0, 8000.0, 10000.0, 12000.0]))
    sources = _sources(layout.structure, rng, spread)
    if "motor_loss" not in features:
        del sources["motor_loss"]
    sensors = _sensors(layout.structure, seed)
    return Plant(layout.structure, rated_rpm, sources, layout.growths, sensors, features)


def _sources(s: Structure, rng: np.random.Generator, spread: float) -> dict[str, Source]:
    front, rear = s.part("shaft", (0.12, 0.36)), s.part("shaft", (0.68, 0.88))
    front_ring, rear_ring = s.part("front", (0.0, 0.35)), s.part("rear", (0.0, 0.35))
    into_front = _parted(s, front, front_ring, float(rng.uniform(0.4, 0.6)))
    into_rear = _parted(s, rear, rear_ring, float(rng.uniform(0.4, 0.6)))
    low, high = zip(*(wider(r, spread) for r in WATTS), strict=True)
    watts = rng.uniform(low, high)
    motor = np.zeros(s.size)
    s.part("motor").add(motor, 1.0)
    return {
        "front_bearings": Source("viscous", (float(watts[0]),), into_front, 1.0, front, front_ring),
        "front_preload": Source("load", (float(watts[1]),), into_front, 1.0, front, front_ring),
        "rear_bearings": Source("viscous", (float(watts[2]),), into_rear, 1.0, rear, rear_ring),
        "rear_preload": Source("load", (float(watts[3]),), into_rear, 1.0, rear, rear_ring),
        "motor_loss": Source("motor", tuple(float(w) for w in watts[4:]), motor),
    }


def _parted(s: Structure, one: Part, other: Part, share: float) -> Array:
    """`share` of a heat evenly into `one`, the rest into `other`."""
    out = np.zeros(s.size)
    one.add(out, share)
    other.add(out, 1.0 - share)
    return out


def _sensors(s: Structure, seed: int) -> tuple[Sensor, ...]:
    """A sensor in most bodies, at a cell away from the middle of the body and from its joints."""
    rng = stream(seed, "sensors")
    joined = s.joined()
    out = []
    for body, part in s.bodies.items():
        cells = part.cells
        missing, order = rng.random(), rng.permutation(len(cells))
        lag_s, offset_K = float(rng.uniform(30.0, 60.0)), float(rng.uniform(-0.15, 0.15))
        if body in UNSENSED or (body in SELDOM_SENSED and missing < 0.4):
            continue
        off = s.off_middle(body)
        far = [int(cells[k]) for k in order if 0.35 <= off[k] <= 1.05 and cells[k] not in joined]
        out.append(Sensor(f"t_{body}", body, (far or [int(cells[order[0]])])[0], lag_s, offset_K))
    return tuple(out)


def ordinary(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """No habit."""
    return list(runs)


def coolant_always(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """The pump is never switched off."""
    return [replace(run, coolant=(Block(LONG_AGO_S, 1.0),)) for run in runs]


def one_speed(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """The spindle turns at 0.7 of its rated speed or rests."""
    speed_rpm = round(0.7 * rated_rpm, -2)
    return [replace(run, speed=tuple(replace(b, value=speed_rpm * (b.value > 0)) for b in run.speed)) for run in runs]


def long_runs(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """The spindle starts once from a machine at rest and runs to the end of the shift."""
    out = []
    for run in runs:
        fastest = max((b.value for b in run.speed), default=0.0)
        out.append(replace(run, speed=(Block(STANDING_S, fastest),) if fastest else ()))
    return out


def walls_as_room(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """Walls inside a larger hall: at room temperature all day."""
    return [replace(run, wall_K=0.0, wall_swing=1.0, wall_late_h=0.0) for run in runs]


LONG_AGO_S = -1e6

HABITS = Registry(
    "habit",
    {
        "ordinary": "thermodrift_exam.plants.drawing:ordinary",
        "coolant_always": "thermodrift_exam.plants.drawing:coolant_always",
        "one_speed": "thermodrift_exam.plants.drawing:one_speed",
        "long_runs": "thermodrift_exam.plants.drawing:long_runs",
        "walls_as_room": "thermodrift_exam.plants.drawing:walls_as_room",
    },
)
