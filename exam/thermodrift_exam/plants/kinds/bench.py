"""Motor spindles on a test bench: stator, rotor, bearings, a jacket whose inlet is recorded, a base plate.

Driven by speed and motor current; one probe along the axis and, on some benches, one across it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.kinds.common import Item, Kind, bearings, motor, setting, spindle
from thermodrift_exam.plants.kinds.effects.exchanges import Bridge, Chiller, Radiates, Windy
from thermodrift_exam.plants.kinds.effects.faults import Jumps, TestBar
from thermodrift_exam.plants.kinds.effects.heats import ByDriver, Cabinet, Cross, Plateau, Product, Pump, Sun
from thermodrift_exam.plants.kinds.engine import Cells, Mesh, Solid
from thermodrift_exam.plants.kinds.menus import faults, paths, shop, spindle_unit
from thermodrift_exam.plants.kinds.plant import (
    Dice,
    Drive,
    Driver,
    Growth,
    KindPlant,
    Source,
    Stated,
    bending,
    expanding,
    place_sensors,
    spread,
)
from thermodrift_exam.plants.kinds.runs import worked
from thermodrift_exam.plants.options import stream


def draw_bench(seed: int, effects: frozenset[str] = frozenset()) -> KindPlant:
    dice = Dice(stream(seed, "bench"))
    cooled = dice.chance(0.6) and "jacket_chiller" not in effects  # a jacket that the file knows
    mesh, bodies = _parts(dice, cooled)
    row_s = dice.pick((5.0, 10.0, 30.0, 60.0))
    hours = (1.0, 1.6) if row_s < 20 else (1.2, 4.0)
    own = setting(
        dice, effects, row_s=row_s, hours=hours, solver_s=max(5.0, row_s / np.ceil(row_s / 15.0)),
        before_h=dice.even(2.0, 4.0), before_step_s=20.0, day_K=dice.span(0.1, 1.2),
        room_degC=(dice.even(18.0, 21.0), dice.even(22.0, 27.0)),
        slow_K=dice.even(0.2, 1.5), noise_um=dice.span(0.1, 0.8), runs=dice.whole(6, 10),
    )  # fmt: skip
    rated, top_A = dice.pick((12000.0, 18000.0, 24000.0, 40000.0)), dice.pick((8.0, 15.0, 30.0))
    solid = mesh.solid(dice.even(2.0, 5.0))
    load = worked(0.15 * top_A, top_A, 600.0, (0.07, 0.18), 0.1)
    drivers = {
        "spindle_rpm": spindle(dice, rated),
        "current": Driver("A", 0.0, top_A, lambda rng, k, end_s: () if rng.random() < 0.2 else load(rng, k + 3, end_s)),
    }
    sensors = place_sensors(
        dice, solid, bodies, {"rotor": 0.1, "front_seat": 1.0, "stator": 0.95, "plate": 0.8, "block": 0.7}, own,
    )  # fmt: skip
    errors = ("z", "x") if dice.chance(0.4) or effects & {"bending"} else ("z",)
    growths = {k: g for k, g in _growths(dice, solid, bodies).items() if g.channel in errors}
    return KindPlant(
        solid, bodies, _sources(dice, solid, bodies, rated, top_A), growths, sensors, drivers,
        ("room", "inlet") if cooled else ("room",), own, errors=errors, rated=rated,
    )  # fmt: skip


OUTSIDE = {"rotor": ("x-", "x+"), "housing": ("out",), "rear_seat": ("x-", "out"), "front_seat": ("x+", "out")}


def _parts(dice: Dice, cooled: bool) -> tuple[Mesh, dict[str, Cells]]:
    mesh = Mesh()
    shaft, length = dice.span(0.015, 0.04), dice.span(0.22, 0.5)
    iron = dice.even(1.8, 2.4) * shaft
    mesh.ring("rotor", "steel", dice.even(0.1, 0.3) * shaft, shaft, length, (6, 1))
    mesh.ring("stator", "laminations", shaft + 0.006, iron, 0.45 * length, (3, 2), (0.28 * length, 0.0, 0.0))
    mesh.ring("housing", dice.pick(("aluminium", "steel")), iron, iron + dice.span(0.01, 0.03), 0.55 * length, (4, 1),
              (0.22 * length, 0.0, 0.0))  # fmt: skip
    for name, at in (("rear_seat", 0.0), ("front_seat", 0.8 * length)):
        mesh.ring(name, "steel", shaft + 0.01, iron + 0.01, 0.2 * length, (2, 2), (at, 0.0, 0.0))
    block = 2.0 * (iron + 0.05)
    mesh.box("block", dice.pick(("cast_iron", "aluminium")), (0.6 * length, block, 0.5 * block), (2, 2, 2),
             (0.2 * length, -block / 2, -block), dice.even(0.5, 1.0))  # fmt: skip
    mesh.box("plate", dice.pick(("cast_iron", "steel", "aluminium")), (dice.span(0.5, 1.2), dice.span(0.35, 0.8), 0.04),
             (5, 3, 1), (-0.2, -0.3, -block - 0.04))  # fmt: skip
    _joints(dice, mesh)
    for name in ("rotor", "housing", "rear_seat", "front_seat", "block", "plate"):
        mesh.film(name, "room", dice.span(5.0, 12.0), OUTSIDE.get(name, ()), dice.even(0.0, 0.1) * dice.chance(0.5))
    if cooled:
        mesh.film("housing", "inlet", dice.span(60.0, 700.0), ("out",))
    return mesh, dict(mesh.blocks)


def _joints(dice: Dice, mesh: Mesh) -> None:
    mesh.contact(mesh.patch("stator", "out"), mesh.patch("housing", "in"), dice.span(20.0, 120.0))
    mesh.contact(mesh.patch("stator", "in"), mesh.patch("rotor", "out", 0.25, 0.75), dice.span(0.5, 3.0))
    mesh.contact(mesh.patch("front_seat", "x-"), mesh.patch("housing", "x+"), dice.span(8.0, 60.0))
    mesh.contact(mesh.patch("rear_seat", "x+"), mesh.patch("housing", "x-"), dice.span(8.0, 60.0))
    mesh.contact(mesh.patch("front_seat", "in"), mesh.patch("rotor", "out", 0.8, 1.0), dice.span(2.0, 12.0))
    mesh.contact(mesh.patch("rear_seat", "in"), mesh.patch("rotor", "out", 0.0, 0.2), dice.span(1.5, 9.0))
    mesh.contact(mesh.patch("block", "z+"), mesh.patch("housing", "out"), dice.span(5.0, 50.0))
    mesh.contact(mesh.patch("block", "z-"), mesh.patch("plate", "z+", 0.2, 0.7), dice.span(8.0, 80.0))


def _sources(dice: Dice, solid: Solid, bodies: Mapping[str, Cells], rated: float, top_A: float) -> dict[str, Source]:
    rotor = bodies["rotor"]
    front, rear = (("front_seat", bodies["front_seat"]), ("rear_seat", bodies["rear_seat"]))
    copper, bend = dice.span(40.0, 260.0), dice.even(-0.2, 0.1)

    def power_W(drive: Drive) -> Array:
        x = np.abs(drive["current"]) / top_A
        return copper * x * x * (1.0 + bend * x) / (1.0 + bend)

    joule = Stated(
        "ohmic_heat", "current", {"stator": 1.0}, {"resistance": (copper / top_A**2, "ohm")}, at={"body": "stator"}
    )
    return {
        **bearings(dice, solid, "front_bearings", rated, (25.0, 140.0), ("rotor", rotor[-2:]), front, 45.0),
        **bearings(dice, solid, "rear_bearings", rated, (15.0, 80.0), ("rotor", rotor[:2]), rear, 40.0),
        **motor(dice, solid, "motor_loss", ("stator", bodies["stator"]), rated, (40.0, 260.0)),
        "copper": Source(spread(solid, bodies["stator"]), power_W, {"copper": joule}),
    }  # fmt: skip


def _growths(dice: Dice, solid: Solid, bodies: Mapping[str, Cells]) -> dict[str, Growth]:
    rotor, tilt = bodies["rotor"], dice.sign() * dice.span(0.8, 5.0)
    across = dice.sign() * dice.span(0.03, 0.15)
    return {
        "rotor@z": Growth("z", expanding(solid, [(rotor[-4:], dice.span(0.1, 0.35))])),
        "frame@z": Growth("z", expanding(solid, [(bodies["block"], -dice.span(0.05, 0.25)), (bodies["plate"], 0.1)])),
        "seat@z": Growth("z", expanding(solid, [(bodies["front_seat"], dice.span(0.02, 0.12))])),
        "block@x": Growth("x", expanding(solid, [(bodies["block"], across)])),
        "bending@x": Growth("x", bending(solid, bodies["front_seat"], bodies["rear_seat"], tilt),
                            ("front_seat", "rear_seat"), tilt),
    }  # fmt: skip


BENCH = Kind(
    draw_bench,
    {
        **{k: v for k, v in shop((), (), ("plate",), ()).items() if k in ("floor_sink", "draught")},
        "cabinet_heat": Item(Cabinet, ("plate", "block"), {"watts": (10.0, 60.0)}),
        "hydraulic_unit": Item(Pump, ("plate", "block", "rear_seat"), {"watts": (10.0, 60.0)}),
        "sun": Item(Sun, ("plate", "block"), {"watts": (10.0, 60.0)}),
        **spindle_unit(("front_seat",), ("rotor", "front_seat"), ("rotor", "rear_seat"), "rotor", motor="stator"),
        "radiation": Item(Radiates, ("block", "plate"), {"to": "housing", "area": (0.05, 0.3)}),
        "jacket_chiller": Item(Chiller, ("housing", "stator")),
        "ventilated": Item(Windy, ("housing",)),
        "cable_heat": Item(
            ByDriver, ("rear_seat", "block"),
            {"driver": "current", "mechanism": "ohmic_heat", "exponent": (1.8, 2.2), "watts": (10.0, 60.0),
             "words": "current warms a cable or its clamp"},
        ),
        "heat_bridge": Item(Bridge, ("stator", "plate", "rotor"), {"conductance": (0.5, 6.0)}),
        **paths(spindle_growth=("rotor@z", "spindle_growth"), bending=("bending@x", "column_bending")),
        "speed_shift": Item(Jumps, ("z",)),
        "test_bar": Item(TestBar, ("z",), {"seat": "rotor"}),
        **faults(("stator", "front_seat", "rear_seat", "housing"), "stator", "housing", "*_seat", "block", "plate"),
    },
    {
        "unlisted_warm_speed": Item(Product, ("rear_seat", "block"), {"driver": "spindle_rpm", "watts": (10.0, 60.0)}),
        "unlisted_torque": Item(
            Cross, ("front_seat", "rear_seat", "block"),
            {"driver": "spindle_rpm", "other": "current", "watts": (10.0, 60.0)},
        ),
        "unlisted_plateau": Item(Plateau, ("front_seat", "stator")),
    },
)  # fmt: skip
