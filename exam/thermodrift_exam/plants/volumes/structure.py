"""The castings put together: all cells of a machine, what conducts between them and what they lose to the room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from data.arrays import Array
from thermodrift_exam.plants.structure import AIR, MATERIALS, WHOLE, Casting, Cells, Heat, Part, Structure


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


GAMMA = 1.0 - 1.0 / np.sqrt(2.0)
DELTA = 1.0 - 1.0 / (2.0 * GAMMA)
STAGES = (0.0, float(GAMMA))


def integrate(
    capacity_J_per_K: Array, losses: sparse.csc_matrix, heat_W: Heat, start_degC: Array, step_s: float, steps: int
) -> Array:
    """``C dT/dt = -L T + heat`` from `start_degC` (N, B): temperatures (steps + 1, N, B).

    `losses` is L, W/K, (N, N).
    """
    capacity = capacity_J_per_K[:, None]
    solve = splu(sparse.csc_matrix(sparse.diags(capacity_J_per_K) + GAMMA * step_s * losses)).solve
    out = np.empty((steps + 1, *start_degC.shape))
    out[0] = cells = np.ascontiguousarray(start_degC)
    for k in range(steps):
        stored, first = capacity * cells, heat_W(k, 0, cells)
        within = stored + GAMMA * step_s * first
        middle = solve(within)
        lost_J = (within - capacity * middle) * ((1.0 - GAMMA) / GAMMA)  # step (1 - γ) L times the stage
        second = heat_W(k, 1, middle)
        cells = solve(stored - lost_J + step_s * (DELTA * first + (1.0 - DELTA) * second))
        out[k + 1] = cells
    return out


@dataclass(frozen=True, kw_only=True)
class Volumes(Structure):
    """N finite volumes, each of one body.

    surface_m2 and expansion_um_per_mK (N,). `one`, `other` and `between_W_per_K` (E,) are conduction, joints and
    convection to the enclosure's air, which is a cell of its own; `surfaces` (E,) is 1 for the last kind.
    """

    castings: Mapping[str, Plate]
    surface_m2: Array
    expansion_um_per_mK: Array
    one: Cells
    other: Cells
    between_W_per_K: Array
    surfaces: Array

    stages: ClassVar[tuple[float, ...]] = STAGES

    @property
    def air_W_per_K(self) -> Array:
        """Convection of every cell to the enclosure's air, W/K, (N,); the air's own entry is 0."""
        out = np.zeros(self.size)
        np.add.at(out, self.one[self.surfaces > 0], self.between_W_per_K[self.surfaces > 0])
        return out

    def part(self, casting: str, depth: tuple[float, float] = WHOLE, height: tuple[float, float] = WHOLE) -> Part:
        """The cells whose centres lie there; where there is none, the one nearest its middle."""
        return even(
            self.cells[casting][self.castings[casting].box(depth, height)], self.capacity_J_per_K, self.surface_m2
        )

    def touching(self) -> set[frozenset[str]]:
        body = {int(c): name for name, part in self.bodies.items() for c in part.cells}
        pairs = {frozenset((body[int(i)], body[int(j)])) for i, j in zip(self.one, self.other, strict=True)}
        return {pair for pair in pairs if len(pair) == 2}

    def joined(self) -> set[int]:
        casting = np.full(self.size, -1)
        for k, cells in enumerate(self.cells.values()):
            casting[cells] = k
        contact = (casting[self.one] != casting[self.other]) & (self.surfaces == 0)
        return {int(c) for c in np.concatenate([self.one[contact], self.other[contact]])}

    def off_middle(self, body: str) -> Array:
        cells = self.bodies[body].cells
        name = next(n for n, own in self.cells.items() if cells[0] in own)
        here = np.searchsorted(self.cells[name], cells)
        off = []
        for along in self.castings[name].along_m:
            own = along[here]
            half = max(np.ptp(own) / 2, 1e-9)
            off.append((own - (own.max() + own.min()) / 2) / half)
        return np.asarray(np.max(np.abs(off), axis=0))

    def losses(self) -> sparse.csc_matrix:
        return _laplacian(self.one, self.other, self.between_W_per_K, self.room_W_per_K)

    def between(self, one: str, other: str) -> sparse.csc_matrix | None:
        a, b = self.share_of(one) > 0, self.share_of(other) > 0
        within = (a | b)[self.one] & (a | b)[self.other] & (self.surfaces == 0)
        i, j, g = self.one[within], self.other[within], self.between_W_per_K[within]
        return _laplacian(i, j, g, np.zeros(self.size)) if np.any(a[i] != a[j]) else None

    def exposure_W_per_K(self, body: str) -> dict[str, float]:
        cells = self.bodies[body].cells
        return {"air": float(self.air_W_per_K[cells].sum()), "room": float(self.room_W_per_K[cells].sum())}

    def integrate(self, heat_W: Heat, start_degC: Array, step_s: float, steps: int) -> Array:
        return integrate(self.capacity_J_per_K, self.losses(), heat_W, start_degC, step_s, steps)


def even(cells: Cells, capacity_J_per_K: Array, surface_m2: Array) -> Part:
    """Cells of equal weight."""
    return Part(cells, np.full(len(cells), 1.0 / len(cells)), surface_m2[cells], float(capacity_J_per_K[cells].sum()))


def _laplacian(one: Cells, other: Cells, conductance_W_per_K: Array, outside_W_per_K: Array) -> sparse.csc_matrix:
    n, g = len(outside_W_per_K), conductance_W_per_K
    off = sparse.coo_matrix((g, (one, other)), shape=(n, n))
    diagonal = np.bincount(one, g, n) + np.bincount(other, g, n) + outside_W_per_K
    return sparse.csc_matrix(sparse.diags(diagonal) - off - off.T)


@dataclass
class Assembly:
    """A structure while it is put together; heat flows and places are stated by casting and share of its size."""

    castings: dict[str, Plate] = field(default_factory=dict)
    halves: set[str] = field(default_factory=set)  # castings that a machine file has as a front and a back half
    air_J_per_K: float | None = None
    _edges: list[tuple[Cells, Cells, Array, bool]] = field(default_factory=list)
    _first: dict[str, int] = field(default_factory=dict)
    _size: int = 0
    _room: list[tuple[Cells, Array]] = field(default_factory=list)

    def add(self, casting: Plate, halves: bool = False) -> None:
        self.castings[casting.name], self._first[casting.name] = casting, self._size
        one, other, conductance = casting.conduction()
        self._edges.append((one + self._size, other + self._size, conductance, False))
        self._size += casting.size
        if halves:
            self.halves.add(casting.name)

    def box(
        self, name: str, depth: tuple[float, float] = (0.0, 1.0), height: tuple[float, float] = (0.0, 1.0)
    ) -> Cells:
        """Cells of a casting within these shares of its axes."""
        return self._first[name] + self.castings[name].box(depth, height)

    def joint(self, one: Cells, other: Cells, conductance_W_per_K: float) -> None:
        """A contact between two groups of blocks: pairwise where they are equally many, else each with each.

        Within a pair of blocks every cell with every cell.
        """
        ones, others = self._blocks(one), self._blocks(other)
        pairs = list(zip(ones, others, strict=True)) if len(ones) == len(others) else [(one, other)]
        for pair in pairs:
            a, b = (g.ravel() for g in np.meshgrid(*pair, indexing="ij"))
            self._edges.append((a, b, np.full(len(a), conductance_W_per_K / len(pairs) / len(a)), False))

    def _blocks(self, cells: Cells) -> list[Cells]:
        """Cells of one casting by the block they are pieces of."""
        name = max((n for n in self._first if self._first[n] <= cells[0]), key=lambda n: self._first[n])
        block = self.castings[name].block[cells - self._first[name]]
        return [cells[block == k] for k in dict.fromkeys(block.tolist())]

    def exposed(self, cells: Cells, coefficient_W_per_m2K: float, enclosed: bool) -> None:
        """Convection at the cells' outer surface, to the enclosure's air where there is one and they are inside."""
        surface = np.concatenate([c.surface_m2 for c in self.castings.values()])
        conductance = coefficient_W_per_m2K * surface[cells]
        if enclosed and self.air_J_per_K is not None:
            self._edges.append((cells, np.full(len(cells), -1), conductance, True))  # -1: the air, numbered last
        else:
            self._room.append((cells, conductance))

    def done(self, air_room_W_per_K: float) -> Volumes:
        parts, n = list(self.castings.values()), self._size
        air = [] if self.air_J_per_K is None else [self.air_J_per_K]
        room = np.zeros(n + len(air))
        for cells, conductance in self._room:
            np.add.at(room, cells, conductance)
        room[n:] = air_room_W_per_K
        edges = [(a, np.where(b < 0, n, b), g, np.full(len(a), float(s))) for a, b, g, s in self._edges]
        own = {c.name: self._first[c.name] + np.arange(c.size) for c in parts}
        bodies = {k: v for name in own for k, v in self._bodies(name, own[name]).items()}
        if air:
            bodies[AIR] = np.array([n])
        capacity = np.concatenate([*(c.capacity_J_per_K for c in parts), air])
        surface = np.concatenate([*(c.surface_m2 for c in parts), [0.0] * len(air)])
        return Volumes(
            castings=self.castings,
            cells=own,
            bodies={name: even(cells, capacity, surface) for name, cells in bodies.items()},
            capacity_J_per_K=capacity,
            surface_m2=surface,
            above_floor_m=np.concatenate([*(c.above_floor_m for c in parts), [1.0] * len(air)]),
            expansion_um_per_mK=np.concatenate(
                [*(np.full(c.size, MATERIALS[c.material].expansion_um_per_mK) for c in parts), [0.0] * len(air)]
            ),
            one=np.concatenate([e[0] for e in edges]),
            other=np.concatenate([e[1] for e in edges]),
            between_W_per_K=np.concatenate([e[2] for e in edges]),
            surfaces=np.concatenate([e[3] for e in edges]),
            room_W_per_K=room,
            air_cell=n if air else None,
        )

    def _bodies(self, name: str, cells: Cells) -> dict[str, Cells]:
        if name not in self.halves:
            return {name: cells}
        casting = self.castings[name]
        front = (casting.block % casting.cells[0] + 0.5) * casting.split * casting.pitch_m[0] > casting.depth_m / 2
        back = {"column": "column_back"}.get(name, f"{name}_rear")
        return {f"{name}_front": cells[front], back: cells[~front]}
