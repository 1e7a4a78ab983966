"""Designs made by hand for the tests of the selectors."""

import numpy as np

from data.arrays import Array
from features.design import Design

LENGTHS = [30, 42, 25, 37, 33]
P = 7


def stack(x: Array, y: Array, lengths: list[int], inputs: tuple[str, ...] | None = None) -> Design:
    inputs = inputs or tuple(f"t{i}" for i in range(x.shape[1]))
    ids = tuple(f"b{k}" for k in range(len(lengths)))
    time_s = np.concatenate([300.0 * np.arange(n) for n in lengths])
    return Design(inputs, "z_um", ids, x, y, time_s, np.cumsum([0, *lengths]), 300.0)


def year(seed: int = 11, p: int = P) -> tuple[Array, Array]:
    """Rises of sensors that share three slow modes, as a machine's do, and an error made from them."""
    rng = np.random.default_rng(seed)
    modes = []
    for n in LENGTHS:
        t = 300.0 * np.arange(n)
        taus = np.array([1500.0, 6000.0, 20000.0])
        modes.append((1 - np.exp(-t[:, None] / taus)) * rng.uniform(0.3, 2.0, 3) * [1, 1, rng.choice([-1, 1])])
    m = np.concatenate(modes)
    x = m @ rng.uniform(0, 6, (3, p)) + rng.normal(0, 0.1, (len(m), p))
    return x, m @ [20.0, 9.0, -12.0] + rng.normal(0, 0.5, len(m))


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
