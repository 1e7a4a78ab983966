"""Contacts between castings that conduct with their pressure, and the pressure goes with temperature."""

from __future__ import annotations

import numpy as np
from scipy import sparse

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
    """G = G0 [g + (1 - g) P^0.95], P = 1 + κ ΔT with a κ and a share g of its own for every pair of castings.

    ΔT is the mean over the joint, which presses as a whole.
    """

    key = "joints"

    @classmethod
    def fits(cls, plant: Plant) -> bool:
        """Contacts between single cells: finite volumes have them."""
        return isinstance(plant.structure, Volumes)

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        super().__init__(plant, size, rng)
        s = plant.structure
        assert isinstance(s, Volumes)
        casting = np.full(s.size, len(s.cells))
        for k, cells in enumerate(s.cells.values()):
            casting[cells] = k
        contact = np.flatnonzero((casting[s.one] != casting[s.other]) & (s.surfaces == 0))
        one, other, edge = s.one[contact], s.other[contact], np.arange(len(contact))
        code = casting[one] * (len(s.cells) + 1) + casting[other]
        pairs, self.joint = np.unique(code, return_inverse=True)
        bearing = pairs // (len(s.cells) + 1) == list(s.cells).index("shaft")
        lead = sparse.csr_matrix(
            (np.repeat([1.0, -1.0], len(edge)), (np.r_[edge, edge], np.r_[other, one])), (len(edge), s.size)
        )
        self.nominal_W_per_K, self.into = sparse.diags(s.between_W_per_K[contact]) @ lead, -lead.T.tocsr()
        each = 1.0 / np.bincount(self.joint)[self.joint]
        of_one, of_other = np.where(bearing, [[1.0], [-1.0]], 0.5)[:, self.joint] * each
        self.warmer = sparse.csr_matrix(
            (np.r_[of_one, of_other], (np.r_[self.joint, self.joint], np.r_[one, other])), shape=(len(pairs), s.size)
        )
        self.when_assembled_K = np.where(bearing, 0.0, ASSEMBLED_DEGC)[:, None]
        self.gap = rng.uniform(*THROUGH_GAP, (len(pairs), 1))
        share = rng.random(len(pairs))
        self.per_K = np.where(bearing, *(low + share * (high - low) for low, high in (TIGHTENS_PER_K, CLAMPS_PER_K)))[
            :, None
        ]

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        factor = contact_factor(self.warmer @ cells_degC - self.when_assembled_K, self.gap, self.per_K)
        heat_W += np.asarray(self.into @ ((factor - 1.0)[self.joint] * (self.nominal_W_per_K @ cells_degC)))


def contact_factor(warmer_K: Array, gap: Array | float, per_K: Array | float) -> Array:
    """Conductance of a joint over its nominal one."""
    pressure = np.maximum(1.0 + per_K * warmer_K, LOOSEST)
    return np.asarray(gap + (1.0 - gap) * pressure**PRESSURE_EXPONENT)
