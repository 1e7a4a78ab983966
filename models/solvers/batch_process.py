"""Gaussian process over whole batches: linear in columns, with an independent drift in every batch.

    y_b(t) = x_b(t) · β + r_b(t),   β_j ~ N(0, v_j),   r_b = random walk + offset + noise, independent over batches

The drift models what no column explains: it grows with time, restarts in every batch, and correlates the rows of a
run. The gains are best linear unbiased predictions (Henderson 1975; Rasmussen
and Williams 2006, eq. 2.27 ff.). Leaving out whole batches, one or two, is closed form: with H = Cov(y)⁻¹ the
residual of a block b that is left out is H_bb⁻¹ (H y)_b (Rasmussen and Williams 2006, eq. 5.12, in blocks).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from data.arrays import Array
from features.design import Design

_WINDOW_S = 600.0
_MOST_WINDOWS = 1200
_MISTRUST = 100.0  # drift variance of a batch that the others do not explain, relative to theirs


@dataclass(frozen=True)
class Windows:
    """Means over short windows of usable rows: x (N, m), y_um (N,), time_h (N,), batch (N,) rising."""

    x: Array
    y_um: Array
    time_h: Array
    batch: NDArray[np.int64]

    @classmethod
    def of(cls, design: Design, x: Array, train: Sequence[int]) -> Windows:
        """Windows of 10 min, longer where the batches of the design have more than 1200 of them together."""
        trained = np.zeros(design.n_batches, bool)
        trained[list(train)] = True
        rows = np.flatnonzero(design.usable & trained[design.group] & np.isfinite(x).all(axis=1))
        spans_s = [design.time_s[design.rows(k)][[0, -1]] for k in range(design.n_batches)]
        since_s = (design.time_s - np.array([first for first, _ in spans_s])[design.group])[rows]
        window_s = max(_WINDOW_S, sum(last - first for first, last in spans_s) / _MOST_WINDOWS)
        label = np.stack([design.group[rows], (since_s // window_s).astype(np.int64)])
        (batch, _), which, count = np.unique(label, axis=1, return_inverse=True, return_counts=True)
        which = which.ravel()
        order = np.argsort(which, kind="stable")
        border = np.cumsum(count) - count

        def mean(values: Array) -> Array:
            total = np.add.reduceat(values[order], border, axis=0)
            return np.asarray((total.T / count).T)

        if not len(rows):
            return cls(np.empty((0, x.shape[1])), np.empty(0), np.empty(0), np.empty(0, np.int64))
        return cls(mean(x[rows]), mean(design.y_um[rows]), mean(since_s / 3600.0), batch)

    def only(self, batches: Sequence[int]) -> Windows:
        keep = np.isin(self.batch, list(batches))
        return Windows(self.x[keep], self.y_um[keep], self.time_h[keep], self.batch[keep])

    @cached_property
    def ids(self) -> NDArray[np.int64]:
        """The batches that have windows, rising, (B,)."""
        return np.unique(self.batch)

    @cached_property
    def borders(self) -> NDArray[np.int64]:
        return np.searchsorted(self.batch, np.append(self.ids, self.ids.max(initial=0) + 1))

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        return np.diff(self.borders)

    def drift(self, steady: float) -> Array:
        """Covariance (N, N) of what no column explains, block by block, in units of a random walk's after an hour.

        Offset and noise have `steady` units each.
        """
        same = self.batch[:, None] == self.batch[None, :]
        walk = np.minimum(self.time_h[:, None], self.time_h[None, :])
        return np.where(same, walk + steady, 0.0) + steady * np.eye(len(self.y_um))


@dataclass(frozen=True)
class BatchProcess:
    """Predictions of the process for B batches left out.

    gains (m,), µm per unit of each column; gains_without (B, m), without one batch; alone_um (B, q) residuals of every
    batch, left out alone, 0 behind its end; pairs_um (B, B, q), at k, i those of batch i where k and i are left out.
    """

    gains: Array
    gains_without: Array
    alone_um: Array
    pairs_um: Array

    @classmethod
    def of(cls, windows: Windows, variance: Array, steady: float = 1.0, mistrusted: Sequence[int] = ()) -> BatchProcess:
        """Pool all batches, for prior variances (m,) in units of the drift's.

        `mistrusted` names batches whose drift variance is let grow hundredfold: they have little weight.
        """
        w = windows
        wide = np.where(np.isin(w.batch, list(mistrusted)), _MISTRUST, 1.0)
        covariance = (w.x * variance) @ w.x.T + w.drift(steady) * wide[:, None]
        inverse = cho_solve(cho_factor(covariance, lower=True), np.eye(len(covariance)))
        weights = inverse @ w.y_um
        inverse_blocks, weight_blocks = _blocks(w, inverse, weights)
        alone_um = _solved(inverse_blocks[range(len(w.ids)), range(len(w.ids))], weight_blocks)
        gains = variance * (w.x.T @ weights)
        spans = list(zip(w.borders[:-1], w.counts, strict=True))
        pulled = [w.x.T @ (inverse[:, a : a + n] @ alone_um[i, :n]) for i, (a, n) in enumerate(spans)]
        return cls(gains, gains - variance * np.array(pulled), alone_um, _pairs(inverse_blocks, weight_blocks))


def _blocks(w: Windows, inverse: Array, weights: Array) -> tuple[Array, Array]:
    """Inverse covariance cut into batch by batch (B, B, q, q), and weights (B, q), padded with unity."""
    n_batches, q = len(w.ids), int(w.counts.max(initial=0))
    padded, short = np.zeros((n_batches, n_batches, q, q)), np.zeros((n_batches, q))
    for i, (a, n) in enumerate(zip(w.borders, w.counts, strict=False)):
        short[i, :n] = weights[a : a + n]
        for j, (b, m) in enumerate(zip(w.borders, w.counts, strict=False)):
            padded[i, j, :n, :m] = inverse[a : a + n, b : b + m]
        padded[i, i, range(n, q), range(n, q)] = 1.0
    return padded, short


def _pairs(inverse: Array, weights: Array) -> Array:
    k, i = np.triu_indices(len(weights), 1)
    both = np.block([[inverse[k, k], inverse[k, i]], [inverse[i, k], inverse[i, i]]])
    left = _solved(both, np.hstack([weights[k], weights[i]]))
    q = weights.shape[1]
    out = np.zeros((len(weights), *weights.shape))
    out[i, k], out[k, i] = left[:, :q], left[:, q:]
    return out


def _solved(blocks: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(blocks, right[:, :, None])[:, :, 0])


@dataclass(frozen=True)
class LeftOut:
    """C = (K + I)⁻¹ and α = C y over G groups of m rows; K and y are 0 on padding.

    Leaving out the rows g: the residual is C_gg⁻¹ α_g, its covariance C_gg⁻¹. With f left out too, C and α are first
    rid of f by elimination. Source: S. Sundararajan and S. Keerthi, Neural Computation 13 (2001), for single rows; C.
    Rasmussen and C. Williams (2006), eqs. 5.10 to 5.12.
    """

    blocks: Array  # (G, G, m, m)
    alpha: Array  # (G, m)

    @classmethod
    def of(cls, inverse: Array, y: Array, m: int) -> LeftOut:
        n_groups = len(y) // m
        blocks = inverse.reshape(n_groups, m, n_groups, m).transpose(0, 2, 1, 3)
        return cls(blocks, (inverse @ y).reshape(n_groups, m))

    def alone(self) -> tuple[Array, Array]:
        """Residual and variance (G, m) of each group left out by itself."""
        return _residual_and_variance(np.einsum("ggij->gij", self.blocks), self.alpha)

    def without(self, f: int) -> tuple[Array, Array]:
        """Residual and variance (G, m) of each group when it and group f are left out; of f itself 0 and 1."""
        own = np.linalg.inv(self.blocks[f, f])
        across = self.blocks[:, f] @ own  # C_gf C_ff⁻¹
        rest = np.einsum("ggij->gij", self.blocks) - across @ self.blocks[f]
        alpha = self.alpha - across @ self.alpha[f]
        rest[f], alpha[f] = np.eye(rest.shape[1]), 0.0
        return _residual_and_variance(rest, alpha)


def _residual_and_variance(precision: Array, alpha: Array) -> tuple[Array, Array]:
    covariance = np.linalg.inv(precision)
    return (covariance @ alpha[:, :, None])[:, :, 0], np.einsum("gii->gi", covariance).copy()
