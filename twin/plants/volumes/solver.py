"""Time integration: implicit in conduction and convection, explicit in all that the temperatures change.

ARS(2,2,2) of Ascher, Ruuth and Spiteri (1997), Appl. Numer. Math. 25, 151, section 2.6: second order, the implicit
part L-stable, one step at a time, so that a jump of the drivers between two steps costs no order.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from twin.plants.casting import Array
from twin.plants.structure import Heat

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
