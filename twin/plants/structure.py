"""The castings put together: all cells of a machine, what conducts between them and what they lose to the room."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse

from twin.plants.casting import MATERIALS, Array, Casting, Cells

AIR = "air"


@dataclass(frozen=True)
class Structure:
    """N cells. `bodies` are the places that a machine file would name: whole castings, or their halves.

    capacity_J_per_K, surface_m2, above_floor_m, expansion_um_per_mK and room_W_per_K (N,). `one`, `other` and
    `between_W_per_K` (E,) are conduction, joints and convection to the enclosure's air, which is a cell of its own;
    `surfaces` (E,) tells the last kind.
    """

    castings: Mapping[str, Casting]
    cells: Mapping[str, Cells]  # of each casting
    bodies: Mapping[str, Cells]
    capacity_J_per_K: Array
    surface_m2: Array
    above_floor_m: Array
    expansion_um_per_mK: Array
    one: Cells
    other: Cells
    between_W_per_K: Array
    surfaces: Array
    room_W_per_K: Array
    air_cell: int | None = None

    @property
    def size(self) -> int:
        return len(self.capacity_J_per_K)

    @property
    def air_W_per_K(self) -> Array:
        """Convection of every cell to the enclosure's air, W/K, (N,); the air's own entry is 0."""
        out = np.zeros(self.size)
        np.add.at(out, self.one[self.surfaces > 0], self.between_W_per_K[self.surfaces > 0])
        return out

    def touching(self) -> set[frozenset[str]]:
        """Pairs of bodies between which heat flows directly."""
        body = {int(c): name for name, cells in self.bodies.items() for c in cells}
        pairs = {frozenset((body[int(i)], body[int(j)])) for i, j in zip(self.one, self.other, strict=True)}
        return {pair for pair in pairs if len(pair) == 2}

    def joined(self) -> set[int]:
        """Cells in contact with another casting."""
        casting = np.full(self.size, -1)
        for k, cells in enumerate(self.cells.values()):
            casting[cells] = k
        contact = (casting[self.one] != casting[self.other]) & (self.surfaces == 0)
        return {int(c) for c in np.concatenate([self.one[contact], self.other[contact]])}

    def losses(self) -> sparse.csc_matrix:
        """The matrix L of ``C dT/dt = -L T + heat``, W/K, (N, N): symmetric, its rows add up to `room_W_per_K`."""
        n, g = self.size, self.between_W_per_K
        off = sparse.coo_matrix((g, (self.one, self.other)), shape=(n, n))
        diagonal = np.bincount(self.one, g, n) + np.bincount(self.other, g, n) + self.room_W_per_K
        return sparse.csc_matrix(sparse.diags(diagonal) - off - off.T)


@dataclass
class Assembly:
    """A structure while it is put together; heat flows and places are stated by casting and share of its size."""

    castings: dict[str, Casting] = field(default_factory=dict)
    halves: set[str] = field(default_factory=set)  # castings that a machine file has as a front and a back half
    air_J_per_K: float | None = None
    _edges: list[tuple[Cells, Cells, Array, bool]] = field(default_factory=list)
    _first: dict[str, int] = field(default_factory=dict)
    _size: int = 0
    _room: list[tuple[Cells, Array]] = field(default_factory=list)

    def add(self, casting: Casting, halves: bool = False) -> None:
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
        """A contact between two groups of cells: pairwise where they are equally many, else each with each."""
        if len(one) != len(other):
            a, b = (g.ravel() for g in np.meshgrid(one, other, indexing="ij"))
        else:
            a, b = one, other
        self._edges.append((a, b, np.full(len(a), conductance_W_per_K / len(a)), False))

    def exposed(self, cells: Cells, coefficient_W_per_m2K: float, enclosed: bool) -> None:
        """Convection at the cells' outer surface, to the enclosure's air where there is one and they are inside."""
        surface = np.concatenate([c.surface_m2 for c in self.castings.values()])
        conductance = coefficient_W_per_m2K * surface[cells]
        if enclosed and self.air_J_per_K is not None:
            self._edges.append((cells, np.full(len(cells), -1), conductance, True))  # -1: the air, numbered last
        else:
            self._room.append((cells, conductance))

    def done(self, air_room_W_per_K: float) -> Structure:
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
        return Structure(
            castings=self.castings,
            cells=own,
            bodies=bodies,
            capacity_J_per_K=np.concatenate([*(c.capacity_J_per_K for c in parts), air]),
            surface_m2=np.concatenate([*(c.surface_m2 for c in parts), [0.0] * len(air)]),
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
        front = self.castings[name].along_m[0] > self.castings[name].depth_m / 2
        back = {"column": "column_back"}.get(name, f"{name}_rear")
        return {f"{name}_front": cells[front], back: cells[~front]}
