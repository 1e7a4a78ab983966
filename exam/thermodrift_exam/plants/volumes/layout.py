"""Plant B: a machine of finite volumes and the paths along which its castings move the tool."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.options import stream, wider
from thermodrift_exam.plants.structure import Growth, Layout, Part
from thermodrift_exam.plants.volumes.structure import Assembly, Plate, Volumes


@dataclass(frozen=True)
class Drawn:
    """Dimensions of the drawing that the rest of the plant needs, in m."""

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
    """Convection, W/m²/K: faces towards the work are inside the enclosure; motor, rear and back are outside."""
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


def path_um_per_K(
    structure: Volumes, casting: str, axis: int, part: tuple[float, float], length_m: float | None = None
) -> Array:
    """Expansion of a casting along one axis between two shares of it: the integral of α θ, mean over the other axis.

    Weights of the cells' rises, (N,).
    `length_m` replaces the path's own length where the casting's picture leaves that side out.
    """
    c, cells = structure.castings[casting], structure.cells[casting]
    whole_m, pitch_m, across = (c.depth_m, c.height_m)[axis], c.pitch_m[axis], c.counts[1 - axis]
    centre_m = c.along_m[axis]
    low, high = centre_m - pitch_m / 2, centre_m + pitch_m / 2
    inside_m = np.clip(np.minimum(high, part[1] * whole_m) - np.maximum(low, part[0] * whole_m), 0.0, None)
    scale = 1.0 if length_m is None else length_m / (whole_m * (part[1] - part[0]))
    weights = np.zeros(structure.size)
    weights[cells] = scale * structure.expansion_um_per_mK[cells] * inside_m / across
    return weights


def bending(structure: Volumes, channel: str, head: float, reach_m: float | None) -> Growth:
    """A column whose depth carries a gradient bends: curvature α dθ/dx at every height, integrated up to the head.

    `head` is its height as a share of the column's. With a `reach_m` the error is the angle there times it, without
    one the column's deflection. Minus: a front that is warmer leans the column back (Timoshenko 1925, one material).
    """
    c, cells = structure.castings["column"], structure.cells["column"]
    x, z = c.along_m
    off = x - c.depth_m / 2
    per_row = np.sum((off[: c.counts[0]]) ** 2)
    stop_m = head * c.height_m
    below_m = np.clip(np.minimum(z + c.pitch_m[1] / 2, stop_m) - (z - c.pitch_m[1] / 2), 0.0, None)
    lever_m = np.clip(stop_m - z, 0.0, None) if reach_m is None else np.full(len(z), reach_m)
    weights = np.zeros(structure.size)
    weights[cells] = -structure.expansion_um_per_mK[cells] * off / per_row * below_m * lever_m
    profile = np.zeros(structure.size)
    profile[cells] = off / (c.depth_m / 2)  # 1 K between the means of the halves
    front, back = "column_front", "column_back"
    lead_K = structure.bodies[front].mean(profile) - structure.bodies[back].mean(profile)
    lumped = float(weights @ profile) / float(lead_K)
    return Growth("bending", channel, weights, (front, back), lumped)


def bow(structure: Volumes, channel: str, gain_um_per_K: float, warm: Part, cold: Part, who: tuple[str, str]) -> Growth:
    """A sideways bow in step with the difference between two pieces."""
    weights = np.zeros(structure.size)
    warm.add(weights, gain_um_per_K)
    cold.add(weights, -gain_um_per_K)
    return Growth("bow", channel, weights, who, gain_um_per_K)


def draw_layout(seed: int, features: frozenset[str], spread: float = 1.0, finer: int = 1) -> Layout:
    """The castings of a seed, cut into cells, with or without a test mandrel; `finer` times as fine along both axes."""
    drawn = draw_castings(seed, "mandrel" in features, spread, finer)
    return Layout(drawn.structure, _growths(drawn, features))


def _growths(drawn: Drawn, features: frozenset[str]) -> tuple[Growth, ...]:
    """z: + closes the gap between tool and table; y: + away from the column; x: sideways."""
    s, at = drawn.structure, drawn.head_at
    motor = s.part("motor")
    motor_base = s.part("head", (0.1, 0.45), (0.8, 1.0))
    rear = "head_rear" if "head_rear" in s.bodies else "head"
    out = [
        Growth("column", "z", -path_um_per_K(s, "column", 1, (0.0, at))),
        Growth("head", "z", path_um_per_K(s, "head", 1, (0.0, 0.5))),
        Growth("table", "z", path_um_per_K(s, "table", 1, (0.0, 1.0))),
        Growth("head", "y", path_um_per_K(s, "head", 0, (0.0, 0.9))),
        Growth("bed", "y", -path_um_per_K(s, "bed", 0, (0.33, 0.75))),
        Growth("table", "y", -path_um_per_K(s, "table", 0, (0.5, 0.9))),
        Growth("table", "x", path_um_per_K(s, "table", 0, (0.0, 1.0), drawn.table_width_m)),
        Growth("bed", "x", -path_um_per_K(s, "bed", 0, (0.3, 0.8), drawn.table_width_m)),
        bow(s, "x", 0.6, motor, motor_base, ("motor", rear)),
    ]
    if "saddle" in s.castings:
        out.append(Growth("saddle", "z", path_um_per_K(s, "saddle", 1, (0.0, 1.0))))
    if "screw" in s.castings:
        out.append(Growth("screw", "z", path_um_per_K(s, "screw", 0, (0.4, 1.0))))
    if "growth" in features:
        out.append(Growth("growth", "z", path_um_per_K(s, "shaft", 0, (0.0, 0.3))))
    if "mandrel" in features:
        out.append(Growth("mandrel", "z", path_um_per_K(s, "mandrel", 0, (0.0, 1.0))))
    if "bending" in features:
        out += [bending(s, "z", at, drawn.reach_m), bending(s, "y", at, None)]
    return tuple(out)
