"""A vertical machining centre drawn from a seed: sizes, masses, joints, surfaces; no two alike."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plants.options import stream, wider
from plants.volumes.structure import Assembly, Plate, Volumes


@dataclass(frozen=True)
class Drawn:
    """What the drawing decides and the rest of the plant must know, lengths in m."""

    structure: Volumes
    head_at: float  # height of the head's middle as a share of the column's
    reach_m: float  # from the column's front to the spindle
    table_width_m: float


def draw_castings(seed: int, mandrel: bool, spread: float = 1.0, finer: int = 1) -> Drawn:
    """The structure of the machine of a seed, with or without a test mandrel; `spread` widens what sizes there are.

    Every cell is cut `finer` along both axes.
    """
    rng = stream(seed, "geometry")
    size = float(rng.uniform(*wider((0.8, 1.3), spread)))
    a = Assembly()
    names = ("column", "head", "bed", "table", "saddle", "spindle", "motor")
    sizes = {n: float(rng.uniform(*wider((0.85, 1.2), spread))) for n in names}
    counts = {n: int(rng.integers(*r)) for n, r in _COUNTS.items()}
    enclosed, screw, saddle, head_halves = (bool(rng.random() < p) for p in (0.6, 0.6, 0.4, 0.6))
    air_J_per_K, air_room_W_per_K = (float(rng.uniform(*wider(r, spread))) for r in ((18e3, 40e3), (45.0, 95.0)))
    head_at = float(rng.uniform(0.62, 0.8))
    absent = {n for n, there in (("screw", screw), ("saddle", saddle), ("mandrel", mandrel)) if not there}
    for casting in _castings(size, sizes, counts, head_at):
        if casting.name in absent:
            continue
        halves = casting.name == "column" or (casting.name == "head" and head_halves)
        a.add(replace(casting, split=finer), halves)
    a.air_J_per_K = air_J_per_K if enclosed else None
    joints = {n: g * float(np.exp(0.25 * spread * rng.standard_normal())) for n, g in _JOINTS_W_PER_K.items()}
    _join(a, joints, head_at)
    _expose(a, rng, spread)
    return Drawn(a.done(air_room_W_per_K), head_at, 0.9 * a.castings["head"].depth_m, 0.1 * size)


_COUNTS = {
    "column_x": (5, 7),
    "column_z": (8, 13),
    "head_x": (5, 8),
    "head_z": (4, 6),
    "bed": (10, 15),
    "shaft": (9, 13),
}

_JOINTS_W_PER_K = {
    "shaft-front": 14.0, "shaft-rear": 8.0, "front-head": 40.0, "rear-head": 25.0, "motor-head": 9.0,
    "head-column": 26.0, "screw-head": 5.0, "screw-column": 6.0, "column-bed": 60.0, "table-below": 18.0,
    "saddle-bed": 20.0, "mandrel-shaft": 9.0,
}  # fmt: skip


def _castings(s: float, f: dict[str, float], n: dict[str, int], head_at: float) -> list[Plate]:
    """Iron castings scale with the machine's size, squared in mass; the spindle does not."""
    foot = 0.45 * s
    head_m = foot + 1.4 * s * head_at - 0.22 * s
    iron, steel = "cast_iron", "steel"
    column = n["column_x"], n["column_z"]
    return [
        Plate("shaft", steel, 14 * f["spindle"], 0.42, 0.06, 0.06, (n["shaft"], 1), head_m, upright=True),
        Plate("front", steel, 17 * f["spindle"], 0.15, 0.18, 0.05, (5, 1), head_m),
        Plate("rear", steel, 10.5 * f["spindle"], 0.12, 0.15, 0.05, (4, 1), head_m + 0.35),
        Plate("motor", steel, 50 * f["motor"], 0.26, 0.22, 0.22, (5, 1), head_m + 0.45 * s),
        Plate("head", iron, 320 * s * s * f["head"], 0.62 * s, 0.45 * s, 0.3 * s, (n["head_x"], n["head_z"]), head_m),
        Plate("column", iron, 640 * s * s * f["column"], 0.5 * s, 1.4 * s, 0.45 * s, column, foot),
        Plate("bed", iron, 1700 * s * s * f["bed"], 1.8 * s, 0.45 * s, 0.7 * s, (n["bed"], 3), 0.0),
        Plate("saddle", iron, 220 * s * s * f["saddle"], 0.7 * s, 0.12 * s, 0.5 * s, (6, 1), foot),
        Plate("table", iron, 380 * s * s * f["table"], 0.6 * s, 0.14 * s, 0.9 * s, (8, 2), foot + 0.12 * s),
        Plate("screw", steel, 14 * f["spindle"], 0.75 * s, 0.035, 0.035, (12, 1), foot + 0.6 * s, upright=True),
        Plate("mandrel", steel, 3.5, 0.25, 0.04, 0.04, (5, 1), head_m - 0.25, upright=True),
    ]  # fmt: skip


def _join(a: Assembly, g: dict[str, float], head_at: float) -> None:
    """Contacts where they are on a machine of this kind; the shaft's first cells are its nose."""
    a.joint(a.box("shaft", (0.12, 0.36)), a.box("front", (0.0, 0.35)), g["shaft-front"])
    a.joint(a.box("shaft", (0.68, 0.88)), a.box("rear", (0.0, 0.35)), g["shaft-rear"])
    a.joint(a.box("front", (0.6, 1.0)), a.box("head", (0.72, 1.0), (0.0, 0.55)), g["front-head"])
    a.joint(a.box("rear", (0.6, 1.0)), a.box("head", (0.25, 0.49), (0.45, 1.0)), g["rear-head"])
    a.joint(a.box("motor", (0.0, 0.25)), a.box("head", (0.1, 0.45), (0.8, 1.0)), g["motor-head"])
    slide = (head_at - 0.16, head_at + 0.16)
    a.joint(a.box("head", (0.0, 0.12)), a.box("column", (0.85, 1.0), slide), g["head-column"])
    a.joint(a.box("column", height=(0.0, 0.12)), a.box("bed", (0.03, 0.33), (0.7, 1.0)), g["column-bed"])
    if "screw" in a.castings:
        a.joint(a.box("screw", (0.3, 0.45)), a.box("head", (0.0, 0.15), (0.4, 0.6)), g["screw-head"])
        a.joint(a.box("screw", (0.9, 1.0)), a.box("column", (0.85, 1.0), (0.9, 1.0)), g["screw-column"])
    below = "bed"
    if "saddle" in a.castings:
        a.joint(a.box("saddle", (0.1, 0.9)), a.box("bed", (0.5, 0.85), (0.7, 1.0)), g["saddle-bed"])
        below = "saddle"
    top = a.box("saddle", (0.1, 0.9)) if below == "saddle" else a.box("bed", (0.5, 0.9), (0.7, 1.0))
    a.joint(a.box("table", (0.1, 0.9), (0.0, 0.4)), top, g["table-below"])
    if "mandrel" in a.castings:
        a.joint(a.box("mandrel", (0.8, 1.0)), a.box("shaft", (0.0, 0.1)), g["mandrel-shaft"])


def _expose(a: Assembly, rng: np.random.Generator, spread: float) -> None:
    """Convection, W/m²/K: what faces the work is inside the enclosure, motor, rear and back are outside."""
    h = {name: float(rng.uniform(*wider((4.5, 8.0), spread))) for name in a.castings}
    inside = ("shaft", "front", "table", "screw", "saddle", "mandrel")
    for name in a.castings:
        if name in ("head", "column"):
            a.exposed(a.box(name, (0.5, 1.0)), h[name], enclosed=True)
            a.exposed(np.setdiff1d(a.box(name), a.box(name, (0.5, 1.0))), h[name], enclosed=False)
        elif name == "bed":
            a.exposed(a.box(name, height=(0.66, 1.0)), h[name], enclosed=True)
            a.exposed(a.box(name, height=(0.0, 0.66)), h[name], enclosed=False)
        else:
            a.exposed(a.box(name), 1.5 * h[name] if name in ("motor", "table") else h[name], name in inside)
