"""Gantry machines: a long bed, two columns, a crossbeam, a saddle with a ram, a motor spindle below it."""

from __future__ import annotations

from collections.abc import Mapping

from thermodrift_exam.plants.kinds.common import Item, Kind, axis_feed, bearings, feed_loss, motor, setting, spindle
from thermodrift_exam.plants.kinds.effects.exchanges import Bridge, Chiller, Radiates
from thermodrift_exam.plants.kinds.effects.faults import Reverses, TestBar
from thermodrift_exam.plants.kinds.effects.heats import Cabinet, Cross, Plateau, Product
from thermodrift_exam.plants.kinds.engine import Cells, Mesh, Solid
from thermodrift_exam.plants.kinds.menus import faults, fluid, paths, shop, spindle_unit
from thermodrift_exam.plants.kinds.plant import Dice, Growth, KindPlant, Source, bending, cut, expanding, place_sensors
from thermodrift_exam.plants.kinds.runs import switch
from thermodrift_exam.plants.options import stream


def draw_gantry(seed: int, effects: frozenset[str] = frozenset()) -> KindPlant:
    dice = Dice(stream(seed, "gantry"))
    mesh, bodies = _castings(dice)
    row_s = dice.pick((120.0, 180.0, 300.0))
    own = setting(dice, effects, row_s=row_s, hours=(3.0, 8.0), day_K=dice.span(0.6, 4.0), slow_K=dice.even(0.5, 4.0))
    rated, top = dice.pick((8000.0, 12000.0, 18000.0, 24000.0)), dice.pick((15000.0, 30000.0))
    walls = dice.chance(0.7) or "radiation_walls" in effects
    drivers = {
        "spindle_rpm": spindle(dice, rated), "feed": axis_feed(dice, top, signed=True),
        "coolant": switch((1200.0, 6000.0)), "extraction": switch((1800.0, 7000.0)),
    }  # fmt: skip
    solid = mesh.solid(dice.even(2.0, 5.0))
    seldom = {"spindle": 0.0, "sleeve": 1.0, "ram_low": 0.9, "saddle": 0.6, "table": 0.6, "column_right": 0.6}
    sensors = place_sensors(dice, solid, bodies, seldom, own)
    return KindPlant(
        solid, bodies, _sources(dice, solid, bodies, rated, top), _growths(dice, solid, bodies), sensors, drivers,
        ("room", "wall") if walls else ("room",), own, errors=("x", "y", "z"), rated=rated,
    )  # fmt: skip


def _castings(dice: Dice) -> tuple[Mesh, dict[str, Cells]]:
    """x along the bed, y along the crossbeam, z up; the spindle's ring lies along x, which matters to nothing."""
    mesh = Mesh()
    long, wide, tall = dice.span(2.5, 7.0), dice.span(1.4, 3.0), dice.span(1.2, 2.2)
    of = dice.pick(("cast_iron", "steel"))
    bed = long, 0.6 * wide, dice.span(0.3, 0.6)
    mesh.box("bed", of, bed, (9, 2, 1), (0.0, 0.2 * wide, 0.0), dice.even(0.15, 0.4))
    for name, y in (("column_left", 0.0), ("column_right", wide)):
        mesh.box(name, of, (0.7, 0.35, tall), (2, 1, 4), (0.45 * long, y, 0.3), dice.even(0.12, 0.3))
    deep = dice.span(0.4, 0.7)
    mesh.box("beam", of, (deep, wide, 0.5), (2, 6, 2), (0.45 * long, 0.0, tall), dice.even(0.12, 0.3))
    mesh.box("saddle", of, (0.25, 0.6, 0.7), (1, 2, 2), (0.45 * long - 0.25, 0.4 * wide, tall), dice.even(0.2, 0.5))
    ram = 0.32, 0.32, dice.span(0.9, 1.6)
    mesh.box("ram", of, ram, (1, 1, 6), (0.45 * long - 0.55, 0.45 * wide, tall - 0.6), dice.even(0.3, 0.6))
    outer, length = dice.span(0.03, 0.06), dice.span(0.3, 0.55)
    at = (0.45 * long - 0.4, 0.48 * wide, tall - 0.9)
    mesh.ring("spindle", "steel", dice.even(0.008, 0.018), outer, length, (5, 1), at)
    mesh.ring("motor", "laminations", outer + 0.008, 2.0 * outer, 0.5 * length, (3, 2), at)
    mesh.ring("sleeve", "steel", 2.0 * outer, 2.0 * outer + dice.span(0.012, 0.04), length, (4, 1), at)
    mesh.box("table", of, (0.5 * long, 0.5 * wide, dice.span(0.15, 0.3)), (4, 2, 1), (0.3 * long, 0.3 * wide, 0.5), 0.5)
    _joints(dice, mesh)
    hidden = ("motor",)
    for block in mesh.blocks:
        if block not in hidden:
            faces = {"bed": ("x-", "x+", "y-", "y+", "z+"), "sleeve": ("out",), "spindle": ("x-", "x+")}.get(block, ())
            mesh.film(block, "room", dice.span(3.0, 9.0), faces, dice.even(0.0, 0.1) * dice.chance(0.5))
    beds = ("bed_near", "bed_middle", "bed_far") if dice.chance(0.6) else ("bed",)
    beam = dice.pick((("beam_front", "beam_back"), ("beam_left", "beam_right"), ("beam",)))
    rams = ("ram_low", "ram_high") if dice.chance(0.7) else ("ram",)
    across = 0 if "beam_front" in beam else 1
    parts = cut(mesh, "bed", 0, beds) | cut(mesh, "beam", across, beam) | cut(mesh, "ram", 2, rams)
    return mesh, parts | {n: c for n, c in mesh.blocks.items() if n not in ("bed", "beam", "ram")}


def _joints(dice: Dice, mesh: Mesh) -> None:
    for side, share in (("left", (0.0, 0.2)), ("right", (0.8, 1.0))):
        mesh.contact(mesh.patch(f"column_{side}", "z-"), mesh.patch("bed", "z+", 0.4, 0.6), dice.span(25.0, 150.0))
        mesh.contact(mesh.patch(f"column_{side}", "z+"), mesh.patch("beam", "z-", *share, 1), dice.span(40.0, 250.0))
    mesh.contact(mesh.patch("saddle", "x+"), mesh.patch("beam", "x-", 0.4, 0.6, 1), dice.span(15.0, 80.0))
    mesh.contact(mesh.patch("ram", "x+", 0.3, 0.8, 2), mesh.patch("saddle", "x-"), dice.span(10.0, 60.0))
    mesh.contact(mesh.patch("ram", "z-"), "sleeve", dice.span(15.0, 90.0))
    mesh.contact(mesh.patch("motor", "out"), mesh.patch("sleeve", "in"), dice.span(25.0, 150.0))
    mesh.contact(mesh.patch("motor", "in"), mesh.patch("spindle", "out", 0.3, 0.7), dice.span(0.5, 4.0))
    mesh.contact(mesh.patch("spindle", "out", 0.8, 1.0), mesh.patch("sleeve", "in", 0.8, 1.0), dice.span(5.0, 25.0))
    mesh.contact(mesh.patch("spindle", "out", 0.0, 0.2), mesh.patch("sleeve", "in", 0.0, 0.2), dice.span(4.0, 18.0))
    mesh.contact(mesh.patch("table", "z-"), mesh.patch("bed", "z+", 0.3, 0.8), dice.span(30.0, 200.0))


def _one(bodies: Mapping[str, Cells], *names: str) -> str:
    return next(n for n in names if n in bodies)


def _sources(dice: Dice, solid: Solid, bodies: Mapping[str, Cells], rated: float, top: float) -> dict[str, Source]:
    shaft, sleeve = bodies["spindle"], bodies["sleeve"]
    front, rear = ("sleeve", sleeve[-1:]), ("sleeve", sleeve[:1])
    high = _one(bodies, "ram_high", "ram")
    return {
        **bearings(dice, solid, "front_bearings", rated, (60.0, 280.0), ("spindle", shaft[-2:]), front, 75.0),
        **bearings(dice, solid, "rear_bearings", rated, (30.0, 120.0), ("spindle", shaft[:2]), rear, 60.0),
        **motor(dice, solid, "motor_loss", ("motor", bodies["motor"]), rated, (100.0, 450.0)),
        **feed_loss(dice, solid, "guides", (high, bodies[high]), top, (20.0, 140.0)),
    }  # fmt: skip


def _growths(dice: Dice, solid: Solid, bodies: Mapping[str, Cells]) -> dict[str, Growth]:
    low, high = _one(bodies, "ram_low", "ram"), _one(bodies, "ram_high", "ram")
    hot, cold = _one(bodies, "beam_front", "beam_left", "saddle"), _one(bodies, "beam_back", "beam_right", "beam")
    bed = _one(bodies, "bed_middle", "bed")
    tilt, twist = dice.sign() * dice.span(2.0, 12.0), dice.sign() * dice.span(1.0, 6.0)
    return {
        "spindle_growth@z": Growth("z", expanding(solid, [(bodies["spindle"][-4:], -dice.span(0.08, 0.25))])),
        "ram@z": Growth("z", expanding(solid, [(bodies[b], -dice.span(0.2, 0.5)) for b in (low, high)])),
        "columns@z": Growth("z", expanding(solid, [(bodies["column_left"], 0.7), (bodies["column_right"], 0.5)])),
        "scale@x": Growth("x", expanding(solid, [(bodies[bed], dice.sign() * dice.span(0.3, 1.2))])),
        "twist@x": Growth("x", bending(solid, bodies["column_left"], bodies["column_right"], twist),
                          ("column_left", "column_right"), twist),
        "beam@y": Growth("y", expanding(solid, [(bodies[hot], dice.span(0.2, 0.6)), (bodies["saddle"], 0.1)])),
        "bending@y": Growth("y", bending(solid, bodies[hot], bodies[cold], tilt), (hot, cold), tilt),
    }  # fmt: skip


GANTRY = Kind(
    draw_gantry,
    {
        **shop(("column_left", "column_right", "beam*", "bed*"), ("column_left", "beam*", "bed*"),
               ("bed*", "column_left", "column_right"), ("bed*", "saddle", "beam*")),
        **fluid(("table", "bed*")),
        **spindle_unit(("sleeve",), ("spindle", "sleeve"), ("sleeve", "ram_low", "ram"), "spindle", errors=("z", "y")),
        "cabinet_switched": Item(Cabinet, ("column_right", "beam*"), {"running": "extraction"}),
        "radiation_walls": Item(Radiates, ("beam*", "column_left", "bed*"), {"to": "wall"}),
        "jacket_chiller": Item(Chiller, ("sleeve", "motor")),
        "heat_bridge": Item(Bridge, ("motor", "table", "sleeve"), {"conductance": (2.0, 12.0)}),
        **paths(spindle_growth=("spindle_growth@z", "spindle_growth"), bending=("bending@y", "column_bending"),
                scale=("scale@x", "spindle_growth"), twist=("twist@x", "column_bending")),
        "test_bar": Item(TestBar, ("z",), {"seat": "spindle"}),
        **faults(("motor", "sleeve", "ram*"), "sleeve", "ram*", "beam*", "bed*", "column_left", "saddle"),
    },
    {
        "unlisted_warm_speed": Item(Product, ("ram*", "saddle"), {"driver": "spindle_rpm"}),
        "unlisted_two_switches": Item(Cross, ("table", "beam*"), {"driver": "spindle_rpm", "other": "extraction"}),
        "unlisted_plateau": Item(Plateau, ("sleeve", "ram_low", "ram")),
        "unlisted_reversal": Item(Reverses, ("x", "y"), {"driver": "feed"}),
    },
)  # fmt: skip
