"""A horizontal machining centre to be drawn from: 12 bodies, 5 sensors, Y and Z. Typical values, none measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plants.sample import sample_machine
from plants.sample.sample_machine import IRON_UM_PER_M_K, STEEL_UM_PER_M_K
from plants.sample.thermal_machine import BearingSet, SpeedHeat, ThermalMachine
from thermodrift_exam.plants.types.lathe import AXES, SLOW_BODIES, Drive, feed_heat_W
from thermodrift_exam.plants.types.lathe import LATHE as SAMPLE_LATHE
from thermodrift_exam.plants.types.runs import ROOM, MachineType

COLUMN_HEIGHT_M, COLUMN_DEPTH_M = 0.9, 0.6

# (body, length m); + lifts the spindle against the table (Y), + closes the gap along the spindle (Z).
Y_CHAIN = (("column_front", 0.35), ("column_back", 0.35), ("head", 0.15), ("table", -0.45), ("fixture", -0.40))
Z_CHAIN = (("shaft", 0.15), ("mandrel", 0.20), ("head", 0.25), ("bed", -0.35), ("table", -0.25))
_STEEL = {"shaft", "mandrel", "fixture"}


def _um_per_K(chain: tuple[tuple[str, float], ...]) -> dict[str, float]:
    return {body: length_m * (STEEL_UM_PER_M_K if body in _STEEL else IRON_UM_PER_M_K) for body, length_m in chain}


def _z_um_per_K() -> dict[str, float]:
    """The chain, and the column that bends back: phi = alpha L (T_front - T_back) / W, Z = -phi L / 2."""
    bend = IRON_UM_PER_M_K * COLUMN_HEIGHT_M**2 / (2 * COLUMN_DEPTH_M)
    return _um_per_K(Z_CHAIN) | {"column_front": -bend, "column_back": bend}


HMC = MachineType(
    ThermalMachine(
        capacity_J_per_K={
            "shaft": 8e3, "front": 9e3, "rear": 6e3, "motor": 30e3, "head": 110e3, "column_front": 260e3,
            "column_back": 260e3, "bed": 1500e3, "table": 320e3, "mandrel": 2e3, "fixture": 60e3, "air": 35e3,
        },
        link_W_per_K={
            ("shaft", "front"): 15, ("shaft", "rear"): 9, ("shaft", "mandrel"): 9, ("front", "head"): 26,
            ("rear", "head"): 20, ("motor", "head"): 9, ("head", "column_front"): 22,
            ("column_front", "column_back"): 45, ("column_front", "bed"): 22, ("column_back", "bed"): 22,
            ("bed", "table"): 16, ("table", "fixture"): 18,
            ("shaft", "air"): 0.8, ("mandrel", "air"): 0.6, ("front", "air"): 1.2, ("head", "air"): 8,
            ("column_front", "air"): 7, ("bed", "air"): 7, ("table", "air"): 11, ("fixture", "air"): 3,
        },
        room_W_per_K={"rear": 0.6, "motor": 10, "head": 6, "column_front": 3, "column_back": 16, "bed": 18, "air": 80},
        floor_W_per_K={"bed": 12},
        bearings=(BearingSet("front", 3, 85.0, 900.0, 32e3), BearingSet("rear", 2, 75.0, 700.0, 27e3)),
        heats=(
            SpeedHeat("motor", ((50.0, 0.0), (130.0, 1.0), (90.0, 2.0))),
            SpeedHeat("rear", ((60.0, 1.5),)),  # the belt
        ),
        always_W={"air": 70.0},
        um_per_K={"y": _um_per_K(Y_CHAIN), "z": _z_um_per_K()},
        rotating=(("shaft", "air"), ("mandrel", "air")),
        speed_shift_um={"z": 3.0},
        rated_rpm=6000.0,
    ),
    {"front": "front", "motor": "motor", "head": "head", "column": "column_front", ROOM: ROOM},
    {"bed": ("bed",), "table": ("table", "fixture"), "column": ("column_front", "column_back")},
)  # fmt: skip


FEED_MM_PER_MIN = 1000.0
LATHE_SENSORS = (
    "spindle_front", "spindle_rear", "headstock", "spindle_motor", "x_nut", "x_bearing", "x_motor", "z_nut",
    "z_bearing", "z_motor", "bed_left", "bed_right", "saddle", "cross_slide", "turret", ROOM,
)  # fmt: skip


def _cycling(machine: ThermalMachine) -> ThermalMachine:
    """The same machine with the drives' heat at one feed, on while the spindle runs."""
    heat_W = feed_heat_W(machine, np.full((1, 1), FEED_MM_PER_MIN), {axis: [Drive()] for axis in AXES})[0, 0]
    drives = tuple(SpeedHeat(b, ((float(w), 0.0),)) for b, w in zip(machine.bodies, heat_W, strict=True) if w > 0)
    return replace(machine, heats=machine.heats + drives)


LATHE = MachineType(_cycling(SAMPLE_LATHE), {s: s for s in LATHE_SENSORS}, SLOW_BODIES)


VMC_SENSORS = ("front", "rear", "motor", "head_front", "head_rear", "screw", "column_front", "column_back", "bed", ROOM)

VMC = MachineType(
    sample_machine.machine(),
    {s: s for s in VMC_SENSORS},
    {"bed": ("bed",), "table": ("table",), "column": ("column_front", "column_back")},
)
