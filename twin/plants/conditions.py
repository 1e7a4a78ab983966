"""What acts on the machine from outside at every time of a simulation: drivers, room, walls, ground, clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.plants.casting import Array
from twin.plants.runs import Run, held


@dataclass(frozen=True)
class Now:
    """One moment of B batches: time from their starts in s, everything else (B,)."""

    time_s: float
    speed_rpm: Array
    feed_mm_per_min: Array
    coolant: Array
    room_degC: Array
    wall_degC: Array
    ground_degC: Array
    clock_h: Array

    def driver(self, channel: str) -> Array:
        """A driver by the name of its channel."""
        shown = {"spindle_rpm": self.speed_rpm, "feed": self.feed_mm_per_min, "coolant": self.coolant}
        return shown[channel]


def moments(runs: Sequence[Run], step_from_s: Array, at_s: Array) -> list[Now]:
    """Conditions at `at_s` (M,); drivers are those that hold in the steps that begin at `step_from_s` (M,)."""
    drivers = {n: np.stack([held(getattr(r, n), step_from_s) for r in runs], 1) for n in ("speed", "feed", "coolant")}
    room, wall = (np.stack([getattr(r, f"{n}_degC")(at_s) for r in runs], 1) for n in ("room", "wall"))
    ground = np.array([r.ground_degC() for r in runs])
    clock = (np.array([r.clock_h for r in runs]) + at_s[:, None] / 3600.0) % 24.0
    return [
        Now(
            float(t), drivers["speed"][k], drivers["feed"][k], drivers["coolant"][k], room[k], wall[k], ground, clock[k]
        )
        for k, t in enumerate(at_s)
    ]
