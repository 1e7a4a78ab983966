"""A Gaussian process over whole batches: linear in columns, with a drift of its own in every batch.

    y_b(t) = x_b(t) · β + r_b(t),   β_j ~ N(0, v_j),   r_b = random walk + offset + noise, independent over batches

The drift says what no column explains: it grows with time, starts anew in every batch, and keeps one odd run from
counting as hundreds of independent rows. The gains are best linear unbiased predictions (Henderson 1975; Rasmussen
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

from features.design import Design

Array = NDArray[np.float64]
_WINDOW_S = 600.0
_MOST_WINDOWS = 1200
_WALK_PER_H, _OFFSET, _NOISE = 1.0, 1.0, 1.0  # shares of the variance that no column explains
_MISTRUST = 100.0  # variance of a batch that the others do not explain, relative to theirs


@dataclass(frozen=True)
class Windows:
    """Means over short windows of usable rows: x (N, m), y_um (N,), time_h (N,), batch (N,) rising."""

    x: Array
    y_um: Array
    time_h: Array
    batch: NDArray[np.int64]

    @classmethod
    def of(cls, design: Design, x: Array, train: Sequence[int]) -> Windows:
        """Windows of 10 min, longer where all batches together have more than 1200 of them."""
        trained = np.zeros(design.n_batches, bool)
        trained[list(train)] = True
        rows = np.flatnonzero(design.usable & trained[design.group] & np.isfinite(x).all(axis=1))
        begun = np.array([design.time_s[design.rows(k)][:1].sum() for k in range(design.n_batches)])
        since_s = (design.time_s - begun[design.group])[rows]
        recorded_s = sum(np.ptp(since_s[design.group[rows] == k]) for k in np.unique(design.group[rows]))
        window_s = max(_WINDOW_S, recorded_s / _MOST_WINDOWS)
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

    @cached_property
    def drift(self) -> Array:
        """Covariance (N, N) of what no column explains, block by block, in its own unit."""
        same = self.batch[:, None] == self.batch[None, :]
        walk = np.minimum(self.time_h[:, None], self.time_h[None, :])
        return np.where(same, _WALK_PER_H * walk + _OFFSET, 0.0) + _NOISE * np.eye(len(self.y_um))


@dataclass(frozen=True)
class BatchProcess:
    """The process for prior variances v (m,) per unit of drift, and what it says of batches that it has not seen.

    `mistrusted` names batches whose drift is let grow hundredfold: they are heard, but do not pull.
    """

    windows: Windows
    variance: Array
    mistrusted: tuple[int, ...] = ()

    @cached_property
    def _inverse(self) -> Array:
        w = self.windows
        wide = np.where(np.isin(w.batch, self.mistrusted), _MISTRUST, 1.0)
        covariance = (w.x * self.variance) @ w.x.T + w.drift * wide[:, None]
        return np.asarray(cho_solve(cho_factor(covariance, lower=True), np.eye(len(covariance))))

    @cached_property
    def _weights(self) -> Array:
        return np.asarray(self._inverse @ self.windows.y_um)

    @cached_property
    def _blocks(self) -> tuple[Array, Array]:
        """Inverse covariance cut into batch by batch (B, B, q, q), and weights (B, q), padded with unity."""
        w = self.windows
        q = int(w.counts.max(initial=0))
        inverse, weights = np.zeros((len(w.ids), len(w.ids), q, q)), np.zeros((len(w.ids), q))
        for i, (a, n) in enumerate(zip(w.borders, w.counts, strict=False)):
            weights[i, :n] = self._weights[a : a + n]
            for j, (b, m) in enumerate(zip(w.borders, w.counts, strict=False)):
                inverse[i, j, :n, :m] = self._inverse[a : a + n, b : b + m]
            inverse[i, i, range(n, q), range(n, q)] = 1.0
        return inverse, weights

    @cached_property
    def alone_um(self) -> Array:
        """Residuals (B, q) of every batch, left out alone; 0 behind its end."""
        inverse, weights = self._blocks
        every = np.arange(len(weights))
        return np.asarray(np.linalg.solve(inverse[every, every], weights[:, :, None])[:, :, 0])

    @cached_property
    def pairs_um(self) -> Array:
        """Residuals (B, B, q): at k, i those of batch i where k and i are left out."""
        inverse, weights = self._blocks
        k, i = np.triu_indices(len(weights), 1)
        both = np.block([[inverse[k, k], inverse[k, i]], [inverse[i, k], inverse[i, i]]])
        left = np.linalg.solve(both, np.hstack([weights[k], weights[i]])[:, :, None])[:, :, 0]
        q = weights.shape[1]
        out = np.zeros((len(weights), *weights.shape))
        out[i, k], out[k, i] = left[:, :q], left[:, q:]
        return out

    def gains(self, without: int | None = None) -> Array:
        """Coefficients (m,) of the columns, in µm per unit; of batch number `without` nothing is used."""
        w, weights = self.windows, self._weights
        if without is not None:
            rows = slice(w.borders[without], w.borders[without + 1])
            weights = weights - self._inverse[:, rows] @ np.linalg.solve(self._inverse[rows, rows], weights[rows])
        return np.asarray(self.variance * (w.x.T @ weights))

    def drift_variance(self) -> float:
        """The unit of drift in µm², by maximum likelihood (Rasmussen and Williams 2006, eq. 2.30 profiled)."""
        return float(self.windows.y_um @ self._weights / len(self.windows.y_um))
