"""What a plant looks like with one temperature a body: capacities, conductances and gains of the lumped network."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy import sparse

from twin.plants.casting import Array
from twin.plants.structure import Structure

LEAST_UM_PER_K = 0.05


def links_W_per_K(s: Structure) -> dict[tuple[str, str], float]:
    """Conductance between every pair of bodies that touch: watts per kelvin between their means.

    For heat that enters one body evenly and leaves the other evenly, with nothing else around.
    """
    pairs = {(one, other): s.between(one, other) for one, other in combinations(s.bodies, 2)}
    return {(a, b): _effective(s, a, b, within) for (a, b), within in pairs.items() if within is not None}


def _effective(s: Structure, one: str, other: str, within: sparse.csc_matrix) -> float:
    """One over the difference of the means that a watt through both makes."""
    cells = np.union1d(s.bodies[one].cells, s.bodies[other].cells)
    through = np.zeros(s.size)
    s.bodies[one].add(through, 1.0)
    s.bodies[other].add(through, -1.0)
    rise = np.zeros(len(cells))
    rise[1:] = np.linalg.solve(within[cells][:, cells].toarray()[1:, 1:], through[cells][1:])  # the first is held at 0
    return float(1.0 / (through[cells] @ rise))


def exposures_W_per_K(s: Structure) -> dict[tuple[str, str], float]:
    """(body, "air" or "room") -> conductance of its whole surface."""
    exposed = {(body, around): g for body in s.bodies for around, g in s.exposure_W_per_K(body).items()}
    return {where: g for where, g in exposed.items() if g > 0}


def gains_um_per_K(s: Structure, weights_um_per_K: Array) -> dict[str, float]:
    """What each body's mean rise adds to an error; what no drawing would show, below `LEAST_UM_PER_K`, left out."""
    sums = {body: float(s.share_of(body) @ weights_um_per_K) for body in s.bodies}
    return {body: total for body, total in sums.items() if abs(total) > LEAST_UM_PER_K}
