"""The rest of a plant from a seed: spindle losses, paths of displacement, sensors off the middle of their bodies."""

from __future__ import annotations

import numpy as np

from twin.plants.casting import Array, Cells
from twin.plants.geometry import Layout, draw_layout
from twin.plants.growth import Growth, bending, bow, path
from twin.plants.machine import FEATURES, Plant, Sensor, Source
from twin.plants.seeds import stream
from twin.plants.structure import AIR, Structure

CHANCE = {
    "feed": 0.5, "coolant": 0.5, "walls": 0.4, "layers": 0.4,
    "motor_loss": 0.75, "bending": 0.75, "growth": 0.85, "mandrel": 0.5,
}  # fmt: skip
UNSENSED = ("shaft", "mandrel", AIR)
SELDOM_SENSED = ("saddle", "table", "screw")


def draw_plant(seed: int, has: frozenset[str], lacks: frozenset[str]) -> Plant:
    """The plant of a seed; `has` and `lacks` overrule what the seed says about `FEATURES`."""
    dice = stream(seed, "features").random(len(FEATURES))
    drawn = {f for f, d in zip(FEATURES, dice, strict=True) if d < CHANCE[f]}
    features = frozenset((drawn | has) - lacks)
    layout = draw_layout(seed, mandrel="mandrel" in features)
    rng = stream(seed, "spindle")
    rated_rpm = float(rng.choice([6000.0, 8000.0, 10000.0, 12000.0]))
    sources = _sources(layout.structure, rng)
    if "motor_loss" not in features:
        del sources["motor_loss"]
    return Plant(
        layout.structure, rated_rpm, sources, _growths(layout, features), _sensors(layout.structure, seed), features
    )  # fmt: skip


def _sources(s: Structure, rng: np.random.Generator) -> dict[str, Source]:
    def part(casting: str, depth: tuple[float, float]) -> Cells:
        return s.cells[casting][s.castings[casting].box(depth)]

    front, rear = part("shaft", (0.12, 0.36)), part("shaft", (0.68, 0.88))
    front_ring, rear_ring = part("front", (0.0, 0.35)), part("rear", (0.0, 0.35))
    into_front = _parted(s, front, front_ring, float(rng.uniform(0.4, 0.6)))
    into_rear = _parted(s, rear, rear_ring, float(rng.uniform(0.4, 0.6)))
    watts = rng.uniform([70, 20, 35, 10, 20, 60, 40], [160, 60, 80, 30, 60, 140, 100])
    motor = np.zeros(s.size)
    motor[s.cells["motor"]] = 1.0 / len(s.cells["motor"])
    return {
        "front_bearings": Source("viscous", (float(watts[0]),), into_front, 1.0, front, front_ring),
        "front_preload": Source("load", (float(watts[1]),), into_front, 1.0, front, front_ring),
        "rear_bearings": Source("viscous", (float(watts[2]),), into_rear, 1.0, rear, rear_ring),
        "rear_preload": Source("load", (float(watts[3]),), into_rear, 1.0, rear, rear_ring),
        "motor_loss": Source("motor", tuple(float(w) for w in watts[4:]), motor),
    }


def _parted(s: Structure, one: Cells, other: Cells, share: float) -> Array:
    """`share` of a heat evenly into `one`, the rest into `other`."""
    out = np.zeros(s.size)
    out[one], out[other] = share / len(one), (1.0 - share) / len(other)
    return out


def _growths(layout: Layout, features: frozenset[str]) -> tuple[Growth, ...]:
    """z: + closes the gap between tool and table; y: + away from the column; x: sideways."""
    s, at = layout.structure, layout.head_at
    motor = s.cells["motor"]
    seat = s.cells["head"][s.castings["head"].box((0.1, 0.45), (0.8, 1.0))]
    seat_body = "head_rear" if "head_rear" in s.bodies else "head"
    out = [
        path(s, "column", "z", "column", 1, (0.0, at), -1),
        path(s, "head", "z", "head", 1, (0.0, 0.5), 1),
        path(s, "table", "z", "table", 1, (0.0, 1.0), 1),
        path(s, "head", "y", "head", 0, (0.0, 0.9), 1),
        path(s, "bed", "y", "bed", 0, (0.33, 0.75), -1),
        path(s, "table", "y", "table", 0, (0.5, 0.9), -1),
        path(s, "table", "x", "table", 0, (0.0, 1.0), 1, layout.table_width_m),
        path(s, "bed", "x", "bed", 0, (0.3, 0.8), -1, layout.table_width_m),
        bow(s, "x", 0.6, motor, seat, ("motor", seat_body)),
    ]
    if "saddle" in s.castings:
        out.append(path(s, "saddle", "z", "saddle", 1, (0.0, 1.0), 1))
    if "screw" in s.castings:
        out.append(path(s, "screw", "z", "screw", 0, (0.4, 1.0), 1))
    if "growth" in features:
        out.append(path(s, "growth", "z", "shaft", 0, (0.0, 0.3), 1))
    if "mandrel" in features:
        out.append(path(s, "mandrel", "z", "mandrel", 0, (0.0, 1.0), 1))
    if "bending" in features:
        out += [bending(s, "z", at, layout.reach_m), bending(s, "y", at, None)]
    return tuple(out)


def _sensors(s: Structure, seed: int) -> tuple[Sensor, ...]:
    """One in most bodies, at a cell away from the body's middle and from its joints."""
    rng = stream(seed, "sensors")
    joined = s.joined()
    out = []
    for body, cells in s.bodies.items():
        missing, order = rng.random(), rng.permutation(len(cells))
        lag_s, offset_K = float(rng.uniform(30.0, 60.0)), float(rng.uniform(-0.15, 0.15))
        if body in UNSENSED or (body in SELDOM_SENSED and missing < 0.4):
            continue
        off = _off_middle(s, cells)
        far = [int(cells[k]) for k in order if 0.35 <= off[k] <= 1.05 and cells[k] not in joined]
        out.append(Sensor(f"t_{body}", body, (far or [int(cells[order[0]])])[0], lag_s, offset_K))
    return tuple(out)


def _off_middle(s: Structure, cells: Cells) -> Array:
    """Distance of a body's cells from its middle, 1 at the middle of a side."""
    name = next(n for n, own in s.cells.items() if cells[0] in own)
    here = np.searchsorted(s.cells[name], cells)
    off = []
    for along in s.castings[name].along_m:
        own = along[here]
        half = max(np.ptp(own) / 2, 1e-9)
        off.append((own - (own.max() + own.min()) / 2) / half)
    return np.asarray(np.max(np.abs(off), axis=0))
