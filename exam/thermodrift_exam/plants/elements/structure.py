"""The boxes put together: one field of temperatures over all of them, contacts, faces in air, bodies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementHex1
from skfem.helpers import dot, grad

from data.arrays import Array
from thermodrift_exam.plants.elements.mesh import Box, Mesh, Piece
from thermodrift_exam.plants.structure import AIR, WHOLE, Cells, Heat, Part, Structure


@BilinearForm
def _gradients(u, v, w):  # type: ignore[no-untyped-def]
    return dot(grad(u), grad(v))


@BilinearForm
def _values(u, v, w):  # type: ignore[no-untyped-def]
    return u * v


def conduction_W_per_K(mesh: Mesh, elements: Cells) -> sparse.csr_matrix:
    """∫ k ∇φᵢ·∇φⱼ over these elements, (n, n); Fourier's law, weak form."""
    basis = Basis(mesh.hexahedra, ElementHex1(), elements=elements)
    return mesh.box.conductivity_W_per_mK * _gradients.assemble(basis)


def storage_J_per_K(mesh: Mesh) -> sparse.csr_matrix:
    """∫ ρ c φᵢ φⱼ, (n, n)."""
    return mesh.box.capacity_J_per_m3K * _values.assemble(Basis(mesh.hexahedra, ElementHex1()))


def exchange_W_per_K(at: sparse.csr_matrix, conductance_W_per_K: Array) -> sparse.csr_matrix:
    """Σ_q g_q φᵢ φⱼ with the values `at` the quadrature points (Q, N) and their conductances (Q,)."""
    return sparse.csr_matrix(at.T @ sparse.diags(conductance_W_per_K) @ at)


def placed(block: sparse.csr_matrix, row: int, column: int, shape: tuple[int, int]) -> sparse.csr_matrix:
    """A block of a larger matrix of this shape, its first entry at this row and column."""
    wide = sparse.coo_matrix(block)
    return sparse.csr_matrix((wide.data, (wide.row + row, wide.col + column)), shape=shape)


def total(parts: Iterable[sparse.csr_matrix], size: int) -> sparse.csr_matrix:
    """Their sum, (N, N)."""
    return sum(parts, sparse.csr_matrix((size, size), dtype=np.float64))


def factorised(matrix: sparse.spmatrix) -> Callable[[Array], Array]:
    """The solver of a symmetric positive definite matrix."""
    options = {"SymmetricMode": True}
    solve: Callable[[Array], Array] = splu(
        sparse.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    ).solve
    return solve


GAMMA = 1.0 - 1.0 / np.sqrt(2.0)
DELTA = 1.0 / (2.0 * np.sqrt(2.0))
ALPHA = 1.0 / (4.0 * GAMMA)  # weight of the middle's heat: its time, 2 GAMMA, times it is a half
STAGES = (0.0, float(2.0 * GAMMA))


def integrate(
    storage_J_per_K: sparse.csc_matrix, losses: sparse.csc_matrix, heat_W: Heat, start_degC: Array, step_s: float,
    steps: int,
) -> Array:  # fmt: skip
    """``M dT/dt = -L T + heat`` from `start_degC` (N, B): temperatures (steps + 1, N, B).

    `storage_J_per_K` is M, `losses` L, both (N, N), symmetric, M positive definite.
    """
    M, L, h = storage_J_per_K, losses, step_s
    solve = factorised(M + GAMMA * h * L)
    out = np.empty((steps + 1, *start_degC.shape))
    out[0] = T = np.ascontiguousarray(start_degC)
    for k in range(steps):
        stored, lost = M @ T, L @ T
        first = heat_W(k, 0, T)
        middle = solve(stored + (h * GAMMA) * (2.0 * first - lost))
        second = heat_W(k, 1, middle)
        lost += L @ middle
        T = solve(stored + h * ((1.0 - ALPHA) * first + ALPHA * second - DELTA * lost))
        out[k + 1] = T
    return out


Matrices = Mapping[frozenset[str], sparse.csr_matrix]


@dataclass(frozen=True)
class Contact:
    """Where two castings meet: Gauss points (Q, 3) with areas (Q,), its conductance in all.

    Heat passes from `points_m` of the one to `heats_m` of the other, the same points where two faces touch. Both move
    together at `points_m`; `held` is how firmly, along x, y and z, as a share of a bolted joint's stiffness.
    """

    one: str
    other: str
    points_m: Array
    heats_m: Array
    area_m2: Array
    conductance_W_per_K: float
    held: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Face:
    """Hull of a casting, or a part of it, in the enclosure's air or in the room's."""

    casting: str
    pieces: list[Piece]
    coefficient_W_per_m2K: float
    enclosed: bool


@dataclass(frozen=True, kw_only=True)
class Elements(Structure):
    """N nodes of trilinear hexahedra, the enclosure's air last.

    `storage` (N, N), J/K; `conduction` of each body, `contacts` of each pair of bodies, W/K, (N, N); `halves` names
    the front and the back of a casting that has two. `exposed` is (body, "air" or "room") -> (N,), and `robin` the
    sum of these faces' matrices.
    """

    castings: Mapping[str, Box]
    meshes: Mapping[str, Mesh]
    storage: sparse.csc_matrix
    conduction: Mapping[str, sparse.csr_matrix]
    contacts: Matrices
    halves: Mapping[str, tuple[str, ...]]
    exposed: Mapping[tuple[str, str], Array]
    robin: sparse.csr_matrix

    stages: ClassVar[tuple[float, ...]] = STAGES

    @property
    def air_W_per_K(self) -> Array:
        return sum((g for (_, around), g in self.exposed.items() if around == AIR), np.zeros(self.size))

    def part(self, casting: str, depth: tuple[float, float] = WHOLE, height: tuple[float, float] = WHOLE) -> Part:
        """Exact integrals over the piece, whatever the grid."""
        mesh, first = self.meshes[casting], int(self.cells[casting][0])
        return part_of(mesh, first, mesh.box.pieces(depth, height))

    def losses(self) -> sparse.csc_matrix:
        out = total([*self.conduction.values(), *self.contacts.values(), self.robin], self.size)
        return sparse.csc_matrix(out)

    def between(self, one: str, other: str) -> sparse.csc_matrix | None:
        pair = frozenset((one, other))
        if AIR in pair or pair not in self.touching():
            return None
        contact = [self.contacts[pair]] if pair in self.contacts else []
        return sparse.csc_matrix(total([self.conduction[one], self.conduction[other], *contact], self.size))

    def exposure_W_per_K(self, body: str) -> dict[str, float]:
        if body == AIR:
            return {"room": float(self.room_W_per_K[self.air_cell])}
        none = np.zeros(self.size)
        return {around: float(self.exposed.get((body, around), none).sum()) for around in (AIR, "room")}

    def touching(self) -> set[frozenset[str]]:
        halves = {frozenset(names) for names in self.halves.values()}
        aired = {frozenset((body, AIR)) for body, around in self.exposed if around == AIR}
        return set(self.contacts) | halves | aired

    def joined(self) -> set[int]:
        return {int(n) for matrix in self.contacts.values() for n in np.flatnonzero(matrix.diagonal() > 0)}

    def off_middle(self, body: str) -> Array:
        cells = self.bodies[body].cells
        mesh, first = next((m, self.cells[n][0]) for n, m in self.meshes.items() if cells[0] in self.cells[n])
        at_m = mesh.points_m[cells - first]
        middle_m, half_m = (at_m.max(axis=0) + at_m.min(axis=0)) / 2, np.ptp(at_m, axis=0) / 2
        return np.asarray(np.max(np.abs(at_m - middle_m) / half_m, axis=1))

    def integrate(self, heat_W: Heat, start_degC: Array, step_s: float, steps: int) -> Array:
        return integrate(self.storage, self.losses(), heat_W, start_degC, step_s, steps)


def part_of(mesh: Mesh, first: int, pieces: list[Piece]) -> Part:
    """The pieces of a mesh whose nodes begin at `first` among all."""
    points_m, volume_m3 = mesh.volumes().within(pieces).gauss()
    carried = mesh.interpolation(points_m).T @ volume_m3
    points_m, area_m2 = mesh.hull().within(pieces).gauss()
    surface_m2 = mesh.interpolation(points_m).T @ area_m2
    own = np.flatnonzero(np.abs(carried) > 1e-9 * np.abs(carried).max())
    capacity = mesh.box.capacity_J_per_m3K * float(carried.sum())
    return Part(first + own, carried[own] / carried.sum(), surface_m2[own], capacity)


@dataclass
class Assembly:
    """A structure while it is put together."""

    boxes: list[Box]
    halves: frozenset[str]  # castings that a machine file has as a front and a back half
    air_J_per_K: float | None
    air_room_W_per_K: float
    contacts: list[Contact] = field(default_factory=list)
    faces: list[Face] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.meshes = {box.name: Mesh(box) for box in self.boxes}
        sizes = [mesh.size for mesh in self.meshes.values()]
        self.first = dict(zip(self.meshes, np.cumsum([0, *sizes[:-1]]).tolist(), strict=True))
        self.nodes = sum(sizes)
        self.size = self.nodes + (self.air_J_per_K is not None)

    def at(self, casting: str, points_m: Array) -> sparse.csr_matrix:
        """Values at the nodes (N,) to values at points of a casting (Q,)."""
        return placed(self.meshes[casting].interpolation(points_m), 0, self.first[casting], (len(points_m), self.size))

    def _block(self, casting: str, own: sparse.csr_matrix) -> sparse.csr_matrix:
        """A casting's matrix (n, n) at its place among all nodes, (N, N)."""
        return placed(own, self.first[casting], self.first[casting], (self.size, self.size))

    def done(self) -> Elements:
        air = self.nodes if self.air_J_per_K is not None else None
        exposed, robin = self._exposed(air)
        storage = total((self._block(n, storage_J_per_K(m)) for n, m in self.meshes.items()), self.size)
        bodies = {k: v for name in self.meshes for k, v in self._bodies(name).items()}
        room = sum((g for (_, around), g in exposed.items() if around == "room"), np.zeros(self.size))
        above_m = np.concatenate([*(m.points_m[:, 2] for m in self.meshes.values()), np.ones(self.size - self.nodes)])
        if air is not None:
            assert self.air_J_per_K is not None
            storage = storage + _one(air, self.air_J_per_K, self.size)
            robin = robin + _one(air, self.air_room_W_per_K, self.size)
            room[air] = self.air_room_W_per_K
            bodies[AIR] = Part(np.array([air]), np.ones(1), np.zeros(1), self.air_J_per_K)
        return Elements(
            castings={box.name: box for box in self.boxes},
            cells={name: self.first[name] + np.arange(mesh.size) for name, mesh in self.meshes.items()},
            bodies=bodies,
            capacity_J_per_K=np.asarray(storage @ np.ones(self.size)),
            above_floor_m=above_m,
            room_W_per_K=room,
            air_cell=air,
            meshes=self.meshes,
            storage=sparse.csc_matrix(storage),
            conduction={k: v for name in self.meshes for k, v in self._conduction(name).items()},
            contacts=self._contacts(),
            halves={name: self._names(name) for name in self.halves},
            exposed=exposed,
            robin=robin,
        )

    def _names(self, casting: str) -> tuple[str, ...]:
        """Its bodies, the front one first."""
        back = {"column": "column_back"}.get(casting, f"{casting}_rear")
        return (f"{casting}_front", back) if casting in self.halves else (casting,)

    def _middle_m(self, casting: str) -> float:
        box = self.meshes[casting].box
        return box.low_m[1] + box.size_m[1] / 2

    def _body(self, casting: str, points_m: Array) -> NDArray[np.str_]:
        names = self._names(casting)
        return np.where(points_m[:, 1] > self._middle_m(casting), names[0], names[-1])

    def _bodies(self, casting: str) -> dict[str, Part]:
        mesh, names = self.meshes[casting], self._names(casting)
        depths = ((0.5, 1.0), (0.0, 0.5)) if len(names) == 2 else (WHOLE,)
        pieces = [mesh.box.pieces(depth) for depth in depths]
        return {n: part_of(mesh, self.first[casting], p) for n, p in zip(names, pieces, strict=True)}

    def _conduction(self, casting: str) -> dict[str, sparse.csr_matrix]:
        mesh = self.meshes[casting]
        whose = self._body(casting, mesh.hexahedra.p[:, mesh.hexahedra.t].mean(axis=1).T)
        return {
            name: self._block(casting, conduction_W_per_K(mesh, np.flatnonzero(whose == name)))
            for name in self._names(casting)
        }

    def _contacts(self) -> dict[frozenset[str], sparse.csr_matrix]:
        out: dict[frozenset[str], sparse.csr_matrix] = {}
        for c in self.contacts:
            jump = self.at(c.one, c.points_m) - self.at(c.other, c.heats_m)
            conductance = c.conductance_W_per_K * c.area_m2 / c.area_m2.sum()
            one, other = self._body(c.one, c.points_m), self._body(c.other, c.heats_m)
            for a in self._names(c.one):
                for b in self._names(c.other):
                    here = np.flatnonzero((one == a) & (other == b))
                    if len(here):
                        matrix = exchange_W_per_K(jump[here], conductance[here])
                        pair = frozenset((a, b))
                        out[pair] = out[pair] + matrix if pair in out else matrix
        return out

    def _exposed(self, air: int | None) -> tuple[dict[tuple[str, str], Array], sparse.csr_matrix]:
        """Nodal conductances of every body's faces, and the matrix of all, the air's row and column included."""
        exposed: dict[tuple[str, str], Array] = {}
        robin = sparse.csr_matrix((self.size, self.size), dtype=np.float64)
        for face in self.faces:
            points_m, area_m2 = self.meshes[face.casting].hull().within(face.pieces).gauss()
            conductance, at = face.coefficient_W_per_m2K * area_m2, self.at(face.casting, points_m)
            around = AIR if face.enclosed and air is not None else "room"
            robin = robin + exchange_W_per_K(at, conductance)
            whose = self._body(face.casting, points_m)
            for body in self._names(face.casting):
                g = np.asarray(at[whose == body].T @ conductance[whose == body])
                exposed[body, around] = exposed.get((body, around), np.zeros(self.size)) + g
            if face.enclosed and air is not None:
                robin = robin + _to_air(np.asarray(at.T @ conductance), air, self.size)
        return {k: g for k, g in exposed.items() if g.sum() > 0}, robin


def _one(node: int, value: float, size: int) -> sparse.csr_matrix:
    return sparse.csr_matrix(([value], ([node], [node])), shape=(size, size))


def _to_air(g: Array, air: int, size: int) -> sparse.csr_matrix:
    nodes = np.flatnonzero(g)
    airs = np.full(len(nodes), air)
    off = sparse.csr_matrix((-g[nodes], (nodes, airs)), shape=(size, size))
    return off + off.T + _one(air, float(g.sum()), size)
