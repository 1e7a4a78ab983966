"""A vertical machining centre in space drawn from a seed: places and walls of its castings; no two alike.

x sideways, y from the column's back to the operator, z up, the floor at 0; lengths in m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import brentq

from data.arrays import Array
from thermodrift_exam.plants.elements.mesh import Box, Piece, Slabs
from thermodrift_exam.plants.elements.structure import Assembly, Contact, Elements, Face
from thermodrift_exam.plants.options import stream, wider
from thermodrift_exam.plants.structure import MATERIALS

_JOINTS_W_PER_K = {
    "shaft-front": 14.0, "shaft-rear": 8.0, "front-head": 40.0, "rear-head": 25.0, "motor-head": 9.0,
    "head-column": 26.0, "screw-head": 5.0, "screw-column": 6.0, "column-bed": 60.0, "table-below": 18.0,
    "saddle-bed": 20.0, "mandrel-shaft": 9.0,
}  # fmt: skip

_FIRM = (1.0, 1.0, 1.0)
_SLIDING = (1.0, 1.0, 1e-3)  # free upwards
_NUT = (1e-3, 1e-3, 3.0)


def join(a: Assembly, rng: np.random.Generator, spread: float = 1.0) -> None:
    """Contacts of all castings that the machine has.

    Rear bearings let the shaft grow upwards. Guides carry the head, and along them the screw's nut holds it, without a
    screw the clamp at the scale.
    """
    g = {name: value * float(np.exp(0.25 * spread * rng.standard_normal())) for name, value in _JOINTS_W_PER_K.items()}

    mesh = a.meshes

    def meet(
        one: str, other: str, joint: str, held: tuple[float, float, float], faces: Slabs,
        pieces: Sequence[Piece] | None = None,
    ) -> None:  # fmt: skip
        patch = (faces.within(pieces) if pieces else faces).cut(mesh[one].lines_m).cut(mesh[other].lines_m)
        points_m, area_m2 = patch.gauss()
        a.contacts.append(Contact(one, other, points_m, points_m, area_m2, g[joint], held))

    def embed(one: str, joint: str, held: tuple[float, float, float], metal: Slabs, around: Piece) -> None:
        """Inside the head: heat passes to all the iron `around`, a larger box similar to its own."""
        _, under, over = around
        under, over = np.maximum(under, box.low_m), np.minimum(over, box.high_m)
        low, high = metal.low_m.min(axis=0), metal.high_m.max(axis=0)
        wider = (over - under) / (high - low)
        axes = zip(mesh["head"].lines_m, low, under, wider, strict=True)
        head = [own + (line - into) / more for line, own, into, more in axes]
        points_m, volume_m3 = metal.cut(head).gauss()
        area_m2 = 4.0 * np.sqrt(np.prod((high - low)[:2])) * (high - low)[2] * volume_m3 / volume_m3.sum()
        a.contacts.append(Contact(one, "head", points_m, under + wider * (points_m - low), area_m2, g[joint], held))

    box = mesh["head"].box
    for ring, held in (("front", _FIRM), ("rear", _SLIDING)):
        meet("shaft", ring, f"shaft-{ring}", held, mesh[ring].bore())
        own = mesh[ring].box
        middle, half = (own.low_m + own.high_m) / 2.0, np.array([0.45, 0.2, 0.2]) * box.size_m
        embed(ring, f"{ring}-head", _FIRM, mesh[ring].volumes(), (1.0, middle - half, middle + half))
    meet("motor", "head", "motor-head", _FIRM, mesh["motor"].hull([(2, 0)]))
    guided = _SLIDING if "screw" in mesh else _FIRM
    meet("head", "column", "head-column", guided, mesh["head"].hull([(1, 0)]), _rails(a))
    meet("column", "bed", "column-bed", _FIRM, mesh["column"].hull([(2, 0)]))
    if "screw" in mesh:
        nut = mesh["screw"].volumes().within(box.pieces(height=(0.25, 0.75)))
        low, size = np.asarray(box.low_m), np.asarray(box.size_m)
        back = 1.0, low + size * (0.1, 0.0, 0.125), low + size * (0.9, 0.3, 0.875)
        embed("screw", "screw-head", _NUT, nut, back)
        top = mesh["screw"].box.pieces((0.9, 1.0))
        meet("screw", "column", "screw-column", _FIRM, mesh["screw"].hull([(1, 0)]), top)
    below = "saddle" if "saddle" in mesh else "bed"
    if below == "saddle":
        meet("saddle", "bed", "saddle-bed", _FIRM, mesh["saddle"].hull([(2, 0)]))
    meet("table", below, "table-below", _FIRM, mesh["table"].hull([(2, 0)]))
    if "mandrel" in mesh:
        meet("mandrel", "shaft", "mandrel-shaft", _FIRM, mesh["mandrel"].hull([(2, 1)]))


def _rails(a: Assembly) -> list[Piece]:
    """Two guides: the outer three tenths of the head's width."""
    box = a.meshes["head"].box
    low, high = np.asarray(box.low_m), box.high_m
    inner = np.array([0.7 * (high[0] - low[0]), 0.0, 0.0])
    return [(1.0, low, high - inner), (1.0, low + inner, high)]


def expose(a: Assembly, rng: np.random.Generator, spread: float = 1.0) -> None:
    """Convection, W/m²/K: faces towards the work are inside the enclosure; motor, rear and back are outside."""
    h = {name: float(rng.uniform(*wider((4.5, 8.0), spread))) for name in (b.name for b in a.boxes)}
    inside = ("shaft", "front", "table", "screw", "saddle", "mandrel")
    for box in a.boxes:
        if box.name in ("head", "column"):
            a.faces.append(Face(box.name, box.pieces((0.5, 1.0)), h[box.name], enclosed=True))
            a.faces.append(Face(box.name, box.pieces((0.0, 0.5)), h[box.name], enclosed=False))
        elif box.name == "bed":
            a.faces.append(Face("bed", box.pieces(height=(0.66, 1.0)), h["bed"], enclosed=True))
            a.faces.append(Face("bed", box.pieces(height=(0.0, 0.66)), h["bed"], enclosed=False))
        else:
            more = 1.5 if box.name in ("motor", "table") else 1.0
            a.faces.append(Face(box.name, box.pieces(), more * h[box.name], box.name in inside))


Corner = tuple[float, float, float]

FOOT, HEAD_HIGH, SHAFT_TO_HEAD = 0.42, 0.42, 0.8  # heights as shares of the machine's size; head's of the shaft
BELT = (0.10, 0.36)  # a shaft's shares within its front bearings' housing
TAIL = (0.66, 0.88)

_ASIDE = {"motor": (0.02, 0.045), "table": (0.06, 0.15)}  # shares of the machine's size


@dataclass(frozen=True)
class Drawn:
    """The structure, its contacts, and the two points whose distance is the error, (3,)."""

    structure: Elements
    contacts: list[Contact]
    tool_m: Array
    table_m: Array


@dataclass(frozen=True)
class Measures:
    """Random choices of a seed."""

    size: float
    mass: dict[str, float]  # of each casting as a factor
    head_at: float
    aside_m: dict[str, float]  # of motor and table from the middle plane: no machine is symmetric
    screw: bool
    saddle: bool
    mandrel: bool


def draw_castings(seed: int, mandrel: bool, finer: int = 1, spread: float = 1.0) -> Drawn:
    """The machine of a seed, with or without a test mandrel; every cell cut `finer` along each axis.

    `spread` widens what sizes there are.
    """
    rng = stream(seed, "elements geometry")
    size = float(rng.uniform(*wider((0.85, 1.25), spread)))
    names = ("column", "head", "bed", "table", "saddle", "spindle", "motor")
    mass = {n: float(rng.uniform(*wider((0.85, 1.2), spread))) for n in names}
    enclosed, screw, saddle, head_halves = (bool(rng.random() < p) for p in (0.6, 0.6, 0.4, 0.6))
    aside = {n: float(rng.choice([-1.0, 1.0]) * rng.uniform(*_ASIDE[n]) * size) for n in ("motor", "table")}
    m = Measures(size, mass, float(rng.uniform(0.6, 0.78)), aside, screw, saddle, mandrel)
    air_J_per_K, air_room_W_per_K = (float(rng.uniform(*wider(r, spread))) for r in ((18e3, 40e3), (45.0, 95.0)))
    boxes = {box.name: box.finer(finer) if finer > 1 else box for box in _boxes(m)}
    halves = frozenset({"column", "head"} if head_halves else {"column"})
    a = Assembly(list(boxes.values()), halves, air_J_per_K if enclosed else None, air_room_W_per_K)
    join(a, rng, spread)
    expose(a, rng, spread)
    end = boxes["mandrel" if mandrel else "shaft"]
    tool = np.array([0.0, end.low_m[1] + end.size_m[1] / 2, end.low_m[2]])
    return Drawn(a.done(), a.contacts, tool, np.array([0.0, tool[1], boxes["table"].high_m[2]]))


def _boxes(m: Measures) -> list[Box]:
    """Iron castings scale with the machine's size, squared in mass; the spindle's section does not."""
    s, f = m.size, m.mass
    iron, steel = "cast_iron", "steel"
    foot, head_m = FOOT * s, HEAD_HIGH * s
    low = foot + 1.35 * s * m.head_at - head_m / 2
    long = head_m / SHAFT_TO_HEAD
    nose = low - 0.08 * long
    back = 0.6 * s  # where the column ends and the head begins
    axis = back + 0.5 * s
    kg = 14 * f["spindle"]
    thick = float(np.sqrt(kg / (7850.0 * long)))
    saddle_m = 0.11 * s if m.saddle else 0.0

    def bar(name: str, kg: float, foot: Corner, side: float, height: float, n: int) -> Box:
        x, y, z = foot
        return Box(name, steel, kg, (x - side / 2, y - side / 2, z), (side, side, height), (1, 1, n), axes="upright")

    def ring(name: str, kg: float, span: tuple[float, float]) -> Box:
        height = (span[1] - span[0]) * long
        wall = (np.sqrt(thick**2 + kg / (7850.0 * height)) - thick) / 2
        side = thick + 2 * wall
        at = (-side / 2, axis - side / 2, nose + span[0] * long)
        return Box(name, steel, kg, at, (side, side, height), (1, 1, 3), "tube", wall, "ring")

    aside, over = m.aside_m, low + head_m
    boxes = [
        bar("shaft", kg, (0.0, axis, nose), thick, long, 20),
        ring("front", 17 * f["spindle"], BELT),
        ring("rear", 10.5 * f["spindle"], TAIL),
        Box("head", iron, 300 * s * s * f["head"], (-0.16 * s, back, low), (0.32 * s, 0.64 * s, head_m), (2, 6, 4)),
    ]
    at, size = (aside["motor"] - 0.1, back + 0.06 * s, over), (0.2, 0.2, 0.26)
    boxes.append(Box("motor", steel, 50 * f["motor"], at, size, (2, 2, 3)))
    at, size = (-0.23 * s, 0.07 * s, foot), (0.46 * s, 0.53 * s, 1.35 * s)
    boxes.append(_walled("column", 620 * s * s * f["column"], at, size, (3, 2, 9)))
    boxes.append(_walled("bed", 1600 * s * s * f["bed"], (-0.38 * s, 0.0, 0.0), (0.76 * s, 1.85 * s, foot), (2, 8, 2)))
    at, size = (aside["table"] - 0.45 * s, axis - 0.32 * s, foot + saddle_m), (0.9 * s, 0.64 * s, 0.13 * s)
    boxes.append(Box("table", iron, 370 * s * s * f["table"], at, size, (5, 3, 1)))
    if m.saddle:
        at, size = (-0.26 * s, axis - 0.36 * s, foot), (0.52 * s, 0.72 * s, saddle_m)
        boxes.append(Box("saddle", iron, 210 * s * s * f["saddle"], at, size, (3, 4, 1)))
    if m.screw:
        across = float(np.sqrt(kg / (7850.0 * 0.75 * s)))
        boxes.append(bar("screw", kg, (0.0, back + across / 2, foot + 0.58 * s), across, 0.75 * s, 12))
    if m.mandrel:
        boxes.append(bar("mandrel", 3.5, (0.0, axis, nose - 0.25), 0.042, 0.25, 5))
    return boxes


def _walled(name: str, kg: float, low: Corner, size: Corner, cells: tuple[int, int, int]) -> Box:
    """Walls of the thickness that the mass requires; a bed has a lid."""
    bulk_m3 = kg / MATERIALS["cast_iron"].density_kg_per_m3
    hollow: Literal["tube", "cap"] = "cap" if name == "bed" else "tube"

    def box(wall_m: float) -> Box:
        return Box(name, "cast_iron", kg, low, size, cells, hollow, wall_m)

    return box(float(brentq(lambda t: box(t).volume_m3 - bulk_m3, 0.005, 0.45 * min(size))))
