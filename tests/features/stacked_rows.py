"""Designs made by hand for the tests of the selectors."""

import numpy as np

from data.arrays import Array
from features.design import Design
from tests.toys.runs import LENGTHS, P, stack, year

__all__ = ["LENGTHS", "P", "chain", "orthonormal", "stack", "year"]


def orthonormal(n: int, p: int, seed: int = 0) -> Array:
    """p uncorrelated sequences of mean 0 and equal length, (n, p)."""
    rng = np.random.default_rng(seed)
    raw = np.column_stack([np.ones(n), rng.normal(size=(n, p))])
    return np.linalg.qr(raw)[0][:, 1:]


def chain() -> Design:
    """Two groups with |corr| 0.6 (t0 t1 | t3 t4), a sensor half-way between (t2) and an odd one (t5)."""
    q = orthonormal(sum(LENGTHS), 5, seed=5)
    a, b = q[:, 0], 0.6 * q[:, 0] + 0.8 * q[:, 1]
    x = np.column_stack([a, a + 0.2 * q[:, 2], a + b, b + 0.2 * q[:, 3], b, 0.4 * a + q[:, 4]])
    return stack(x, a - b, LENGTHS)
