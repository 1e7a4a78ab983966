"""Physics that is never concealed: the machine file states it as a constant or by a simple law."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy import sparse

from data.arrays import Array
from thermodrift_exam.plants.effects.base import Effect
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.runs import Now
from thermodrift_exam.plants.structure import Plant
from thermodrift_exam.plants.volumes.structure import Volumes


@dataclass(frozen=True)
class Stated:
    """An entry of the machine file's mechanisms: `free` values with units are guessed by the engineer."""

    name: str
    law: str
    drivers: str
    into: str
    free: Mapping[str, tuple[float, str]]
    fixed: Mapping[str, str] = field(default_factory=dict)


class Everyday(Effect):
    """Acts like an effect of size 1."""

    @classmethod
    def fits(cls, plant: Plant) -> bool:
        """Whether this plant includes it."""
        return True

    def stated(self) -> Stated | None:
        """Entries of the machine file in addition to the constants of links and exposures."""
        return None


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

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
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
        """(N, B): addition to the constant coefficient, as kelvins of it."""
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

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
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
        tightens, clamps = (low + share * (high - low) for low, high in (TIGHTENS_PER_K, CLAMPS_PER_K))
        self.per_K = np.where(bearing, tightens, clamps)[:, None]

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        factor = contact_factor(self.warmer @ cells_degC - self.when_assembled_K, self.gap, self.per_K)
        heat_W += np.asarray(self.into @ ((factor - 1.0)[self.joint] * (self.nominal_W_per_K @ cells_degC)))


def contact_factor(warmer_K: Array, gap: Array | float, per_K: Array | float) -> Array:
    """Conductance of a joint over its nominal one."""
    pressure = np.maximum(1.0 + per_K * warmer_K, LOOSEST)
    return np.asarray(gap + (1.0 - gap) * pressure**PRESSURE_EXPONENT)


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

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
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


EVERYDAY: tuple[type[Everyday], ...] = (Films, Joints, Nut)


def everyday(plant: Plant, seed: int) -> list[Everyday]:
    """Everything of `EVERYDAY` that this plant has, its strength drawn from the case's seed."""
    return [kind(plant, 1.0, stream(seed, f"everyday {kind.key}")) for kind in EVERYDAY if kind.fits(plant)]
