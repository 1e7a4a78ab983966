"""Contacts between castings that conduct with their pressure, and the pressure goes with temperature."""

from __future__ import annotations

import numpy as np

from twin.plants.casting import Array
from twin.plants.conditions import Now
from twin.plants.everyday.base import Everyday
from twin.plants.machine import Plant
from twin.plants.volumes.structure import Volumes

PRESSURE_EXPONENT = 0.95  # Yovanovich (2005), IEEE Trans. Comp. Pack. Tech. 28, 182: conforming rough surfaces
THROUGH_GAP = (0.3, 0.6)  # share of a joint's conductance that air and grease in it carry at any pressure
TIGHTENS_PER_K = (0.005, 0.02)  # bearings: by how much the shaft is warmer than the ring
CLAMPS_PER_K = (-0.004, 0.008)  # bolts and guides: by how much the joint is warmer than when it was assembled
ASSEMBLED_DEGC, LOOSEST = 20.0, 0.2


class Joints(Everyday):
    """G = G0 [g + (1 - g) P^0.95], P = 1 + κ ΔT with a κ and a share g of its own for every pair of castings."""

    key = "joints"

    @classmethod
    def fits(cls, plant: Plant) -> bool:
        """Contacts between single cells: finite volumes have them."""
        return isinstance(plant.structure, Volumes)

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        s = plant.structure
        assert isinstance(s, Volumes)
        names = np.array([*s.cells, ""])
        casting = np.full(s.size, len(s.cells))
        for k, cells in enumerate(s.cells.values()):
            casting[cells] = k
        contact = np.flatnonzero((casting[s.one] != casting[s.other]) & (s.surfaces == 0))
        self.one, self.other = s.one[contact], s.other[contact]
        self.between_W_per_K = s.between_W_per_K[contact][:, None]
        pairs = list(zip(names[casting[self.one]], names[casting[self.other]], strict=True))
        drawn = {
            pair: (rng.uniform(*THROUGH_GAP), rng.uniform(*(TIGHTENS_PER_K if pair[0] == "shaft" else CLAMPS_PER_K)))
            for pair in dict.fromkeys(pairs)
        }
        self.gap, self.per_K = (np.array([drawn[p][k] for p in pairs])[:, None] for k in (0, 1))
        self.bearing = np.array([p[0] == "shaft" for p in pairs])[:, None]

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        one, other = cells_degC[self.one], cells_degC[self.other]
        warmer_K = np.where(self.bearing, one - other, (one + other) / 2 - ASSEMBLED_DEGC)
        flow_W = self.between_W_per_K * (contact_factor(warmer_K, self.gap, self.per_K) - 1.0) * (other - one)
        np.add.at(heat_W, self.one, flow_W)
        np.subtract.at(heat_W, self.other, flow_W)


def contact_factor(warmer_K: Array, gap: Array | float, per_K: Array | float) -> Array:
    """Conductance of a joint over its nominal one."""
    pressure = np.maximum(1.0 + per_K * warmer_K, LOOSEST)
    return np.asarray(gap + (1.0 - gap) * pressure**PRESSURE_EXPONENT)
