"""Thermoelastic displacement of the whole machine: quadratic hexahedra, castings tied by stiff patches, soft feet.

Linear in the rise, so one adjoint solve an error channel gives the influence of every node's rise on it (duality as in
Becker and Rannacher 2001). Small strains, isotropic, Duhamel and Neumann's law (Boley and Weiner 1960, chapter 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from skfem import Basis, ElementHex1, ElementHexS2
from skfem.assembly.basis import AbstractBasis

from data.arrays import Array
from thermodrift_exam.plants.elements.mesh import Mesh
from thermodrift_exam.plants.elements.structure import Contact, factorised, placed
from thermodrift_exam.plants.structure import MATERIALS, Cells

YOUNG_PA: Mapping[str, float] = {"steel": 210e9, "cast_iron": 120e9}
POISSON: Mapping[str, float] = {"steel": 0.29, "cast_iron": 0.26}
BOLTED_N_PER_M3 = 3e11  # stiffness of a joint by area, Ito (2008) gives 1e11 to 1e12
FEET_N_PER_M3 = (5e8, 5e8, 5e10)  # vertical support, free lateral growth of the bed


@dataclass(frozen=True)
class Field:
    """Displacements of one casting: dof 3 k + a is component a of scalar shape k; the first is number `first`."""

    mesh: Mesh
    basis: AbstractBasis
    first: int

    @property
    def size(self) -> int:
        return 3 * int(self.basis.N)

    def at(self, points_m: Array, size: int) -> list[sparse.csr_matrix]:
        """For each component, displacement at points (Q,) from all degrees of freedom (Q, size)."""
        elements = self.mesh.elements_at(points_m)
        local = self.basis.mapping.invF(points_m.T[:, :, None], tind=elements)
        elem, count = self.basis.elem, self.basis.Nbfun
        values = [np.ravel(elem.gbasis(self.basis.mapping, local, k, tind=elements)[0]) for k in range(count)]
        rows, shapes = np.tile(np.arange(len(points_m)), count), self.basis.element_dofs[:, elements].ravel()
        out = []
        for a in range(3):
            columns = self.first + 3 * shapes + a
            out.append(sparse.csr_matrix((np.concatenate(values), (rows, columns)), shape=(len(points_m), size)))
        return out


class Elasticity:
    """Stiffness and thermal load of tied castings; displacement is in m, temperature in K."""

    def __init__(self, meshes: Mapping[str, Mesh], contacts: Sequence[Contact], on_feet: str) -> None:
        self.fields: dict[str, Field] = {}
        size = 0
        for name, mesh in meshes.items():
            field = Field(mesh, Basis(mesh.hexahedra, ElementHexS2(), intorder=4), size)
            self.fields[name], size = field, size + field.size
        self.size = size
        self.nodes = sum(mesh.size for mesh in meshes.values())
        stiffness, load = [], []
        first = 0
        for field in self.fields.values():
            k, f = _casting(field)
            stiffness.append(placed(k, field.first, field.first, (size, size)))
            load.append(placed(f, field.first, first, (size, self.nodes)))
            first += field.mesh.size
        ties = [self._tie(c) for c in contacts]
        self.load = sparse.csc_matrix(sum(load[1:], load[0]))  # N/K
        whole = sum([*stiffness[1:], *ties, self._feet(on_feet)], stiffness[0])
        self.stiffness = sparse.csc_matrix(whole)
        self.solve = factorised(self.stiffness)

    def moved_m(self, rise_K: Array, casting: str, points_m: Array) -> Array:
        """Displacement of points (Q, 3) by the nodes' rises (nodes,): (Q, 3)."""
        u = self.solve(self.load @ rise_K)
        return np.stack([at @ u for at in self.fields[casting].at(points_m, self.size)], axis=1)

    def weights_um_per_K(self, one: tuple[str, Array], other: tuple[str, Array]) -> Array:
        """Displacement of point `one` from `other` (casting, (3,)) along x, y, z per kelvin of a node: (3, nodes)."""
        out = []
        for plus, minus in zip(*(self.fields[n].at(p[None], self.size) for n, p in (one, other)), strict=True):
            adjoint = self.solve(np.asarray((plus - minus).todense()).ravel())
            out.append(1e6 * (self.load.T @ adjoint))
        return np.stack(out)

    def _tie(self, c: Contact) -> sparse.csr_matrix:
        pairs = zip(*(self.fields[n].at(c.points_m, self.size) for n in (c.one, c.other)), c.held, strict=True)
        parts = []
        for one, other, held in pairs:
            jump = one - other
            parts.append(jump.T @ sparse.diags(held * BOLTED_N_PER_M3 * c.area_m2) @ jump)
        return sum(parts[1:], parts[0])

    def _feet(self, casting: str) -> sparse.csr_matrix:
        mesh = self.fields[casting].mesh
        points_m, area_m2 = mesh.hull([(2, 0)]).gauss()
        axes = zip(self.fields[casting].at(points_m, self.size), FEET_N_PER_M3, strict=True)
        parts = [at.T @ sparse.diags(stiff * area_m2) @ at for at, stiff in axes]
        return sum(parts[1:], parts[0])


def _casting(field: Field) -> tuple[sparse.csr_matrix, sparse.csr_matrix]:
    """Stiffness (dofs, dofs) in N/m and thermal load (dofs, nodes) in N/K of one casting.

    ∫ λ div u div v + 2 μ ε(u):ε(v) and ∫ (3 λ + 2 μ) α θ div v, with ribs' share of the metal.
    """
    box, basis = field.mesh.box, field.basis
    E, nu = box.fill * YOUNG_PA[box.material], POISSON[box.material]
    alpha_per_K = 1e-6 * MATERIALS[box.material].expansion_um_per_mK
    lame, shear = E * nu / (1 + nu) / (1 - 2 * nu), E / 2 / (1 + nu)
    gradient = np.stack([shape[0].grad for shape in basis.basis])  # (shapes, 3, elements, points)
    warm = Basis(basis.mesh, ElementHex1(), quadrature=basis.quadrature)
    theta = np.stack([np.asarray(shape[0]) for shape in warm.basis])
    G = np.einsum("iaeq,jbeq,eq->eiajb", gradient, gradient, basis.dx, optimize=True)
    K = lame * G + shear * np.swapaxes(G, 2, 4)
    trace = shear * np.einsum("eiajb,ab->eij", G, np.eye(3))
    for a in range(3):
        K[:, :, a, :, a] += trace
    f = (3 * lame + 2 * shear) * alpha_per_K * np.einsum("iaeq,jeq,eq->eiaj", gradient, theta, basis.dx, optimize=True)
    dofs = 3 * basis.element_dofs.T[:, :, None] + np.arange(3)  # (elements, shapes, 3)
    nodes = warm.element_dofs.T
    n = field.size
    return _summed(K, dofs, dofs, (n, n)), _summed(f, dofs, nodes, (n, field.mesh.size))


def _summed(blocks: Array, rows: Cells, columns: Cells, shape: tuple[int, int]) -> sparse.csr_matrix:
    e = len(blocks)
    r, c = rows.reshape(e, -1), columns.reshape(e, -1)
    i, j = np.repeat(r, c.shape[1], axis=1).ravel(), np.tile(c, (1, r.shape[1])).ravel()
    return sparse.csr_matrix((blocks.reshape(-1), (i, j)), shape=shape)
