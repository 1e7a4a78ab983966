"""Plant B: a machine of finite volumes and the paths along which its castings move the tool."""

from __future__ import annotations

from twin.plants.growth import Growth
from twin.plants.machine import Layout
from twin.plants.volumes.geometry import Drawn, draw_castings
from twin.plants.volumes.growth import bending, bow, path


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
