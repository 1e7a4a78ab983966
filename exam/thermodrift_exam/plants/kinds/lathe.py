"""Slant-bed lathes: headstock, spindle, chuck, bed, carriage, turret, tailstock, feed screw; errors in X and Z."""

from __future__ import annotations

from collections.abc import Mapping

from thermodrift_exam.plants.kinds.common import Item, Kind, axis_feed, bearings, feed_loss, motor, setting, spindle
from thermodrift_exam.plants.kinds.effects.exchanges import Bridge
from thermodrift_exam.plants.kinds.effects.faults import TestBar
from thermodrift_exam.plants.kinds.effects.heats import Cross, Plateau, Product
from thermodrift_exam.plants.kinds.engine import Cells, Mesh, Solid
from thermodrift_exam.plants.kinds.menus import faults, fluid, paths, shop, spindle_unit
from thermodrift_exam.plants.kinds.plant import (
    Dice,
    Growth,
    KindPlant,
    Source,
    bending,
    cut,
    expanding,
    place_sensors,
)
from thermodrift_exam.plants.kinds.runs import switch
from thermodrift_exam.plants.options import stream


def draw_lathe(seed: int, effects: frozenset[str] = frozenset()) -> KindPlant:
    dice = Dice(stream(seed, "lathe"))
    mesh, bodies = _castings(dice)
    own = setting(dice, effects)
    rated = dice.pick((2500.0, 3500.0, 4500.0, 6000.0))
    airs = ("room", "wall") if dice.chance(0.4) else ("room",)
    solid = mesh.solid(dice.even(2.0, 5.0))
    feed_top = dice.pick((6000.0, 12000.0, 20000.0))
    drivers = {
        "spindle_rpm": spindle(dice, rated),
        "feed": axis_feed(dice, feed_top),
        "coolant": switch((900.0, 5000.0)),
    }
    seldom = {"spindle": 0.0, "chuck": 0.15, "turret": 0.6, "screw": 0.6, "tailstock": 0.6}
    sensors = place_sensors(dice, solid, bodies, {"head": 1.0, "head_front": 1.0, **seldom}, own)
    return KindPlant(
        solid, bodies, _sources(dice, solid, bodies, rated, feed_top), _growths(dice, solid, bodies), sensors, drivers,
        airs, own, errors=("x", "z"), rated=rated,
    )  # fmt: skip


def _castings(dice: Dice) -> tuple[Mesh, dict[str, Cells]]:
    mesh = Mesh()
    length, deep, high = dice.span(1.3, 3.0), dice.span(0.4, 0.7), dice.span(0.3, 0.6)
    bed_of = dice.pick(("cast_iron", "cast_iron", "cast_iron", "polymer_concrete"))
    solid_share = 1.0 if bed_of == "polymer_concrete" else dice.even(0.25, 0.5)
    mesh.box("bed", bed_of, (length, deep, high), (dice.whole(7, 10), 2, 2), filled=solid_share)
    head = dice.span(0.4, 0.75), dice.span(0.35, 0.5), dice.span(0.35, 0.5)
    at = (0.0, 0.1, high)
    mesh.box("head", "cast_iron", head, (4, 2, 3), at, dice.even(0.25, 0.5))
    axis = (0.0, 0.1 + head[1] / 2, high + 0.6 * head[2])
    bore, outer = dice.even(0.015, 0.035), dice.span(0.045, 0.08)
    mesh.ring("spindle", "steel", bore, outer, head[0] + 0.1, (6, 1), axis)
    chuck = dice.span(0.08, 0.17), dice.span(0.07, 0.14)
    mesh.ring("chuck", "steel", bore, chuck[0], chuck[1], (2, 2), (head[0] + 0.1, *axis[1:]))
    stator = dice.span(0.09, 0.16)
    mesh.ring("motor", "laminations", 0.5 * stator, stator, dice.span(0.22, 0.4), (3, 2), (0.0, 0.3, high))
    slide_of = dice.pick(("cast_iron", "steel"))
    mid = dice.even(0.4, 0.55) * length
    mesh.box("carriage", slide_of, (0.45, 0.4, dice.span(0.08, 0.16)), (2, 2, 1), (mid, 0.1, high), dice.even(0.5, 0.9))
    turret = dice.span(0.2, 0.34)
    mesh.box("turret", "steel", (turret, turret, turret), (2, 2, 1), (mid, 0.1, high + 0.15), dice.even(0.35, 0.7))
    mesh.box("tailstock", "cast_iron", (0.35, 0.28, 0.32), (2, 1, 2), (0.8 * length, 0.1, high), dice.even(0.3, 0.6))
    mesh.box("screw", "steel", (0.8 * length, dice.even(0.028, 0.05), 0.035), (5, 1, 1), (0.15 * length, 0.3, high))
    _joints(dice, mesh)
    faces = {"bed": ("x-", "x+", "y-", "y+", "z+")}
    for block in mesh.blocks:
        coefficient, exponent = dice.span(3.0, 9.0), dice.even(0.0, 0.1) * dice.chance(0.5)
        mesh.film(block, "room", coefficient, faces.get(block, ()), exponent)
    bed = ("bed_head", "bed_middle", "bed_tail")[: 3 if bed_of == "polymer_concrete" else dice.whole(1, 3)]
    head_names = ("head_rear", "head_front") if dice.chance(0.7) else ("head",)
    bodies = cut(mesh, "bed", 0, bed if len(bed) > 1 else ("bed",)) | cut(mesh, "head", 0, head_names)
    return mesh, bodies | {n: mesh.blocks[n] for n in mesh.blocks if n not in ("bed", "head")}


def _joints(dice: Dice, mesh: Mesh) -> None:
    mesh.contact(mesh.patch("bed", "z+", 0.0, 0.3), mesh.patch("head", "z-"), dice.span(60.0, 400.0))
    mesh.contact(mesh.patch("spindle", "out", 0.65, 0.95), mesh.patch("head", "x+"), dice.span(10.0, 40.0))
    mesh.contact(mesh.patch("spindle", "out", 0.0, 0.3), mesh.patch("head", "x-"), dice.span(6.0, 25.0))
    mesh.contact(mesh.patch("spindle", "x+"), mesh.patch("chuck", "x-"), dice.span(15.0, 90.0))
    mesh.contact(mesh.patch("motor", "out"), mesh.patch("head", "x-"), dice.span(3.0, 30.0))
    mesh.contact(mesh.patch("carriage", "z-"), mesh.patch("bed", "z+", 0.4, 0.6), dice.span(15.0, 90.0))
    mesh.contact(mesh.patch("turret", "z-"), mesh.patch("carriage", "z+"), dice.span(10.0, 80.0))
    mesh.contact(mesh.patch("tailstock", "z-"), mesh.patch("bed", "z+", 0.75, 1.0), dice.span(30.0, 150.0))
    mesh.contact(mesh.patch("screw", "x-"), mesh.patch("bed", "z+", 0.1, 0.3), dice.span(2.0, 15.0))
    mesh.contact(mesh.patch("screw", "y-", 0.35, 0.65), mesh.patch("carriage", "z-"), dice.span(3.0, 20.0))


def _ends(solid: Solid, bodies: Mapping[str, Cells], *names: str) -> tuple[str, Cells]:
    name = next(n for n in names if n in bodies)
    return name, bodies[name]


def _sources(dice: Dice, solid: Solid, bodies: Mapping[str, Cells], rated: float, feed_top: float) -> dict[str, Source]:
    front, rear = _ends(solid, bodies, "head_front", "head"), _ends(solid, bodies, "head_rear", "head")
    shaft = bodies["spindle"]
    return {
        **bearings(dice, solid, "front_bearings", rated, (60.0, 260.0), ("spindle", shaft[-3:]), front, 95.0),
        **bearings(dice, solid, "rear_bearings", rated, (30.0, 120.0), ("spindle", shaft[:2]), rear, 80.0),
        **motor(dice, solid, "motor_loss", ("motor", bodies["motor"]), rated, (90.0, 420.0)),
        **feed_loss(dice, solid, "nut", ("screw", bodies["screw"]), feed_top, (15.0, 80.0)),
    }


def _growths(dice: Dice, solid: Solid, bodies: Mapping[str, Cells]) -> dict[str, Growth]:
    front, rear = _ends(solid, bodies, "head_front", "head")[1], _ends(solid, bodies, "head_rear", "head")[1]
    shaft, bed = bodies["spindle"], _ends(solid, bodies, "bed_head", "bed")[1]
    middle = _ends(solid, bodies, "bed_middle", "bed_head", "bed")[1]
    nose, base, reach = dice.span(0.08, 0.3), dice.span(0.3, 0.8), dice.span(0.2, 0.4)
    hot, cold = _ends(solid, bodies, "head_front", "head")[0], _ends(solid, bodies, "bed_head", "bed")[0]
    tilt, out = dice.sign() * dice.span(1.0, 6.0), -dice.even(0.05, 0.2)
    return {
        "spindle_growth@z": Growth("z", expanding(solid, [(shaft[-4:], -nose)])),
        "structure@z": Growth("z", expanding(solid, [(front, -reach), (bed, base / 2), (middle, base / 2)])),
        "tool@z": Growth("z", expanding(solid, [(bodies["carriage"], 0.15), (bodies["turret"], 0.12)])),
        "centre_height@x": Growth("x", expanding(solid, [(front, dice.even(0.1, 0.25)), (rear, dice.even(0.0, 0.1))])),
        "slide@x": Growth("x", expanding(solid, [(bodies["carriage"], -0.2), (bodies["turret"], out)])),
        "bending@x": Growth("x", bending(solid, bodies[hot], bodies[cold], tilt), (hot, cold), tilt),
    }


LATHE = Kind(
    draw_lathe,
    {
        **shop(("head_rear", "bed_*", "bed", "tailstock"), ("tailstock", "bed*", "carriage"), ("bed*",),
               ("carriage", "turret", "bed_middle")),
        **fluid(("carriage", "turret", "bed_middle", "bed", "chuck")),
        **spindle_unit(("head_front", "head"), ("chuck", "spindle"), ("head_rear", "chuck"), "spindle",
                       errors=("x", "z")),
        "heat_bridge": Item(Bridge, ("motor", "chuck", "screw"), {"conductance": (2.0, 12.0)}),
        **paths(spindle_growth=("spindle_growth@z", "spindle_growth"), bending=("bending@x", "column_bending")),
        "test_bar": Item(TestBar, ("z",), {"seat": "chuck"}),
        **faults(("head*", "motor", "screw", "carriage"), "head*", "bed*", "motor", "carriage", "tailstock", "turret"),
    },
    {
        "unlisted_warm_speed": Item(Product, ("head_rear", "head", "tailstock"), {"driver": "spindle_rpm"}),
        "unlisted_coolant_speed": Item(
            Cross, ("bed_middle", "bed", "carriage"), {"driver": "spindle_rpm", "other": "coolant"}
        ),
        "unlisted_plateau": Item(Plateau, ("head_front", "head", "motor")),
    },
)  # fmt: skip
