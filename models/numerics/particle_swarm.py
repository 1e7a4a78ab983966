"""Particle swarm minimisation inside a box."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data.arrays import Array

_INERTIA, _PULL = 0.7298, 1.49618  # constriction that converges: Clerc and Kennedy (2002), φ = 4.1


def least(
    fitness: Callable[[Array], Array], low: Array, high: Array, seed: int, particles: int = 16, steps: int = 25
) -> tuple[Array, float]:
    """Best point (d,) and its value, of all points (P, d) that `fitness` evaluated, one value each (P,).

    Each particle is drawn to its own best point and to the swarm's; at a wall of the box low … high (d,) it stops.
    A value that is not a number counts as infinite. The same seed gives the same points.

    Source: J. Kennedy and R. Eberhart, Particle swarm optimization (1995), with the constriction of M. Clerc and
    J. Kennedy, IEEE Trans. Evolutionary Computation 6 (2002).
    """
    rng = np.random.default_rng(seed)
    low, high = np.asarray(low, float), np.asarray(high, float)
    at = low + (high - low) * rng.random((particles, len(low)))
    speed = np.zeros_like(at)
    own, own_value = at.copy(), np.full(particles, np.inf)
    for _ in range(steps):
        value = fitness(at)
        better = value < own_value  # false for a value that is not a number
        own[better], own_value[better] = at[better], value[better]
        best = own[np.argmin(own_value)]
        pull = rng.random((2, *at.shape)) * _PULL
        speed = _INERTIA * speed + pull[0] * (own - at) + pull[1] * (best - at)
        moved = np.clip(at + speed, low, high)
        speed[moved != at + speed] = 0.0
        at = moved
    i = int(np.argmin(own_value))
    return own[i], float(own_value[i])
