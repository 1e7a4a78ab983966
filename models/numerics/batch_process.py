"""Gaussian process over whole batches: linear in columns, with an independent drift in every batch.

    y_b(t) = x_b(t) · β + r_b(t),   β_j ~ N(0, v_j),   r_b = random walk + offset + noise, independent over batches

The drift models what no column explains: it grows with time, restarts in every batch, and correlates the rows of a
run. The gains are best linear unbiased predictions (Henderson 1975; Rasmussen
and Williams 2006, eq. 2.27 ff.). Leaving out whole batches, one or two, is closed form: with H = Cov(y)⁻¹ the
residual of a block b that is left out is H_bb⁻¹ (H y)_b (Rasmussen and Williams 2006, eq. 5.12, in blocks).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, lapack, solve_triangular

from data.arrays import Array
from features.design import Design

_WINDOW_S = 600.0
_MOST_WINDOWS = 1200
INVERSE = 5.0  # cost of an inverse of N rows over N³, in units of a solved system of m columns over m³
_MISTRUST = 100.0  # drift variance of a batch that the others do not explain, relative to theirs


@dataclass(frozen=True)
class Windows:
    """Means over short windows of usable rows: x (N, m), y_um (N,), time_h (N,), batch (N,) rising."""

    x: Array
    y_um: Array
    time_h: Array
    batch: NDArray[np.int64]
    _all: Windows | None = field(default=None, repr=False)  # those of more batches, that these are some of

    @classmethod
    def of(cls, design: Design, x: Array, train: Sequence[int]) -> Windows:
        """Means of x (n, p) and errors over windows of 10 min, longer where the design has more than 1200 windows."""
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
        return Windows(self.x[keep], self.y_um[keep], self.time_h[keep], self.batch[keep], self)

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
    def padded(self) -> tuple[Array, Array]:
        """x (B, q, m) and y_um (B, q) batch by batch, 0 behind a batch's end."""
        place = np.arange(len(self.batch)) - np.repeat(self.borders[:-1], self.counts)
        at = np.repeat(np.arange(len(self.ids)), self.counts), place
        x = np.zeros((len(self.ids), int(self.counts.max(initial=0)), self.x.shape[1]))
        y_um = np.zeros(x.shape[:2])
        x[at], y_um[at] = self.x, self.y_um
        return x, y_um

    @cached_property
    def _whitened(self) -> dict[float, tuple[Array, Array]]:
        return {}

    @cached_property
    def _pooled(self) -> dict[tuple[float, bytes, bytes], Pooled]:
        return {}

    def whitened_sums(self, steady: float) -> tuple[Array, Array]:
        """xᵀ D⁻¹ x (B, m, m) and xᵀ D⁻¹ y (B, m) of every batch, D its own block of `drift`."""
        if steady not in self._whitened:
            if self._all is not None:
                some = np.isin(self._all.ids, self.ids)
                xx, xy = (sums[some] for sums in self._all.whitened_sums(steady))
            else:
                xx, xy = self._summed(steady)
            self._whitened[steady] = xx, xy
        return self._whitened[steady]

    def _summed(self, steady: float) -> tuple[Array, Array]:
        m = self.x.shape[1]
        xx, xy = np.empty((len(self.ids), m, m)), np.empty((len(self.ids), m))
        for i, (a, n) in enumerate(zip(self.borders, self.counts, strict=False)):
            rows = slice(a, a + n)
            own = Windows(self.x[rows], self.y_um[rows], self.time_h[rows], self.batch[rows])
            factor = np.linalg.cholesky(own.drift(steady))
            table = solve_triangular(factor, np.column_stack([own.x, own.y_um]), lower=True)
            xx[i], xy[i] = table[:, :m].T @ table[:, :m], table[:, :m].T @ table[:, m]
        return xx, xy

    def pooled(self, steady: float, active: NDArray[np.int64], wide: Array) -> Pooled:
        """The whitened sums of some columns, those of a batch over its drift variance `wide` (B,)."""
        key = steady, active.tobytes(), wide.tobytes()
        if key not in self._pooled:
            xx, xy = self.whitened_sums(steady)
            if len(active) < xx.shape[1]:
                xx, xy = xx[:, active[:, None], active], xy[:, active]
            self._pooled[key] = Pooled(xx / wide[:, None, None], xy / wide[:, None])
        return self._pooled[key]

    def drift(self, steady: float) -> Array:
        """Covariance (N, N) of what no column explains, block by block, in units of a random walk's after an hour.

        Offset and noise have `steady` units each.
        """
        same = self.batch[:, None] == self.batch[None, :]
        walk = np.minimum(self.time_h[:, None], self.time_h[None, :])
        return np.where(same, walk + steady, 0.0) + steady * np.eye(len(self.y_um))


@dataclass(frozen=True)
class Pooled:
    """xᵀx (B, a, a) and xᵀy (B, a) of every batch, and their sums over sets of batches.

    A sum is of what comes before a batch and what comes after it: subtracting a batch would cancel digits.
    """

    xx: Array
    xy: Array

    @cached_property
    def whole(self) -> tuple[Array, Array]:
        """Over all batches, (1, …) each."""
        return self.xx.sum(axis=0)[None], self.xy.sum(axis=0)[None]

    @cached_property
    def _last(self) -> dict[int | None, tuple[Array, Array]]:
        return {}

    def without(self, k: int | None = None) -> tuple[Array, Array]:
        """Over all but one in turn, (B, …) each, k missing from all; place k is without k alone.

        Kept for the next call with the same k: settings of the prior share them.
        """
        if k not in self._last:
            self._last.clear()
            self._last[k] = _all_but_one(self.xx, k), _all_but_one(self.xy, k)
        return self._last[k]


def _all_but_one(each: Array, k: int | None) -> Array:
    """Sums over the first axis without each place in turn, and without k."""
    own = each
    if k is not None:
        own = each.copy()
        own[k] = 0.0
    out = np.zeros_like(own)
    for i in range(1, len(own)):
        np.add(out[i - 1], own[i - 1], out=out[i])
    after = np.zeros_like(own[0])
    for i in range(len(own) - 2, -1, -1):
        after += own[i + 1]
        out[i] += after
    return out


def _ridge(xx: Array, xy: Array, precision: Array) -> Array:
    """Solutions (S, a) of (xx + diag(precision)) β = xy; Cholesky's error does not depend on the columns' units."""
    out, step = np.empty_like(xy), len(precision) + 1
    for i, (matrix, right) in enumerate(zip(xx, xy, strict=True)):
        own = matrix.copy()
        own.flat[::step] += precision
        _, solved, info = lapack.dposv(own.T, right, lower=1, overwrite_a=1)
        if info != 0:  # beyond rounding; elimination with pivots still gives a finite answer
            own = matrix.copy()
            own.flat[::step] += precision
            solved = np.linalg.solve(own, right)
        out[i] = np.ravel(solved)
    return out


class BatchProcess(ABC):
    """Predictions of the process from all batches, or with one or two of its B batches left out.

    A batch that is left out is given by its place in `windows.ids`. Results are kept, so that folds share them.
    """

    @classmethod
    def of(cls, windows: Windows, variance: Array, steady: float = 1.0, mistrusted: Sequence[int] = ()) -> BatchProcess:
        """Pool all batches, for prior variances (m,) in units of the drift's; columns of variance 0 take no part.

        `mistrusted` names batches whose drift variance is let grow hundredfold: they have little weight. Of two ways
        to the same result the cheaper one is taken: a system per pair of batches (B² m³), or one inverse of all
        windows (N³).
        """
        wide = np.where(np.isin(windows.ids, list(mistrusted)), _MISTRUST, 1.0)
        pairs = len(windows.ids) ** 2 * float(np.count_nonzero(variance)) ** 3
        way = ByColumns if pairs < INVERSE * float(len(windows.y_um)) ** 3 else ByRows
        return way(windows, variance, steady, wide)

    @abstractmethod
    def gains(self, without: int | None = None) -> Array:
        """(m,), µm per unit of each column, from all batches or from all but one."""

    @abstractmethod
    def left_um(self, without: int | None = None) -> Array:
        """Residuals (B, q) of every batch when it is left out, alone or with `without`; 0 behind its end.

        Those of `without` itself are 0.
        """


@dataclass(frozen=True)
class ByColumns(BatchProcess):
    """Posterior of the gains from sums over the batches that are left in.

    With the rows of a batch whitened by its drift, the gains of a set of batches are (V⁻¹ + Σ xᵀx)⁻¹ Σ xᵀy, V the prior
    variances. Processes of the same windows share the sums, see `Pooled`.
    """

    windows: Windows
    variance: Array
    steady: float
    wide: Array  # (B,) drift variance of each batch

    def gains(self, without: int | None = None) -> Array:
        out = np.zeros(len(self.variance))
        if without is None:
            out[self._active] = self._solved(*self._pooled.whole)[0]
            return out
        if without not in self._gains:
            xx, xy = self._pooled.without(without)
            self._gains[without] = self._solved(xx[without : without + 1], xy[without : without + 1])[0]
        out[self._active] = self._gains[without]
        return out

    def left_um(self, without: int | None = None) -> Array:
        if without is None:
            x, y_um = self._padded
            return y_um - (x @ self._solved(*self._pooled.without())[:, :, None])[:, :, 0]
        self._leave_out(without)
        return self._pairs_um[without]

    @cached_property
    def _active(self) -> NDArray[np.int64]:
        return np.flatnonzero(self.variance)

    @cached_property
    def _padded(self) -> tuple[Array, Array]:
        x, y_um = self.windows.padded
        return (x if len(self._active) == x.shape[2] else x[:, :, self._active]), y_um

    @property
    def _pooled(self) -> Pooled:
        return self.windows.pooled(self.steady, self._active, self.wide)

    def _solved(self, xx: Array, xy: Array) -> Array:
        """Gains (S, a) from the sums over S sets of batches."""
        return _ridge(xx, xy, 1.0 / self.variance[self._active])

    @cached_property
    def _gains(self) -> dict[int, Array]:
        return {}

    @cached_property
    def _pairs_um(self) -> Array:
        return np.zeros((len(self.wide), *self.windows.padded[1].shape))

    @cached_property
    def _left(self) -> set[int]:
        return set()

    def _leave_out(self, k: int) -> None:
        """Fill the residuals of the pairs of k that no other batch has filled: the gains of a pair serve both."""
        if k in self._left:
            return
        others = np.array([i for i in range(len(self.wide)) if i != k and i not in self._left], np.int64)
        self._left.add(k)
        (xx, xy), (x, y_um) = self._pooled.without(k), self._padded
        gains = self._solved(xx[others], xy[others])
        self._pairs_um[k, others] = y_um[others] - (x[others] @ gains[:, :, None])[:, :, 0]
        self._pairs_um[others, k] = y_um[k] - gains @ x[k].T


@dataclass(frozen=True)
class ByRows(BatchProcess):
    """The inverse covariance of all windows, whose blocks give what is left out."""

    windows: Windows
    variance: Array
    steady: float
    wide: Array  # (B,) drift variance of each batch

    def gains(self, without: int | None = None) -> Array:
        w, (inverse, weights) = self.windows, self._inverse
        whole = self.variance * (w.x.T @ weights)
        if without is None:
            return whole
        a, n = w.borders[without], w.counts[without]
        return np.asarray(whole - self.variance * (w.x.T @ (inverse[:, a : a + n] @ self._alone_um[without, :n])))

    def left_um(self, without: int | None = None) -> Array:
        if without is None:
            return self._alone_um
        if without not in self._left_um:
            self._left_um[without] = self._parts.without(without)[0]
        return self._left_um[without]

    @cached_property
    def _inverse(self) -> tuple[Array, Array]:
        """Inverse covariance (N, N), and the weights (N,) of the windows."""
        w = self.windows
        drift = w.drift(self.steady) * np.repeat(self.wide, w.counts)[:, None]
        covariance = (w.x * self.variance) @ w.x.T + drift
        inverse = cho_solve(cho_factor(covariance, lower=True), np.eye(len(covariance)))
        return inverse, inverse @ w.y_um

    @cached_property
    def _parts(self) -> LeftOut:
        """Batch by batch, padded with unity."""
        w, (inverse, weights) = self.windows, self._inverse
        at = np.repeat(np.arange(len(w.ids)), w.counts)
        place = np.arange(len(at)) - w.borders[at]
        n_batches, q = len(w.ids), int(w.counts.max(initial=0))
        blocks, alpha = np.zeros((n_batches, n_batches, q, q)), np.zeros((n_batches, q))
        behind, own = np.nonzero(np.arange(q) >= w.counts[:, None])
        blocks[behind, behind, own, own] = 1.0
        blocks[at[:, None], at, place[:, None], place] = inverse
        alpha[at, place] = weights
        return LeftOut(blocks, alpha)

    @cached_property
    def _alone_um(self) -> Array:
        return self._parts.alone()[0]

    @cached_property
    def _left_um(self) -> dict[int, Array]:
        return {}


@dataclass(frozen=True)
class LeftOut:
    """C, the inverse of a covariance, and α = C y over G groups of m rows; on padding C is that of unity, α is 0.

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
