"""Horizontal machining centres: two beds, a column that travels, a head with motor spindle, a table with pallets."""

from __future__ import annotations

from collections.abc import Mapping

from thermodrift_exam.plants.kinds.common import Item, Kind, axis_feed, bearings, feed_loss, motor, setting, spindle
from thermodrift_exam.plants.kinds.effects.exchanges import Bridge, Chiller, Clamped
from thermodrift_exam.plants.kinds.effects.faults import Reverses, TestBar
from thermodrift_exam.plants.kinds.effects.heats import Cross, Plateau, Product
from thermodrift_exam.plants.kinds.engine import Cells, Mesh, Solid
from thermodrift_exam.plants.kinds.menus import faults, fluid, paths, shop, spindle_unit
from thermodrift_exam.plants.kinds.plant import Dice, Growth, KindPlant, Source, bending, cut, expanding, place_sensors
from thermodrift_exam.plants.kinds.runs import switch
from thermodrift_exam.plants.options import stream


def draw_horizontal(seed: int, effects: frozenset[str] = frozenset()) -> KindPlant:
    dice = Dice(stream(seed, "horizontal"))
    mesh, bodies = _castings(dice)
    own = setting(dice, effects)
    rated, top = dice.pick((6000.0, 8000.0, 12000.0, 15000.0)), dice.pick((20000.0, 40000.0, 60000.0))
    drivers = {
        "spindle_rpm": spindle(dice, rated), "traverse": axis_feed(dice, top, signed=True),
        "coolant": switch((900.0, 5000.0)), "head_clamped": switch((1500.0, 6000.0), 0.1),
    }  # fmt: skip
    solid = mesh.solid(dice.even(2.0, 5.0))
    seldom = {"head": 1.0, "spindle": 0.0, "stator": 0.9, "pallet": 0.5, "x_screw": 0.5, "y_screw": 0.5, "table": 0.7}
    sensors = place_sensors(dice, solid, bodies, seldom, own)
    airs = ("room", "wall") if dice.chance(0.3) else ("room",)
    return KindPlant(
        solid, bodies, _sources(dice, solid, bodies, rated, top), _growths(dice, solid, bodies), sensors, drivers,
        airs, own, errors=("x", "y", "z"), rated=rated,
    )  # fmt: skip


def _castings(dice: Dice) -> tuple[Mesh, dict[str, Cells]]:
    """x across, y up, z along the spindle; blocks have x along z, so that the spindle is a ring along x."""
    mesh = Mesh()
    long, wide, high = dice.span(1.2, 2.2), dice.span(0.8, 1.6), dice.span(0.35, 0.6)
    solid_share = dice.even(0.2, 0.45)
    mesh.box("z_bed", "cast_iron", (long, 0.9, high), (6, 2, 2), (0.0, -0.45, 0.0), solid_share)
    mesh.box("x_bed", "cast_iron", (0.7, 1.6 * wide, high), (2, 6, 1), (-0.7, -0.8 * wide, 0.0), solid_share)
    tall, deep = dice.span(1.4, 2.4), dice.span(0.4, 0.8)
    mesh.box("column", "cast_iron", (deep, 0.8, tall), (2, 2, 6), (-0.6, -0.4, high), dice.even(0.15, 0.35))
    at = 0.5 * tall + high
    head = dice.span(0.4, 0.7)
    mesh.box("head", "cast_iron", (head, 0.45, 0.45), (3, 2, 2), (-0.5, -0.22, at), dice.even(0.3, 0.6))
    outer = dice.span(0.035, 0.065)
    mesh.ring("spindle", "steel", dice.even(0.008, 0.02), outer, head + 0.12, (6, 1), (-0.5, 0.0, at + 0.2))
    mesh.ring("stator", "laminations", outer + 0.01, dice.even(1.7, 2.2) * outer + 0.01, 0.5 * head, (3, 2),
              (-0.4, 0.0, at + 0.2))  # fmt: skip
    mesh.box("table", "cast_iron", (0.6, 0.7, dice.span(0.15, 0.3)), (2, 2, 1), (0.5, -0.35, high), dice.even(0.4, 0.8))
    mesh.box("pallet", "steel", (0.5, 0.5, dice.span(0.06, 0.12)), (2, 2, 1), (0.55, -0.25, high + 0.3), 0.9)
    mesh.box("x_screw", "steel", (0.035, 1.2 * wide, 0.035), (1, 5, 1), (-0.4, -0.6 * wide, high))
    mesh.box("y_screw", "steel", (0.032, 0.032, 0.8 * tall), (1, 1, 5), (-0.2, 0.0, high + 0.1))
    _joints(dice, mesh)
    for block in mesh.blocks:
        if block != "stator":
            faces = ("x-", "x+", "y-", "y+", "z+") if block.endswith("bed") else ()
            mesh.film(block, "room", dice.span(3.0, 9.0), faces, dice.even(0.0, 0.1) * dice.chance(0.5))
    column = dice.pick((("column_back", "column_front"), ("column_foot", "column_top"), ("column",)))
    bodies = cut(mesh, "column", 2 if "column_top" in column else 0, column)
    return mesh, bodies | {n: c for n, c in mesh.blocks.items() if n != "column"}


def _joints(dice: Dice, mesh: Mesh) -> None:
    mesh.contact(mesh.patch("z_bed", "x-"), mesh.patch("x_bed", "x+", 0.3, 0.7, 1), dice.span(80.0, 500.0))
    mesh.contact(mesh.patch("column", "z-"), mesh.patch("x_bed", "z+", 0.3, 0.7, 1), dice.span(20.0, 120.0))
    mesh.contact(mesh.patch("head", "x-"), mesh.patch("column", "x+", 0.35, 0.65, 2), dice.span(15.0, 90.0))
    mesh.contact(mesh.patch("spindle", "out", 0.7, 1.0), mesh.patch("head", "x+"), dice.span(8.0, 35.0))
    mesh.contact(mesh.patch("spindle", "out", 0.0, 0.25), mesh.patch("head", "x-"), dice.span(5.0, 20.0))
    mesh.contact(mesh.patch("stator", "out"), "head", dice.span(25.0, 150.0))
    mesh.contact(mesh.patch("stator", "in"), mesh.patch("spindle", "out", 0.3, 0.7), dice.span(0.5, 4.0))
    mesh.contact(mesh.patch("table", "z-"), mesh.patch("z_bed", "z+", 0.4, 0.7), dice.span(20.0, 120.0))
    mesh.contact(mesh.patch("pallet", "z-"), mesh.patch("table", "z+"), dice.span(8.0, 60.0))
    mesh.contact(mesh.patch("x_screw", "y-"), mesh.patch("x_bed", "z+", 0.0, 0.2, 1), dice.span(3.0, 15.0))
    mesh.contact(mesh.patch("x_screw", "x-", 0.4, 0.6, 1), mesh.patch("column", "z-"), dice.span(2.0, 12.0))
    mesh.contact(mesh.patch("y_screw", "z-"), mesh.patch("column", "x+", 0.0, 0.2, 2), dice.span(2.0, 12.0))
    mesh.contact(mesh.patch("y_screw", "x-", 0.4, 0.6, 2), mesh.patch("head", "x-"), dice.span(2.0, 12.0))


def _front(bodies: Mapping[str, Cells]) -> str:
    return next(n for n in ("column_front", "column_top", "column") if n in bodies)


def _back(bodies: Mapping[str, Cells]) -> str:
    return next(n for n in ("column_back", "column_foot", "x_bed") if n in bodies)


def _sources(dice: Dice, solid: Solid, bodies: Mapping[str, Cells], rated: float, top: float) -> dict[str, Source]:
    shaft, head = bodies["spindle"], bodies["head"]
    front, rear = ("head", head[-4:]), ("head", head[:4])
    return {
        **bearings(dice, solid, "front_bearings", rated, (80.0, 350.0), ("spindle", shaft[-2:]), front, 85.0),
        **bearings(dice, solid, "rear_bearings", rated, (30.0, 130.0), ("spindle", shaft[:2]), rear, 70.0),
        **motor(dice, solid, "motor_loss", ("stator", bodies["stator"]), rated, (120.0, 600.0)),
        **feed_loss(dice, solid, "x_nut", ("x_screw", bodies["x_screw"]), top, (20.0, 120.0), "traverse"),
    }  # fmt: skip


def _growths(dice: Dice, solid: Solid, bodies: Mapping[str, Cells]) -> dict[str, Growth]:
    front, back = _front(bodies), _back(bodies)
    shaft, um_per_K = bodies["spindle"], dice.sign() * dice.span(2.0, 9.0)
    half = dice.span(0.2, 0.4)
    return {
        "spindle_growth@z": Growth("z", expanding(solid, [(shaft[-4:], dice.span(0.1, 0.3))])),
        "frame@z": Growth("z", expanding(solid, [(bodies["head"], half), (bodies["z_bed"], -dice.span(0.4, 0.9))])),
        "column@y": Growth("y", expanding(solid, [(bodies[front], dice.span(0.3, 0.9)), (bodies["head"], 0.2)])),
        "table@y": Growth("y", expanding(solid, [(bodies["table"], -0.2), (bodies["pallet"], -0.1)])),
        "bending@y": Growth("y", bending(solid, bodies[front], bodies[back], um_per_K), (front, back), um_per_K),
        "scale@x": Growth("x", expanding(solid, [(bodies["x_bed"], dice.sign() * dice.span(0.2, 0.7))])),
        "screw@x": Growth("x", expanding(solid, [(bodies["x_screw"], dice.sign() * dice.span(0.1, 0.4))])),
    }  # fmt: skip


HORIZONTAL = Kind(
    draw_horizontal,
    {
        **shop(("column*", "x_bed", "z_bed", "table"), ("column*", "x_bed"), ("x_bed", "z_bed"),
               ("x_bed", "table", "column", "column_foot"), "traverse"),
        **fluid(("z_bed", "table", "pallet")),
        **spindle_unit(("head",), ("spindle",), ("head", "y_screw"), "spindle", motor="stator", errors=("z", "y")),
        "jacket_chiller": Item(Chiller, ("stator", "head")),
        "joint_conductance": Item(Clamped, ("head",), {"to": "column*", "driver": "head_clamped"}),
        "heat_bridge": Item(Bridge, ("stator", "x_screw", "pallet"), {"conductance": (2.0, 12.0)}),
        **paths(spindle_growth=("spindle_growth@z", "spindle_growth"), bending=("bending@y", "column_bending"),
                scale=("scale@x", "spindle_growth")),
        "test_bar": Item(TestBar, ("z",), {"seat": "spindle"}),
        **faults(("stator", "head", "x_screw", "y_screw"), "head", "column*", "x_bed", "z_bed", "table", "stator"),
    },
    {
        "unlisted_warm_speed": Item(Product, ("column*", "head"), {"driver": "spindle_rpm"}),
        "unlisted_coolant_speed": Item(Cross, ("z_bed", "table"), {"driver": "spindle_rpm", "other": "coolant"}),
        "unlisted_plateau": Item(Plateau, ("head", "stator")),
        "unlisted_reversal": Item(Reverses, ("x", "z"), {"driver": "traverse"}),
    },
)  # fmt: skip
