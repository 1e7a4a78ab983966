"""One casting as a box in space, solid or with walls, cut into hexahedra along its three axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twin.plants.casting import MATERIALS, Array, Casting
from twin.plants.structure import WHOLE

Piece = tuple[float, Array, Array]  # sign, lower and upper corner in m, (3,)


@dataclass(frozen=True)
class Box(Casting):
    """`size_m` along x (sideways), y (from the column's back to the front) and z (up) from the corner `low_m`.

    `hollow`: a tube has walls of `wall_m` at its four sides, a cap a lid on top as well; a block is full. A casting
    that is heavier or lighter than its volume of metal has ribs or cores: `fill` scales density, conduction, stiffness.
    `cells` are those of the core along each axis. `axes` says what depth and height mean: y and z, z alone of an
    upright bar, outwards from the bore and z of a ring.
    """

    low_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    cells: tuple[int, int, int]
    hollow: Literal["block", "tube", "cap"] = "block"
    wall_m: float = 0.0
    axes: Literal["block", "upright", "ring"] = "block"

    @property
    def layers(self) -> int:
        """Cells through a wall: heat crosses a ring's, and runs along the others'."""
        return 2 if self.axes == "ring" else 1

    @property
    def high_m(self) -> Array:
        return np.asarray(self.low_m) + self.size_m

    @property
    def lines_m(self) -> tuple[Array, Array, Array]:
        """Planes of the grid along each axis, m."""
        x, y, z = (np.linspace(0.0, size, n + 1) for size, n in zip(self.size_m, self.cells, strict=True))
        if self.hollow != "block":
            sides = zip(self.size_m[:2], self.cells[:2], strict=True)
            x, y = (_walled(size, n, self.wall_m, self.layers) for size, n in sides)
        if self.hollow == "cap":
            z = np.append(np.linspace(0.0, self.size_m[2] - self.wall_m, self.cells[2] + 1), self.size_m[2])
        return x + self.low_m[0], y + self.low_m[1], z + self.low_m[2]

    @property
    def solid(self) -> NDArray[np.bool_]:
        """Which cells of the grid are metal."""
        out = np.ones([len(line) - 1 for line in self.lines_m], dtype=bool)
        if self.hollow != "block":
            n = self.layers
            out[n:-n, n:-n, : -1 if self.hollow == "cap" else None] = False
        return out

    @property
    def volume_m3(self) -> float:
        sides = [np.diff(line) for line in self.lines_m]
        return float(np.einsum("i,j,k,ijk->", *sides, self.solid.astype(float)))

    @property
    def fill(self) -> float:
        return self.mass_kg / (MATERIALS[self.material].density_kg_per_m3 * self.volume_m3)

    @property
    def capacity_J_per_m3K(self) -> float:
        return self.mass_kg * MATERIALS[self.material].specific_heat_J_per_kgK / self.volume_m3

    @property
    def conductivity_W_per_mK(self) -> float:
        return self.fill * MATERIALS[self.material].conductivity_W_per_mK

    def finer(self, times: int) -> Box:
        """The same casting with every cell cut `times` along each axis."""
        return _Finer(**{k: getattr(self, k) for k in self.__dataclass_fields__}, times=times)

    def pieces(self, depth: tuple[float, float] = WHOLE, height: tuple[float, float] = WHOLE) -> list[Piece]:
        """The boxes, to be added or taken away, between these shares of its axes."""
        low, size = np.asarray(self.low_m), np.asarray(self.size_m)

        def between(y: tuple[float, float], z: tuple[float, float]) -> tuple[Array, Array]:
            return low + size * (0.0, y[0], z[0]), low + size * (1.0, y[1], z[1])

        if self.axes == "block":
            return [(1.0, *between(depth, height))]
        if self.axes == "upright":
            return [(1.0, *between(WHOLE, depth))]
        out = []
        for sign, share in ((1.0, depth[1]), (-1.0, depth[0])):
            inset_m = np.array([1.0, 1.0, 0.0]) * (1.0 - share) * self.wall_m
            under, over = between(WHOLE, height)
            out.append((sign, under + inset_m, over - inset_m))
        return out if depth[0] > 0 else out[:1]


@dataclass(frozen=True)
class _Finer(Box):
    times: int = 1

    @property
    def lines_m(self) -> tuple[Array, Array, Array]:
        x, y, z = (_cut(line, self.times) for line in super().lines_m)
        return x, y, z

    @property
    def solid(self) -> NDArray[np.bool_]:
        coarse = Box(**{k: getattr(self, k) for k in Box.__dataclass_fields__}).solid
        return np.asarray(np.kron(coarse, np.ones((self.times,) * 3, dtype=bool)))


def _walled(size_m: float, core: int, wall_m: float, layers: int) -> Array:
    wall = np.linspace(0.0, wall_m, layers + 1)[:-1]
    return np.concatenate([wall, np.linspace(wall_m, size_m - wall_m, core + 1), size_m - wall[::-1]])


def _cut(line: Array, times: int) -> Array:
    places = np.arange(times * (len(line) - 1) + 1) / times
    return np.asarray(np.interp(places, np.arange(len(line)), line))
