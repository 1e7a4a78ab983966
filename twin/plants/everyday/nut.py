"""The ball screw's nut: its friction heats the screw where the axis works, and the place of work travels."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from twin.plants.casting import Array
from twin.plants.conditions import Now
from twin.plants.everyday.base import Everyday, Stated
from twin.plants.machine import Plant

LEAD_MM = 10.0
MOMENT_NM = (0.2, 0.5)
STROKE = (0.15, 0.3)  # of the screw's length: fast strokes, evenly warm over a step of the solver
TRAVEL = (0.1, 0.3)  # to either side, how far the place of work moves
SLICES = 12
ROUNDS_A_DAY = (24, 72)  # between two clampings and back; whole, so that midnight is no jump


class Nut(Everyday):
    """P = 2π M feed / lead (ISO 3408-3: a constant drag moment). The machine file states it, into the whole screw."""

    key = "nut"

    @classmethod
    def fits(cls, plant: Plant) -> bool:
        return "screw" in plant.structure.castings and "feed" in plant.features

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        self.moment_Nm = float(rng.uniform(*MOMENT_NM)) * size
        self.stroke, self.travel = float(rng.uniform(*STROKE)), float(rng.uniform(*TRAVEL))
        reach = self.stroke / 2 + self.travel
        self.middle = float(rng.uniform(reach, 1.0 - reach))
        self.rounds = int(rng.integers(ROUNDS_A_DAY[0], ROUNDS_A_DAY[1] + 1))
        self.edges = np.linspace(0.0, 1.0, SLICES + 1)[:, None]
        self.spread = np.zeros((plant.structure.size, SLICES))  # of a watt in every slice over the nodes
        for k, ends in enumerate(pairwise(self.edges[:, 0].tolist())):
            plant.structure.part("screw", ends).add(self.spread[:, k], 1.0)
        self.cells = np.flatnonzero(self.spread.any(axis=1))
        self.spread = self.spread[self.cells]

    def stated(self) -> Stated:
        free = {"moment": (self.moment_Nm, "N*m")}
        return Stated("nut", "nut_friction", "feed", "screw", free, {"lead": f"{LEAD_MM:g} mm"})

    def power_W(self, now: Now) -> Array:
        """(B,)"""
        return np.asarray(2.0 * np.pi * self.moment_Nm * np.abs(now.feed_mm_per_min) / LEAD_MM / 60.0)

    def shares(self, now: Now) -> Array:
        """Of the heat, into the screw's slices, (SLICES, B); they add up to 1, most in the middle of the strokes."""
        centre = self.middle + self.travel * np.sin(2.0 * np.pi * self.rounds * now.clock_h / 24.0)
        from_middle = np.clip((self.edges - centre) / (self.stroke / 2), -1.0, 1.0)
        below = (1.0 + from_middle + np.sin(np.pi * from_middle) / np.pi) / 2.0
        return np.diff(below, axis=0)

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        heat_W[self.cells] += self.power_W(now) * (self.spread @ self.shares(now))
