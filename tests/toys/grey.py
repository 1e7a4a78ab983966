"""Grey models by hand, and rises to run them on."""

import numpy as np


def literal_run(x, a, b, first=0.0):
    """x̂⁰(k) = (Σ b X(k) − a X̂(k−1))/(1 + a/2), sums and all, from a first value."""
    s = np.cumsum(x @ b)
    out = np.full(len(x), float(first))
    total = first
    for k in range(1, len(x)):
        out[k] = (s[k] - a * total) / (1 + a / 2)
        total += out[k]
    return out


def rises(n, p, rng):
    hours = np.arange(n)[:, None] / 12
    return rng.uniform(5, 15, p) * (1 - np.exp(-hours / rng.uniform(0.3, 4, p))) + np.sin(hours * rng.uniform(1, 4, p))
