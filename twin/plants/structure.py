"""What a plant's castings are to everything else, however they are cut: nodes, bodies, capacities, losses.

Plants by finite volumes (`volumes`) and by finite elements (`elements`) both stand behind this.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import sparse

from twin.plants.casting import Array, Casting, Cells

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

    stages: ClassVar[tuple[float, ...]]  # shares of a step at which `integrate` asks for the heat

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
        """How much of every node belongs to a body, 0 to 1, (N,)."""
        part, out = self.bodies[body], np.zeros(self.size)
        out[part.cells] = part.weights * part.capacity_J_per_K / self.capacity_J_per_K[part.cells]
        return out
