"""Fuzzy c-means of curves by their inner products alone, several starts and numbers of clusters at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_NUMBERS_AT_ONCE = 1_000_000  # in a stack of memberships
_SMALLEST_SQUARE = 1e-12  # of a distance, for curves of unit size: nearer is the centre itself


def fuzzy_c_means(
    products: Array,
    numbers: Sequence[int],
    starts: int,
    seed: int,
    fuzziness: float = 2.0,
    iterations: int = 300,
    tolerance: float = 1e-6,
) -> dict[int, Array]:
    """Memberships u (c, p) of p curves in c clusters for every c of `numbers`: of all starts the least Σ u^m d².

    A centre is a weighted mean of the curves, `v_c = Σ_i u_ci^m x_i / Σ_i u_ci^m`, so its distances follow from the
    curves' inner products (p, p) whatever their length. Then `u_ci = d_ci^(−2/(m−1)) / Σ_c d_ci^(−2/(m−1))`, in turn
    until no membership moves by more than `tolerance`. A start takes c curves, drawn by the seed, as centres; all
    starts of all c run as one stack, and each stops by itself.

    Source: J. Bezdek (1981), Pattern Recognition with Fuzzy Objective Function Algorithms, ch. 3.
    """
    p = len(products)
    rng = np.random.default_rng(seed)
    drawn = np.array([rng.permutation(p) for _ in range(starts)])
    out: dict[int, Array] = {}
    left = sorted(numbers)
    while left:
        at_once = max(1, _NUMBERS_AT_ONCE // (starts * p * left[-1]))
        left, now = left[:-at_once], left[-at_once:]
        membership, cost = _converged(products, np.repeat(now, starts), np.tile(drawn, (len(now), 1)),
                                      fuzziness, iterations, tolerance)  # fmt: skip
        best = np.argmin(cost.reshape(len(now), starts), axis=1) + starts * np.arange(len(now))
        out |= {c: membership[t, :c] for c, t in zip(now, best, strict=True)}
    return out


def _converged(
    products: Array,
    number: NDArray[np.int64],
    drawn: NDArray[np.int64],
    fuzziness: float,
    iterations: int,
    tolerance: float,
) -> tuple[Array, Array]:
    """Memberships (T, c, p) of T runs of `number` clusters each, zero beyond them, and their objectives (T,)."""
    p, most = len(products), int(number.max())
    present = np.arange(most) < number[:, None]
    weight = np.eye(p)[drawn[:, :most]] * present[:, :, None]
    membership, cost = np.zeros_like(weight), np.zeros(len(number))
    running = np.arange(len(number))
    for _ in range(iterations):
        if not len(running):
            break
        there = present[running, :, None]
        square = _squares(weight[running], products)
        closeness = there * square ** (-1.0 / (fuzziness - 1.0))
        u = closeness / closeness.sum(axis=1, keepdims=True)
        raised = u**fuzziness
        moved = np.abs(u - membership[running]).max(axis=(1, 2))
        membership[running] = u
        cost[running] = (raised * square).sum(axis=(1, 2))
        weight[running] = raised / np.where(there, raised.sum(axis=2, keepdims=True), 1.0)
        running = running[moved > tolerance]
    return membership, cost


def _squares(weight: Array, products: Array) -> Array:
    """Squared distances (T, c, p) of centres Σ_i w_i x_i, weight (T, c, p), from all curves."""
    across = weight @ products
    own = np.einsum("tcp,tcp->tc", across, weight)
    square: Array = np.maximum(products.diagonal() - 2.0 * across + own[..., None], _SMALLEST_SQUARE)
    return square
