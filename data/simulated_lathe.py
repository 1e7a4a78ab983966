"""A lathe to be drawn from: the sample lathe as a type, 16 sensors, its axes cycling while the spindle runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from data.sample_lathe import AXES, SLOW_BODIES, Drive, feed_heat_W
from data.sample_lathe import LATHE as SAMPLE_LATHE
from data.simulated_runs import ROOM, MachineType
from data.thermal_machine import SpeedHeat, ThermalMachine

FEED_MM_PER_MIN = 1000.0
SENSORS = (
    "spindle_front", "spindle_rear", "headstock", "spindle_motor", "x_nut", "x_bearing", "x_motor", "z_nut",
    "z_bearing", "z_motor", "bed_left", "bed_right", "saddle", "cross_slide", "turret", ROOM,
)  # fmt: skip


def _cycling(machine: ThermalMachine) -> ThermalMachine:
    """The same machine with the drives' heat at one feed, on while the spindle runs."""
    heat_W = feed_heat_W(machine, np.full((1, 1), FEED_MM_PER_MIN), {axis: [Drive()] for axis in AXES})[0, 0]
    drives = tuple(SpeedHeat(b, ((float(w), 0.0),)) for b, w in zip(machine.bodies, heat_W, strict=True) if w > 0)
    return replace(machine, heats=machine.heats + drives)


LATHE = MachineType(_cycling(SAMPLE_LATHE), {s: s for s in SENSORS}, SLOW_BODIES)
