"""Consistent matrices of heat: conduction and storage of hexahedra, Robin faces, contacts by quadrature."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from skfem import Basis, BilinearForm, ElementHex1
from skfem.helpers import dot, grad

from twin.plants.casting import Array, Cells
from twin.plants.elements.mesh import Mesh


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


def embedded(block: sparse.csr_matrix, first: int, size: int) -> sparse.csr_matrix:
    """A casting's columns at its place among all nodes: (Q, n) to (Q, N)."""
    wide = sparse.coo_matrix(block)
    return sparse.csr_matrix((wide.data, (wide.row, wide.col + first)), shape=(block.shape[0], size))


def square(block: sparse.csr_matrix, first: int, size: int) -> sparse.csr_matrix:
    """A casting's matrix at its place among all nodes: (n, n) to (N, N)."""
    wide = sparse.coo_matrix(block)
    return sparse.csr_matrix((wide.data, (wide.row + first, wide.col + first)), shape=(size, size))


def total(parts: list[sparse.csr_matrix], size: int) -> sparse.csr_matrix:
    """Their sum, (N, N)."""
    out = sparse.csr_matrix((size, size), dtype=np.float64)
    for part in parts:
        out = out + part
    return out
