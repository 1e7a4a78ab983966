"""Least squares under the covariance, with directions and the batches' own unknowns integrated out.

Both act linearly and are linearised once, at the baseline. What is left of a model is a matrix of whitened columns;
evidence, folds and steps follow from its Gram matrices (the arrow of `twin.calibration.arrow`, one border more).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from data.arrays import Array
from diagnosis.fitting.covariance import Covariance


@dataclass(frozen=True, eq=False)
class Grams:
    """Per batch products of m whitened columns with each other, (B, m, m), and with the K directions, (B, K, m)."""

    inner: Array
    cross: Array

    def rescaled(self, scale: Array) -> Grams:
        """The same with directions times `scale` (K,)."""
        return Grams(self.inner, self.cross * scale[:, None])


class Marginal:
    """Rows of all batches under a covariance.

    Args:
        own: by batch the derivatives (n_b, q_b) by its own unknowns, of prior N(0, 1).
        at: their values (q_b,) where they were linearised.
    """

    def __init__(self, covariance: Covariance, own: Sequence[Array], at: Sequence[Array]) -> None:
        self.covariance = covariance
        self.offset = [n @ v for n, v in zip(own, at, strict=True)]
        self._own = [covariance.white(b, n) for b, n in enumerate(own)]
        self._root = [np.linalg.cholesky(n.T @ n + np.eye(n.shape[1])) for n in self._own]
        self._along = [covariance.white(b, d) for b, d in enumerate(covariance.directions)]
        self._taken = [self._beyond(b, d) for b, d in enumerate(self._along)]
        self.directions = np.stack(
            [d.T @ d - t.T @ t for d, t in zip(self._along, self._taken, strict=True)]
        )  # (B, K, K)
        self._volume = np.array([2.0 * float(np.log(np.diag(r)).sum()) for r in self._root])

    def rescaled(self, scale: Array) -> Marginal:
        """The same with directions times `scale` (K,)."""
        out = copy(self)
        out.covariance = replace(self.covariance, directions=tuple(d * scale for d in self.covariance.directions))
        out._along, out._taken = [d * scale for d in self._along], [d * scale for d in self._taken]
        out.directions = self.directions * scale * scale[:, None]
        for name in ("factor", "folds"):
            out.__dict__.pop(name, None)
        return out

    @property
    def batches(self) -> int:
        return len(self._own)

    def white(self, rows: Sequence[Array]) -> list[Array]:
        """Rows (n_b, …) of every batch under the blocks alone."""
        return [self.covariance.white(b, r) for b, r in enumerate(rows)]

    def grams(self, columns: Sequence[Array]) -> Grams:
        """Of whitened columns (n_b, m) of every batch."""
        inner, cross = [], []
        for b, x in enumerate(columns):
            taken = self._beyond(b, x)
            inner.append(x.T @ x - taken.T @ taken)
            cross.append(self._along[b].T @ x - self._taken[b].T @ taken)
        return Grams(np.stack(inner), np.stack(cross))

    def products(self, columns: Sequence[Array], others: Sequence[Array]) -> tuple[Array, Array, Array]:
        """Of few columns (n_b, m) with many (n_b, C), summed over the batches: (m, C), with the directions (K, C), and
        the many with themselves (C,)."""
        mixed: Any = 0.0
        cross: Any = 0.0
        squares: Any = 0.0
        for b, (x, y) in enumerate(zip(columns, others, strict=True)):
            one, other = self._beyond(b, x), self._beyond(b, y)
            mixed = mixed + x.T @ y - one.T @ other
            cross = cross + self._along[b].T @ y - self._taken[b].T @ other
            squares = squares + np.einsum("nc,nc->c", y, y) - np.einsum("nc,nc->c", other, other)
        return np.asarray(mixed), np.asarray(cross), np.asarray(squares)

    def _beyond(self, b: int, rows: Array) -> Array:
        return solve_triangular(self._root[b], self._own[b].T @ rows, lower=True)

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """Cholesky of the directions' information and prior in all batches."""
        return self._factor(np.ones(self.batches, bool))

    @cached_property
    def folds(self) -> list[tuple[Array, bool]]:
        """The same without each batch in turn."""
        every = ~np.eye(self.batches, dtype=bool)
        return [self._factor(kept) for kept in every]

    def _factor(self, kept: Array) -> tuple[Array, bool]:
        information = self.directions[kept].sum(axis=0)
        return cho_factor(information + np.eye(len(information)), lower=True)

    def reduced(self, grams: Grams, without: int | None = None) -> Array:
        """Products (m, m) of the columns with the directions integrated out, in all batches or without one."""
        inner, cross, factor = grams.inner.sum(axis=0), grams.cross.sum(axis=0), self.factor
        if without is not None:
            inner, cross, factor = inner - grams.inner[without], cross - grams.cross[without], self.folds[without]
        return np.asarray(inner - cross.T @ cho_solve(factor, cross))

    def log_evidence(self, grams: Grams, without: int | None = None) -> float:
        """Log marginal likelihood, up to a constant, of columns [model (p), target]: parameters of prior N(0, 1)
        integrated out; in all batches or without one."""
        c = self.reduced(grams, without)
        root = np.linalg.cholesky(c[:-1, :-1] + np.eye(len(c) - 1))
        fitted = solve_triangular(root, c[:-1, -1], lower=True)
        factor = self.factor if without is None else self.folds[without]
        volume = self._volume + self.covariance.log_det
        logs = 2.0 * float(np.log(np.diag(root)).sum() + np.log(np.diag(factor[0])).sum()) + float(volume.sum())
        if without is not None:
            logs -= float(volume[without])
        return -0.5 * (float(c[-1, -1] - fitted @ fitted) + logs)

    def foretold(self, grams: Grams) -> Array:
        """Log density (B,) of every batch, predicted from all others."""
        whole = self.log_evidence(grams)
        return np.array([whole - self.log_evidence(grams, b) for b in range(self.batches)])

    def optimum(self, grams: Grams, without: int | None = None) -> Array:
        """z (p,) of columns [model (p), target]."""
        c = self.reduced(grams, without)
        return np.asarray(np.linalg.solve(c[:-1, :-1] + np.eye(len(c) - 1), c[:-1, -1]), float)

    def leftover(self, columns: Sequence[Array], z: Array, grams: Grams) -> list[Array]:
        """Whitened rows (n_b,) left of the target in columns [model (p), target] at z and at the likeliest directions
        and own unknowns."""
        aim = np.append(-z, 1.0)
        along = cho_solve(self.factor, grams.cross.sum(axis=0) @ aim)
        out = []
        for b, x in enumerate(columns):
            rest = x @ aim - self._along[b] @ along
            own = solve_triangular(self._root[b], self._beyond(b, rest), lower=True, trans="T")
            out.append(rest - self._own[b] @ own)
        return out
