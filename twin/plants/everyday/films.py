"""Surfaces: air that rises faster along a warmer wall, and radiation, around the coefficient that the plant states."""

from __future__ import annotations

import numpy as np

from twin.plants.casting import Array
from twin.plants.conditions import Now
from twin.plants.everyday.base import Everyday
from twin.plants.machine import Plant

ZERO_DEGC_K = 273.15
RADIATING = (0.3, 0.6)  # share of a coefficient: 2 to 5 of 5 to 8 W/m²K, bare in its enclosure or painted
EXPONENT = (0.25, 1.0 / 3.0)  # laminar, turbulent
STATED_AT_K = (4.0, 8.0)  # excess over the air at which the stated coefficient holds
MOVING_AIR_K = (1.0, 2.5)  # the hall's own air exchanges as much as this excess: no coefficient falls to 0


class Films(Everyday):
    """All surfaces of the castings, each casting with its own paint and height.

    Convection h ∝ |T - T_air|^p (McAdams 1954) and radiation ∝ T⁴ - T_air⁴ to walls as warm as the air; at the
    reference excess, and about 20 degC, both together are the constant coefficient.
    """

    key = "films"

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        s = plant.structure
        self.air = s.air_cell
        self.to_air, self.to_room = s.air_W_per_K[:, None], s.room_W_per_K[:, None].copy()
        if self.air is not None:
            self.to_room[self.air] = 0.0  # through sheet metal and gaps: no wall of a casting
        self.stated_K, self.moving_K = float(rng.uniform(*STATED_AT_K)), float(rng.uniform(*MOVING_AIR_K))
        self.radiating, self.exponent = np.zeros((s.size, 1)), np.zeros((s.size, 1))
        for cells in s.cells.values():
            self.radiating[cells], self.exponent[cells] = rng.uniform(*RADIATING), rng.uniform(*EXPONENT)

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        heat_W += self.to_room * self.beyond_K(cells_degC, now.room_degC)
        if self.air is not None:
            exchanged = self.to_air * self.beyond_K(cells_degC, cells_degC[self.air])
            heat_W += exchanged
            heat_W[self.air] -= exchanged.sum(axis=0)

    def beyond_K(self, cells_degC: Array, air_degC: Array) -> Array:
        """(N, B): what the constant coefficient must be given on top, as kelvins of it."""
        lead_K = air_degC - cells_degC
        rising = rising_factor(lead_K, self.exponent, self.stated_K, self.moving_K)
        glowing = radiation_factor(cells_degC, air_degC)
        return np.asarray(((1.0 - self.radiating) * rising + self.radiating * glowing - 1.0) * lead_K)


def rising_factor(lead_K: Array, exponent: Array | float, stated_K: float, moving_K: float) -> Array:
    """Coefficient of natural convection over the one at `stated_K`, with air that moves anyway."""
    return np.asarray(((lead_K**2 + moving_K**2) / (stated_K**2 + moving_K**2)) ** (exponent / 2.0))


def radiation_factor(one_degC: Array, other_degC: Array) -> Array:
    """(T⁴ - T'⁴) / (T - T') over its value 4 T³ at 20 degC."""
    one_K, other_K = one_degC + ZERO_DEGC_K, other_degC + ZERO_DEGC_K
    return np.asarray((one_K + other_K) * (one_K**2 + other_K**2) / (4.0 * (20.0 + ZERO_DEGC_K) ** 3))
