"""What a plant looks like with one temperature a body: capacities, conductances and gains of the lumped network."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from twin.plants.casting import Array, Cells
from twin.plants.structure import Structure


def links_W_per_K(s: Structure) -> dict[tuple[str, str], float]:
    """Conductance between every pair of bodies that touch: watts per kelvin between their means.

    For heat that enters one body evenly and leaves the other evenly, with nothing else around.
    """
    solid = s.surfaces == 0
    out = {}
    for one, other in combinations(s.bodies, 2):
        a, b = s.bodies[one], s.bodies[other]
        cells = np.concatenate([a, b])
        number = np.full(s.size, -1)
        number[cells] = np.arange(len(cells))
        i, j, g = number[s.one[solid]], number[s.other[solid]], s.between_W_per_K[solid]
        within = (i >= 0) & (j >= 0)
        i, j, g = i[within], j[within], g[within]
        if np.any((i < len(a)) != (j < len(a))):
            out[one, other] = _effective(i, j, g, len(a), len(b))
    return out


def _effective(i: Cells, j: Cells, g: Array, n_one: int, n_other: int) -> float:
    n = n_one + n_other
    laplacian = np.zeros((n, n))
    np.add.at(laplacian, (i, i), g)
    np.add.at(laplacian, (j, j), g)
    np.add.at(laplacian, (i, j), -g)
    np.add.at(laplacian, (j, i), -g)
    heat = np.concatenate([np.full(n_one, 1.0 / n_one), np.full(n_other, -1.0 / n_other)])
    rise = np.zeros(n)
    rise[1:] = np.linalg.solve(laplacian[1:, 1:], heat[1:])  # the first cell is held at 0
    return float(1.0 / (rise[:n_one].mean() - rise[n_one:].mean()))


def exposures_W_per_K(s: Structure) -> dict[tuple[str, str], float]:
    """(body, "air" or "room") -> conductance of its whole surface."""
    out = {}
    for name, cells in s.bodies.items():
        for around, conductance in (("air", s.air_W_per_K), ("room", s.room_W_per_K)):
            total = float(conductance[cells].sum())
            if total > 0:
                out[name, around] = total
    return out


def gains_um_per_K(s: Structure, weights_um_per_K: Array) -> dict[str, float]:
    """What each body's mean rise adds to an error."""
    sums = {name: float(weights_um_per_K[cells].sum()) for name, cells in s.bodies.items()}
    return {name: total for name, total in sums.items() if total}
