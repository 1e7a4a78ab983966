"""A vertical machining centre to be drawn from: the sample machine as a type."""

from __future__ import annotations

from data import sample_machine
from data.simulated_runs import ROOM, MachineType

SENSORS = ("front", "rear", "motor", "head_front", "head_rear", "screw", "column_front", "column_back", "bed", ROOM)

VMC = MachineType(
    sample_machine.machine(),
    {s: s for s in SENSORS},
    {"bed": ("bed",), "table": ("table",), "column": ("column_front", "column_back")},
)
