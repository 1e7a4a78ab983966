"""Friction that temperatures change: the front bearings' lubricant and their preload."""

from __future__ import annotations

import numpy as np

from twin.plants.casting import Array
from twin.plants.conditions import Now
from twin.plants.effects.base import Answer, Effect
from twin.plants.machine import Source

REFERENCE_DEGC = 40.0
PALMGREN_Y = 0.33


class _FrontBearings(Effect):
    driver = "spindle_rpm"
    source: str

    def _temperatures(self, cells_degC: Array) -> tuple[Array, Array]:
        """Inner and outer ring, degC, each (B,)."""
        at: Source = self.plant.sources[self.source]
        assert at.shaft is not None and at.housing is not None, "a bearing has both"
        return at.shaft.mean(cells_degC), at.housing.mean(cells_degC)


class ViscosityFeedback(_FrontBearings):
    """Oil that thins by the exponential law of Reynolds (1886); Palmgren's moment goes with viscosity^(2/3)."""

    key = "viscosity_feedback"
    source = "front_bearings"

    def answer(self) -> Answer:
        slope = {"slope": (0.035 * self.size, "1/K")}
        return Answer(self.key, "node", "front", slope, ("shaft", self.source), "the front bearings' grease thins")

    def friction(self, source: str, cells_degC: Array, now: Now) -> Array | float:
        if source != self.source:
            return 1.0
        shaft, ring = self._temperatures(cells_degC)
        thinner = np.exp(-0.035 * self.size * ((shaft + ring) / 2 - REFERENCE_DEGC))
        return np.asarray(thinner ** (2.0 / 3.0))


class PreloadFeedback(_FrontBearings):
    """A shaft that is warmer than its housing tightens the bearing (Stein and Tu 1994): moment with F^(1 + y)."""

    key = "preload_feedback"
    source = "front_preload"

    def answer(self) -> Answer:
        kappa = {"kappa": (0.08 * self.size, "1/K")}
        return Answer(self.key, "node", "front", kappa, ("shaft", self.source), "the front bearings tighten")

    def friction(self, source: str, cells_degC: Array, now: Now) -> Array | float:
        if source != self.source:
            return 1.0
        shaft, ring = self._temperatures(cells_degC)
        force = np.clip(1.0 + 0.08 * self.size * (shaft - ring), 0.0, None)
        return np.asarray(force ** (1.0 + PALMGREN_Y))
