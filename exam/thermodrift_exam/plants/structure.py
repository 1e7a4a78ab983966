"""The common interface of plants for any discretisation: nodes, bodies, capacities, losses.

Finite volumes (`volumes`) and finite elements (`elements`) implement it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data.arrays import Array

Cells = NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """Handbook values: kg/m³, J/kg/K, W/m/K, µm/m/K."""

    density_kg_per_m3: float
    specific_heat_J_per_kgK: float
    conductivity_W_per_mK: float
    expansion_um_per_mK: float


MATERIALS: Mapping[str, Material] = MappingProxyType({
    "steel": Material(7850.0, 460.0, 48.0, 11.5),
    "cast_iron": Material(7200.0, 500.0, 50.0, 10.8),
})  # fmt: skip


@dataclass(frozen=True)
class Casting:
    """One solid part of the machine; its material is one of `MATERIALS`."""

    name: str
    material: str
    mass_kg: float


AIR = "air"
WHOLE = (0.0, 1.0)

Heat = Callable[[int, int, Array], Array]  # step, stage (of `Structure.stages`), nodes (N, B) -> W (N, B)


@dataclass(frozen=True)
class Part:
    """A piece of a casting by the nodes that carry it.

    `weights` (n,) add up to 1: they give the piece its mean and share out a heat that enters it evenly. `surface_m2`
    (n,) is the outer surface that each node stands for.
    """

    cells: Cells
    weights: Array
    surface_m2: Array
    capacity_J_per_K: float

    def mean(self, values: Array) -> Array:
        """Of values at all nodes (N, B): (B,)."""
        return np.asarray(self.weights @ values[self.cells])

    def add(self, heat_W: Array, watts: Array | float) -> None:
        """Adds `watts` (B,) to the heat into all nodes (N, B), in place."""
        heat_W[self.cells] += np.multiply.outer(self.weights, watts)


@dataclass(frozen=True, kw_only=True)
class Structure(ABC):
    """N nodes. `bodies` are the places that a machine file would name: whole castings, or their halves.

    `cells` are the nodes of each casting, none of two. `capacity_J_per_K`, `above_floor_m`, `room_W_per_K` (convection
    to the room) and `air_W_per_K` (to the enclosure's air, a node of its own whose entry is 0) are (N,).
    """

    castings: Mapping[str, Casting]
    cells: Mapping[str, Cells]
    bodies: Mapping[str, Part]
    capacity_J_per_K: Array
    above_floor_m: Array
    room_W_per_K: Array
    air_cell: int | None = None

    stages: ClassVar[tuple[float, ...]]  # shares of a step at which `integrate` evaluates the heat

    @property
    def size(self) -> int:
        return len(self.capacity_J_per_K)

    @property
    @abstractmethod
    def air_W_per_K(self) -> Array:
        """Convection of every node to the enclosure's air."""

    @abstractmethod
    def part(self, casting: str, depth: tuple[float, float] = WHOLE, height: tuple[float, float] = WHOLE) -> Part:
        """The piece of a casting between these shares of its two axes: depth from its back, height from its foot.

        A shaft's or screw's depth runs upwards from its lower end, a bearing's housing's outwards from its bore.
        """

    @abstractmethod
    def losses(self) -> sparse.csc_matrix:
        """The matrix L of ``C dT/dt = -L T + heat``, W/K, (N, N): symmetric, its rows add up to `room_W_per_K`."""

    @abstractmethod
    def between(self, one: str, other: str) -> sparse.csc_matrix | None:
        """Conduction within and between two bodies alone, W/K, (N, N); None where they do not touch."""

    @abstractmethod
    def exposure_W_per_K(self, body: str) -> dict[str, float]:
        """Conductance of a body's whole surface to "air" and to "room"."""

    @abstractmethod
    def touching(self) -> set[frozenset[str]]:
        """Pairs of bodies between which heat flows directly."""

    @abstractmethod
    def joined(self) -> set[int]:
        """Nodes in contact with another casting."""

    @abstractmethod
    def off_middle(self, body: str) -> Array:
        """Distance of a body's nodes from its middle, 1 at the middle of a side, (n,)."""

    @abstractmethod
    def integrate(self, heat_W: Heat, start_degC: Array, step_s: float, steps: int) -> Array:
        """``C dT/dt = -L T + heat`` from `start_degC` (N, B): temperatures (steps + 1, N, B)."""

    def share_of(self, body: str) -> Array:
        """Share of every node that belongs to a body, 0 to 1, (N,)."""
        part, out = self.bodies[body], np.zeros(self.size)
        out[part.cells] = part.weights * part.capacity_J_per_K / self.capacity_J_per_K[part.cells]
        return out


LEAST_UM_PER_K = 0.05


def links_W_per_K(s: Structure) -> dict[tuple[str, str], float]:
    """Conductance between every pair of bodies that touch: watts per kelvin between their means.

    For heat that enters one body evenly and leaves the other evenly, with nothing else around.
    """
    pairs = {(one, other): s.between(one, other) for one, other in combinations(s.bodies, 2)}
    return {(a, b): _effective(s, a, b, within) for (a, b), within in pairs.items() if within is not None}


def _effective(s: Structure, one: str, other: str, within: sparse.csc_matrix) -> float:
    """One over the difference of the means that a watt through both makes."""
    cells = np.union1d(s.bodies[one].cells, s.bodies[other].cells)
    through = np.zeros(s.size)
    s.bodies[one].add(through, 1.0)
    s.bodies[other].add(through, -1.0)
    rise = np.zeros(len(cells))
    rise[1:] = np.linalg.solve(within[cells][:, cells].toarray()[1:, 1:], through[cells][1:])  # the first is held at 0
    return float(1.0 / (through[cells] @ rise))


def exposures_W_per_K(s: Structure) -> dict[tuple[str, str], float]:
    """(body, "air" or "room") -> conductance of its whole surface."""
    exposed = {(body, around): g for body in s.bodies for around, g in s.exposure_W_per_K(body).items()}
    return {where: g for where, g in exposed.items() if g > 0}


def gains_um_per_K(s: Structure, weights_um_per_K: Array) -> dict[str, float]:
    """Contribution of the mean rise of each body to an error, µm/K, without those below `LEAST_UM_PER_K`."""
    sums = {body: float(s.share_of(body) @ weights_um_per_K) for body in s.bodies}
    return {body: total for body, total in sums.items() if abs(total) > LEAST_UM_PER_K}


@dataclass(frozen=True)
class Growth:
    """One piece of an error channel, linear in the rises: error_um = amount · weights · rise.

    `weights_um_per_K` (N,). `tilt` names the warm and the cold body of a bending and is None for an expanding path;
    `lumped_um_per_K` is what a tilt gives per kelvin between these two bodies.
    """

    name: str
    channel: str
    weights_um_per_K: Array
    tilt: tuple[str, str] | None = None
    lumped_um_per_K: float = 0.0
    amount: float = 1.0

    def scaled(self, amount: float) -> Growth:
        return replace(self, amount=amount)


FEATURES = ("feed", "coolant", "walls", "layers", "motor_loss", "bending", "growth", "mandrel")
Law = Literal["viscous", "load", "motor"]


@dataclass(frozen=True)
class Source:
    """Heat of the spindle: `watts` at the rated speed by law (viscous, load: one; motor: idle, linear, quadratic).

    `share` (N,) says into which nodes it goes and adds up to 1; `shaft` and `housing` are where a bearing's inner and
    outer ring sit.
    """

    law: Law
    watts: tuple[float, ...]
    share: Array
    amount: float = 1.0
    shaft: Part | None = None
    housing: Part | None = None


@dataclass(frozen=True)
class Sensor:
    """A temperature channel: its node, lag and error."""

    channel: str
    body: str
    cell: int
    lag_s: float
    offset_K: float
    drift_K_per_h: float = 0.0


@dataclass(frozen=True)
class Layout:
    """The draw of a kind of plant: discretised castings, and the influence of their rises on the tool."""

    structure: Structure
    growths: tuple[Growth, ...]


@dataclass(frozen=True)
class Plant:
    """A whole machine; `features` are those of `FEATURES` that it has."""

    structure: Structure
    rated_rpm: float
    sources: Mapping[str, Source]
    growths: tuple[Growth, ...]
    sensors: tuple[Sensor, ...]
    features: frozenset[str]

    def part(self, body: str) -> Part:
        return self.structure.bodies[body]

    def body_like(self, *wanted: str) -> str:
        """The first of these bodies that this plant has."""
        return next(b for b in wanted if b in self.structure.bodies)
