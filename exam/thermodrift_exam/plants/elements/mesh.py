"""The hexahedra of a box: numbering of nodes, interpolation at any point, volumes and faces."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from skfem import MeshHex

from data.arrays import Array
from thermodrift_exam.plants.structure import MATERIALS, WHOLE, Casting, Cells

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


GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))
FLAT_M = 1e-9


@dataclass(frozen=True)
class Slabs:
    """F boxes from `low_m` to `high_m` (F, 3), those without thickness along an axis being faces; `sign` (F,)."""

    low_m: Array
    high_m: Array
    sign: Array

    def within(self, pieces: Sequence[Piece]) -> Slabs:
        """Their intersection with the pieces; negative pieces are subtracted."""
        parts = []
        for sign, under, over in pieces:
            low, high = np.maximum(self.low_m, under), np.minimum(self.high_m, over)
            parts.append(_kept(self, low, high, sign * self.sign))
        return joined(parts)

    def side(self, axis: int, end: int) -> Slabs:
        """Their faces at the lower (0) or upper (1) end of an axis."""
        low, high = self.low_m.copy(), self.high_m.copy()
        low[:, axis] = high[:, axis] = (high if end else low)[:, axis]
        return Slabs(low, high, self.sign)

    def cut(self, lines_m: Sequence[Array]) -> Slabs:
        """Their intersection with a grid, cut at its planes: functions of that grid are smooth on each."""
        out = self
        for axis, line in enumerate(lines_m):
            n = len(line) - 1
            whole = Slabs(*(np.repeat(a, n, axis=0) for a in (out.low_m, out.high_m, out.sign)))
            low, high, cell = whole.low_m.copy(), whole.high_m.copy(), np.tile(np.arange(n), len(out.sign))
            at = np.clip(np.searchsorted(line, low[:, axis], "right") - 1, 0, n - 1)
            flat = high[:, axis] - low[:, axis] <= FLAT_M
            low[:, axis] = np.maximum(low[:, axis], line[cell])
            high[:, axis] = np.where(flat & (at != cell), -np.inf, np.minimum(high[:, axis], line[cell + 1]))
            out = _kept(whole, low, high, whole.sign)
        return out

    def gauss(self) -> tuple[Array, Array]:
        """Two points along each axis (8 F, 3) and the volumes or areas they stand for (8 F,)."""
        sides_m = self.high_m - self.low_m
        size = self.sign * np.prod(np.where(sides_m > FLAT_M, sides_m, 1.0), axis=1) / 8.0
        points = [self.low_m + sides_m * np.array(where) for where in product(GAUSS, repeat=3)]
        return np.concatenate(points), np.tile(size, 8)


def joined(parts: Sequence[Slabs]) -> Slabs:
    """All of them."""
    return Slabs(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("low_m", "high_m", "sign")))


def _kept(whole: Slabs, low: Array, high: Array, sign: Array) -> Slabs:
    """Without those of which nothing is left; a face may lie up to `FLAT_M` off."""
    flat = whole.high_m - whole.low_m <= FLAT_M
    thick = high - low
    keep = np.all(np.where(flat, thick > -FLAT_M, thick > FLAT_M), axis=1)
    return Slabs(np.where(flat, whole.low_m, low)[keep], np.where(flat, whole.high_m, high)[keep], sign[keep])


SIDES = tuple(product(range(3), (0, 1)))


class Mesh:
    """The mesh of a box; `nodes` (nx + 1, ny + 1, nz + 1) numbers the planes' crossings, -1 where there is no metal."""

    def __init__(self, box: Box) -> None:
        self.box, self.lines_m = box, box.lines_m
        solid = box.solid
        whole = MeshHex.init_tensor(*self.lines_m)
        cell = self._places(whole.p[:, whole.t].mean(axis=1).T)
        self.hexahedra = whole.remove_elements(np.flatnonzero(~solid[tuple(cell.T)]))
        self.cell = self._places(self.hexahedra.p[:, self.hexahedra.t].mean(axis=1).T)  # (elements, 3)
        self.element = np.full(solid.shape, -1)
        self.element[tuple(self.cell.T)] = np.arange(len(self.cell))
        self.nodes = np.full([len(line) for line in self.lines_m], -1)
        self.nodes[tuple(self._crossings(self.hexahedra.p.T).T)] = np.arange(self.size)

    @property
    def size(self) -> int:
        return int(self.hexahedra.p.shape[1])

    @property
    def points_m(self) -> Array:
        """(nodes, 3)"""
        return np.asarray(self.hexahedra.p.T)

    def _places(self, points_m: Array) -> Cells:
        """The grid's cell of every point, (Q, 3); on a plane the one above it, on the last the one below."""
        axes = zip(self.lines_m, points_m.T, strict=True)
        return np.stack([np.clip(np.searchsorted(n, x, "right") - 1, 0, len(n) - 2) for n, x in axes], axis=1)

    def _crossings(self, points_m: Array) -> Cells:
        axes = zip(self.lines_m, points_m.T, strict=True)
        return np.stack([np.argmin(np.abs(n[:, None] - x), axis=0) for n, x in axes], axis=1)

    def elements_at(self, points_m: Array) -> Cells:
        """The element that holds each point; on a face between metal and none, the metal's."""
        snug = np.clip(points_m, [n[0] for n in self.lines_m], [n[-1] for n in self.lines_m])
        found = self.element[tuple(self._places(snug).T)]
        for side in product((-1e-9, 0.0, 1e-9), repeat=3):
            found = np.where(found < 0, self.element[tuple(self._places(snug + side).T)], found)
        assert (found >= 0).all(), f"a point of {self.box.name} lies where there is no metal"
        return np.asarray(found)

    def interpolation(self, points_m: Array) -> sparse.csr_matrix:
        """Trilinear: values at the nodes (n,) to values at points (Q,); all points lie in the metal or on its faces."""
        cell = self.cell[self.elements_at(points_m)]
        share = np.empty_like(points_m)
        for axis, line in enumerate(self.lines_m):
            low, high = line[cell[:, axis]], line[cell[:, axis] + 1]
            share[:, axis] = np.clip((points_m[:, axis] - low) / (high - low), 0.0, 1.0)
        rows, columns, values = [], [], []
        for corner in product((0, 1), repeat=3):
            rows.append(np.arange(len(points_m)))
            columns.append(self.nodes[tuple((cell + corner).T)])
            values.append(np.prod(np.where(np.array(corner) == 1, share, 1.0 - share), axis=1))
        triplets = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return sparse.csr_matrix(triplets, shape=(len(points_m), self.size))

    def volumes(self) -> Slabs:
        """All hexahedra."""
        return self._slabs(self.cell)

    def hull(self, sides: Iterable[tuple[int, int]] = SIDES) -> Slabs:
        """Faces on the box's outer planes, those of `sides`: axis, and 0 for the lower or 1 for the upper end."""
        rims = []
        for axis, end in sides:
            last = len(self.lines_m[axis]) - 2
            rims.append(self._slabs(self.cell[self.cell[:, axis] == last * end]).side(axis, end))
        return joined(rims)

    def bore(self) -> Slabs:
        """Inner faces of a tube's four walls."""
        rims = []
        for axis, end in product((0, 1), (0, 1)):
            adjacent = self.cell.copy()
            adjacent[:, axis] += 2 * end - 1
            rim = np.flatnonzero((adjacent[:, axis] >= 0) & (adjacent[:, axis] < self.element.shape[axis]))
            rim = rim[self.element[tuple(adjacent[rim].T)] < 0]
            rims.append(self._slabs(self.cell[rim]).side(axis, end))
        return joined(rims)

    def _slabs(self, cell: Cells) -> Slabs:
        low = np.stack([line[cell[:, k]] for k, line in enumerate(self.lines_m)], axis=1)
        high = np.stack([line[cell[:, k] + 1] for k, line in enumerate(self.lines_m)], axis=1)
        return Slabs(low, high, np.ones(len(cell)))
