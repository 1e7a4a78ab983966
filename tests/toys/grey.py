"""Grey models by hand, and rises to run them on."""

from __future__ import annotations

import numpy as np

from data.arrays import Array


def literal_run(x: Array, a: float, b: Array, first: float = 0.0) -> Array:
    """x̂⁰(k) = (Σ b X(k) − a X̂(k−1))/(1 + a/2), sums and all, from a first value."""
    s = np.cumsum(x @ b)
    out = np.full(len(x), float(first))
    total = first
    for k in range(1, len(x)):
        out[k] = (s[k] - a * total) / (1 + a / 2)
        total += out[k]
    return out


def rises(n: int, p: int, rng: np.random.Generator) -> Array:
    hours = np.arange(n)[:, None] / 12
    warm = rng.uniform(5, 15, p) * (1 - np.exp(-hours / rng.uniform(0.3, 4, p)))
    return np.asarray(warm + np.sin(hours * rng.uniform(1, 4, p)))
