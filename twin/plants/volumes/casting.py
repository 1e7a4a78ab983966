"""One casting as finite volumes: a bar or a plate of equal cells, with its mass, conduction and surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from twin.plants.casting import MATERIALS, Array, Casting, Cells


@dataclass(frozen=True)
class Plate(Casting):
    """`depth_m` × `height_m` (first × second axis) cut into `cells`; `width_m` is the side that is not resolved.

    The mass sets the solid thickness. Cells count along the first axis first: cell (i, j) is number i + j · nx.
    `base_m` is the height of its foot above the floor. `split` cuts every cell along both axes, for a finer grid.
    """

    depth_m: float
    height_m: float
    width_m: float
    cells: tuple[int, int]
    base_m: float
    upright: bool = False  # a bar whose first axis stands: shaft, screw
    split: int = 1

    @property
    def counts(self) -> tuple[int, int]:
        """Cells along both axes after splitting."""
        return self.cells[0] * self.split, self.cells[1] * self.split

    @property
    def size(self) -> int:
        return self.counts[0] * self.counts[1]

    @property
    def pitch_m(self) -> tuple[float, float]:
        """Size of a cell along both axes, m."""
        return self.depth_m / self.counts[0], self.height_m / self.counts[1]

    @property
    def block(self) -> Cells:
        """The cell before splitting that every cell is a piece of, (size,)."""
        i, j = np.arange(self.size) % self.counts[0], np.arange(self.size) // self.counts[0]
        return np.asarray(i // self.split + j // self.split * self.cells[0])

    @property
    def along_m(self) -> tuple[Array, Array]:
        """Centres of the cells along both axes from the casting's corner, m, each (size,)."""
        (nx, nz), (dx, dz) = self.counts, self.pitch_m
        z, x = np.meshgrid((np.arange(nz) + 0.5) * dz, (np.arange(nx) + 0.5) * dx, indexing="ij")
        return x.ravel(), z.ravel()

    @property
    def above_floor_m(self) -> Array:
        """Height of every cell above the floor, m, (size,)."""
        return self.base_m + self.along_m[0 if self.upright else 1]

    @property
    def capacity_J_per_K(self) -> Array:
        """(size,)"""
        return np.full(self.size, self.mass_kg * MATERIALS[self.material].specific_heat_J_per_kgK / self.size)

    @property
    def surface_m2(self) -> Array:
        """Outer surface of every cell: both sides, and the rim where the cell lies on it, (size,)."""
        (nx, nz), (dx, dz) = self.counts, self.pitch_m
        i, j = np.arange(self.size) % nx, np.arange(self.size) // nx
        ends = (i == 0).astype(float) + (i == nx - 1)
        faces = (j == 0).astype(float) + (j == nz - 1)
        return np.asarray(2.0 * dx * dz + self.width_m * (dz * ends + dx * faces))

    def conduction(self) -> tuple[Cells, Cells, Array]:
        """Neighbours (one, other) and the conductance between their centres, W/K."""
        (nx, nz), (dx, dz) = self.counts, self.pitch_m
        material = MATERIALS[self.material]
        thickness_m = self.mass_kg / (material.density_kg_per_m3 * self.depth_m * self.height_m)
        number = np.arange(self.size).reshape(nz, nx)
        sheet = material.conductivity_W_per_mK * thickness_m
        along, up = number[:, :-1].ravel(), number[:-1].ravel()
        conductance = [np.full(len(along), sheet * dz / dx), np.full(len(up), sheet * dx / dz)]
        return np.concatenate([along, up]), np.concatenate([along + 1, up + nx]), np.concatenate(conductance)

    def box(self, depth: tuple[float, float] = (0.0, 1.0), height: tuple[float, float] = (0.0, 1.0)) -> Cells:
        """Cells of the blocks whose centres lie within these shares of both axes; if none, of that nearest the middle.

        By blocks, so that a joint or a source stays where it is when the grid is refined.
        """
        i, j = self.block % self.cells[0], self.block // self.cells[0]
        x = (i + 0.5) * (self.depth_m / self.cells[0]) / self.depth_m  # as `along_m` has it, to the last digit
        z = (j + 0.5) * (self.height_m / self.cells[1]) / self.height_m
        inside = (x >= depth[0]) & (x <= depth[1]) & (z >= height[0]) & (z <= height[1])
        if inside.any():
            return np.flatnonzero(inside)
        off = np.hypot(x - sum(depth) / 2, z - sum(height) / 2)
        return np.flatnonzero(self.block == self.block[int(np.argmin(off))])
