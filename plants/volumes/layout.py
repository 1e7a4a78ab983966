"""Plant B: a machine of finite volumes and the paths along which its castings move the tool."""

from __future__ import annotations

import numpy as np

from plants.structure import Growth, Layout, Part
from plants.volumes.geometry import Drawn, draw_castings
from plants.volumes.structure import Volumes


def path(
    structure: Volumes, name: str, channel: str, casting: str, axis: int, part: tuple[float, float], sign: int,
    length_m: float | None = None,
) -> Growth:  # fmt: skip
    """Expansion of a casting along one axis between two shares of it: the integral of α θ, mean over the other axis.

    `length_m` replaces the path's own length where the casting's picture leaves that side out.
    """
    c, cells = structure.castings[casting], structure.cells[casting]
    whole_m, pitch_m, across = (c.depth_m, c.height_m)[axis], c.pitch_m[axis], c.counts[1 - axis]
    centre_m = c.along_m[axis]
    low, high = centre_m - pitch_m / 2, centre_m + pitch_m / 2
    inside_m = np.clip(np.minimum(high, part[1] * whole_m) - np.maximum(low, part[0] * whole_m), 0.0, None)
    scale = 1.0 if length_m is None else length_m / (whole_m * (part[1] - part[0]))
    weights = np.zeros(structure.size)
    weights[cells] = sign * scale * structure.expansion_um_per_mK[cells] * inside_m / across
    return Growth(name, channel, weights)


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
    seat = s.part("head", (0.1, 0.45), (0.8, 1.0))
    seat_body = "head_rear" if "head_rear" in s.bodies else "head"
    out = [
        path(s, "column", "z", "column", 1, (0.0, at), -1),
        path(s, "head", "z", "head", 1, (0.0, 0.5), 1),
        path(s, "table", "z", "table", 1, (0.0, 1.0), 1),
        path(s, "head", "y", "head", 0, (0.0, 0.9), 1),
        path(s, "bed", "y", "bed", 0, (0.33, 0.75), -1),
        path(s, "table", "y", "table", 0, (0.5, 0.9), -1),
        path(s, "table", "x", "table", 0, (0.0, 1.0), 1, drawn.table_width_m),
        path(s, "bed", "x", "bed", 0, (0.3, 0.8), -1, drawn.table_width_m),
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
        out += [bending(s, "z", at, drawn.reach_m), bending(s, "y", at, None)]
    return tuple(out)
