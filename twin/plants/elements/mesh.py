"""The hexahedra of a box: numbering of nodes, interpolation at any point, volumes and faces."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product

import numpy as np
from scipy import sparse
from skfem import MeshHex

from twin.plants.casting import Array, Cells
from twin.plants.elements.box import Box
from twin.plants.elements.slabs import Slabs, joined

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
            beside = self.cell.copy()
            beside[:, axis] += 2 * end - 1
            rim = np.flatnonzero((beside[:, axis] >= 0) & (beside[:, axis] < self.element.shape[axis]))
            rim = rim[self.element[tuple(beside[rim].T)] < 0]
            rims.append(self._slabs(self.cell[rim]).side(axis, end))
        return joined(rims)

    def _slabs(self, cell: Cells) -> Slabs:
        low = np.stack([line[cell[:, k]] for k, line in enumerate(self.lines_m)], axis=1)
        high = np.stack([line[cell[:, k] + 1] for k, line in enumerate(self.lines_m)], axis=1)
        return Slabs(low, high, np.ones(len(cell)))
