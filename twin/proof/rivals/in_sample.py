"""How well a fit explains the very recordings that it was fitted to, and what a candidate adds to that."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import cho_solve

from twin.calibration.fit_problem import Array
from twin.diagnosis.scoring.evidence import ROUNDS, Evidence


def in_sample_score(evidence: Evidence, targets: Sequence[Array] | None = None) -> Array:
    """`Evidence.base_score` (R,) with the residuals of the whole fit in place of those of batches left out."""
    targets = evidence.targets if targets is None else targets
    left = evidence.density(np.nan_to_num(evidence.mean_squares(evidence.left_out(targets))))
    within = evidence.density(np.nan_to_num(evidence.mean_squares(residuals(evidence, targets))))
    return np.asarray(evidence.base_score(targets) - left + within)


def in_sample_gains(evidence: Evidence, targets: Sequence[Array], columns: Sequence[int]) -> Array:
    """Rise of the density (R, C) where each column has its best amplitude within bounds, channels reweighted."""
    at = list(columns)
    inside = residuals(evidence, targets)
    n, channels = inside[0].shape[1], len(evidence.rows)
    own, cross, square = np.zeros((n, channels)), np.zeros((n, channels, len(at))), np.zeros((channels, len(at)))
    for b, e, beyond in zip(evidence.batches, inside, evidence.beyond, strict=True):
        for c, rows in b.slices:
            own[:, c] += (e[rows] ** 2).sum(axis=0)
            cross[:, c] += e[rows].T @ beyond[rows][:, at]
            square[c] += (beyond[rows][:, at] ** 2).sum(axis=0)
    least = np.maximum(evidence.rows * evidence.weight, 1e-300)
    low, high = evidence.low[at], evidence.high[at]
    g = np.clip(cross.sum(axis=1) / np.maximum(square.sum(axis=0), 1e-300), low, high)
    for _ in range(ROUNDS):
        weight = evidence.rows[:, None] / np.maximum(_squares(g, own, cross, square), least[:, None])
        g = np.einsum("rkc,rkc->rc", weight, cross) / np.maximum(np.einsum("rkc,kc->rc", weight, square), 1e-300)
        g = np.clip(g, low, high)
    after = np.moveaxis(_squares(g, own, cross, square) / least[:, None], 1, -1)
    return np.asarray(evidence.density(after) - evidence.density(own / least)[:, None])


def residuals(evidence: Evidence, targets: Sequence[Array]) -> list[Array]:
    """Of the whole fit, (n_b, R)."""
    total = np.sum([b.jacobian.T @ t for b, t in zip(evidence.batches, targets, strict=True)], axis=0)
    z = cho_solve(evidence.factor, total)
    return [t - b.jacobian @ z for b, t in zip(evidence.batches, targets, strict=True)]


def _squares(g: Array, own: Array, cross: Array, square: Array) -> Array:
    return np.asarray(np.maximum(own[..., None] - 2.0 * g[:, None] * cross + g[:, None] ** 2 * square, 0.0))
