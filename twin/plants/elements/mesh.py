"""The hexahedra of a box: numbering of nodes, interpolation at any point, quadrature over pieces and faces."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy import sparse
from skfem import MeshHex

from twin.plants.casting import Array, Cells
from twin.plants.elements.box import Box, Piece

GAUSS = (0.5 - 0.5 / np.sqrt(3.0), 0.5 + 0.5 / np.sqrt(3.0))


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

    def inside(self, pieces: list[Piece]) -> tuple[Array, Array]:
        """Gauss points (Q, 3) and volumes (Q,) of the metal in these pieces, exact for trilinear functions."""
        low = np.stack([n[self.cell[:, k]] for k, n in enumerate(self.lines_m)], axis=1)
        high = np.stack([n[self.cell[:, k] + 1] for k, n in enumerate(self.lines_m)], axis=1)
        return _gauss(low, high, pieces, (0, 1, 2))

    def outside(self, pieces: list[Piece], sides: tuple[tuple[int, int], ...] | None = None) -> tuple[Array, Array]:
        """Gauss points and areas of the faces on the box's hull in these pieces; `sides`: (axis, 0 low or 1 high)."""
        points, areas = [], []
        for axis, end in sides or tuple(product(range(3), (0, 1))):
            n = len(self.lines_m[axis]) - 1
            rim = self.cell[self.cell[:, axis] == (n - 1) * end]
            points_m, area_m2 = self._faces(rim, axis, end, pieces)
            points.append(points_m)
            areas.append(area_m2)
        return np.concatenate(points), np.concatenate(areas)

    def bore(self, pieces: list[Piece]) -> tuple[Array, Array]:
        """Gauss points and areas of the inner faces of a tube's four walls in these pieces."""
        points, areas = [], []
        for axis, end in product((0, 1), (0, 1)):
            beside = self.cell.copy()
            beside[:, axis] += 2 * end - 1
            within = (beside[:, axis] >= 0) & (beside[:, axis] < self.element.shape[axis])
            rim = np.flatnonzero(within)
            rim = rim[self.element[tuple(beside[rim].T)] < 0]
            points_m, area_m2 = self._faces(self.cell[rim], axis, end, pieces)
            points.append(points_m)
            areas.append(area_m2)
        return np.concatenate(points), np.concatenate(areas)

    def _faces(self, cell: Cells, axis: int, end: int, pieces: list[Piece]) -> tuple[Array, Array]:
        low = np.stack([n[cell[:, k]] for k, n in enumerate(self.lines_m)], axis=1)
        high = np.stack([n[cell[:, k] + 1] for k, n in enumerate(self.lines_m)], axis=1)
        plane = (high if end else low)[:, axis]
        low[:, axis] = high[:, axis] = plane
        return _gauss(low, high, pieces, tuple(k for k in range(3) if k != axis))


def _gauss(low: Array, high: Array, pieces: list[Piece], axes: tuple[int, ...]) -> tuple[Array, Array]:
    """Two points along each of `axes` of every box or face, clipped to the pieces; signed sizes."""
    points, sizes = [], []
    for sign, under, over in pieces:
        a, b = np.maximum(low, under), np.minimum(high, over)
        flat = [k for k in range(3) if k not in axes]
        keep = np.all((b - a)[:, list(axes)] > 1e-12, axis=1) & np.all((b - a)[:, flat] > -1e-9, axis=1)
        a, b = np.where(b < a, b, a)[keep], b[keep]
        size = sign * np.prod((b - a)[:, list(axes)], axis=1) / 2 ** len(axes)
        for where in product(GAUSS, repeat=len(axes)):
            share = np.zeros(3)
            share[list(axes)] = where
            points.append(a + (b - a) * share)
            sizes.append(size)
    return np.concatenate(points), np.concatenate(sizes)
