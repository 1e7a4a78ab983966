"""Where the castings of a machining centre meet and which of their faces are in whose air."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from twin.plants.elements.box import Piece
from twin.plants.elements.slabs import Slabs
from twin.plants.elements.structure import Assembly, Contact, Face
from twin.plants.seeds import wider

_JOINTS_W_PER_K = {
    "shaft-front": 14.0, "shaft-rear": 8.0, "front-head": 40.0, "rear-head": 25.0, "motor-head": 9.0,
    "head-column": 26.0, "screw-head": 5.0, "screw-column": 6.0, "column-bed": 60.0, "table-below": 18.0,
    "saddle-bed": 20.0, "mandrel-shaft": 9.0,
}  # fmt: skip

_FIRM = (1.0, 1.0, 1.0)
_SLIDING = (1.0, 1.0, 1e-3)  # free upwards
_NUT = (1e-3, 1e-3, 3.0)
_AROUND = ((0, 0), (0, 1), (1, 0), (1, 1))  # the four upright sides, axis and end


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

    def seat(one: str, joint: str, held: tuple[float, float, float], metal: Slabs, around: Piece) -> None:
        """Inside the head: heat passes to all the iron `around`, a larger box like the seat's own."""
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
        seat(ring, f"{ring}-head", _FIRM, mesh[ring].volumes(), (1.0, middle - half, middle + half))
    meet("motor", "head", "motor-head", _FIRM, mesh["motor"].hull([(2, 0)]))
    guided = _SLIDING if "screw" in mesh else _FIRM
    meet("head", "column", "head-column", guided, mesh["head"].hull([(1, 0)]), _rails(a))
    meet("column", "bed", "column-bed", _FIRM, mesh["column"].hull([(2, 0)]))
    if "screw" in mesh:
        nut = mesh["screw"].volumes().within(box.pieces(height=(0.25, 0.75)))
        low, size = np.asarray(box.low_m), np.asarray(box.size_m)
        back = 1.0, low + size * (0.1, 0.0, 0.125), low + size * (0.9, 0.3, 0.875)
        seat("screw", "screw-head", _NUT, nut, back)
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
    """Convection, W/m²/K: what faces the work is inside the enclosure; motor, rear and back are outside."""
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
