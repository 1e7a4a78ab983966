"""Time integration: trapezoidal rule and second-order backward difference, TR-BDF2, with an explicit partner.

TR-BDF2 of Bank et al. (1985) and Hosea and Shampine (1996), L-stable, for conduction and convection. What the
temperatures change otherwise takes the explicit midpoint rule's kin with its point at TR-BDF2's own middle: the
conditions of Ascher, Ruuth and Spiteri (1997), section 2, then make both together of second order, one step at a time.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from twin.plants.casting import Array
from twin.plants.structure import Heat

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
    solve = _factorised(M + GAMMA * h * L)
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


def _factorised(matrix: sparse.csc_matrix):  # type: ignore[no-untyped-def]
    options = {"SymmetricMode": True}
    return splu(sparse.csc_matrix(matrix), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve
