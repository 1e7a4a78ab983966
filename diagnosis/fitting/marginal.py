"""Least squares under the covariance, with directions and the batches' nuisances integrated out.

Both act linearly and are linearised once, at the baseline. All that follows (evidence, folds, steps) comes from raw
Gram matrices of whitened columns. The sizes of what is integrated out are hyperparameters (`Hyper`): another value
scales rows and columns of the Grams, so that every hypothesis is judged at its own likeliest ones for a few Cholesky
factors (type II maximum likelihood, Good 1965; empirical Bayes, MacKay 1992, Neural Computation 4, 415).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from data.arrays import Array
from data.errors import WorkError
from diagnosis.fitting.covariance import Covariance
from diagnosis.policy import POLICY

TINY = 1e-300


@dataclass(frozen=True)
class Hyper:
    """Sizes of what is integrated out: structure of refined twins, imperfections, starts of bodies.

    Factors on what was drawn, on the policy's sd and on the machine file's `initial_spread`.
    """

    structure: float = 1.0
    imperfections: float = 1.0
    starts: float = 1.0

    def nuisance_sds(self, count: int, starts: int) -> Array:
        """Prior sd (count,) of a batch's nuisances, of which the first are `starts` of bodies."""
        return np.where(np.arange(count) < starts, self.starts, 1.0)

    def near(self) -> Iterator[Hyper]:
        """Those one step of the grid away, one size at a time."""
        for name, grid in {
            "structure": POLICY.structure_scales, "imperfections": POLICY.imperfection_scales,
            "starts": POLICY.start_scales,
        }.items():  # fmt: skip
            k = grid.index(getattr(self, name))
            yield from (replace(self, **{name: grid[j]}) for j in (k - 1, k + 1) if 0 <= j < len(grid))


@dataclass(frozen=True, eq=False)
class Grams:
    """Per batch products of m whitened columns: with each other (B, m, m), with the K directions (B, K, m) and with the
    batch's nuisances, (q_b, m) each."""

    inner: Array
    along: Array
    nuisance: list[Array]


@dataclass(frozen=True, eq=False)
class Many:
    """Products of C whitened candidate columns: with a model's m columns (m, C) and the directions (K, C), both summed
    over the batches, with each batch's nuisances (q_b, C), and of each with itself (C,)."""

    mixed: Array
    along: Array
    nuisance: list[Array]
    squares: Array


@dataclass(frozen=True, eq=False)
class Scores:
    """Of C candidate columns beyond all that is integrated out: `left`, their squares (C,), `residual`, their products
    with the residual (C,), and by how much the parameters move for a unit of each, `shadow` (p, C)."""

    left: Array
    residual: Array
    shadow: Array


class Marginal:
    """Rows of all batches under a covariance.

    Args:
        nuisance: by batch the derivatives (n_b, q_b) by its nuisances, of prior N(0, 1).
        at: their values (q_b,) where they were linearised.
        starts: how many of them, the first ones, are starts of bodies.
    """

    def __init__(self, covariance: Covariance, nuisance: Sequence[Array], at: Sequence[Array], starts: int) -> None:
        self.covariance, self.starts = covariance, starts
        self.offset = [n @ v for n, v in zip(nuisance, at, strict=True)]
        self.nuisance = [covariance.white(b, n) for b, n in enumerate(nuisance)]
        self.along = [covariance.white(b, d) for b, d in enumerate(covariance.directions)]
        self.nuisance_gram = [n.T @ n for n in self.nuisance]
        self.nuisance_along = [n.T @ d for n, d in zip(self.nuisance, self.along, strict=True)]
        self.along_along = np.stack([d.T @ d for d in self.along])
        self._levels: dict[Hyper, Level] = {}

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_levels": {}}

    @property
    def batches(self) -> int:
        return len(self.nuisance)

    def white(self, rows: Sequence[Array]) -> list[Array]:
        """Rows (n_b, …) of every batch, whitened by the blocks only."""
        return [self.covariance.white(b, r) for b, r in enumerate(rows)]

    def grams(self, columns: Sequence[Array]) -> Grams:
        """Of whitened columns (n_b, m) of every batch."""
        inner = np.stack([x.T @ x for x in columns])
        along = np.stack([d.T @ x for d, x in zip(self.along, columns, strict=True)])
        return Grams(inner, along, [n.T @ x for n, x in zip(self.nuisance, columns, strict=True)])

    def many(self, columns: Sequence[Array], others: Sequence[Array]) -> Many:
        """Of whitened columns (n_b, m) of a model with many others (n_b, C)."""
        pairs = list(zip(columns, others, strict=True))
        mixed = np.sum([x.T @ y for x, y in pairs], axis=0)
        along = np.sum([d.T @ y for d, y in zip(self.along, others, strict=True)], axis=0)
        nuisance = [n.T @ y for n, y in zip(self.nuisance, others, strict=True)]
        return Many(mixed, along, nuisance, np.sum([np.einsum("nc,nc->c", y, y) for y in others], axis=0))

    def level(self, hyper: Hyper) -> Level:
        """All of it at these hyperparameters; cached, since all hypotheses of a round need the same few."""
        if hyper not in self._levels:
            self._levels[hyper] = Level(self, hyper)
        return self._levels[hyper]

    def likeliest(self, grams: Grams, begin: Hyper) -> tuple[Hyper, float]:
        """The hyperparameters of the largest log evidence of columns [model (p), target], up the hill from `begin`."""
        best, most = begin, self.level(begin).log_evidence(grams)
        seen = {begin}
        while True:
            ahead = [h for h in best.near() if h not in seen]
            seen |= set(ahead)
            level = {h: self.level(h).log_evidence(grams) for h in ahead}
            top = max(level, key=lambda h: level[h], default=best)
            if not level or level[top] <= most:
                return best, most
            best, most = top, level[top]


class Level:
    """A `Marginal` at one set of hyperparameters.

    Raises:
        WorkError: derivatives that no machine has.
    """

    def __init__(self, of: Marginal, hyper: Hyper) -> None:
        self.of, covariance = of, of.covariance
        size = np.ones(covariance.count)
        size[: covariance.drawn], size[covariance.drawn :] = hyper.structure, hyper.imperfections
        self.size = size
        self.nuisance_sd = [hyper.nuisance_sds(len(n), of.starts) for n in of.nuisance_gram]
        try:
            self._root = [
                np.linalg.cholesky(n * s * s[:, None] + np.eye(len(n)))
                for n, s in zip(of.nuisance_gram, self.nuisance_sd, strict=True)
            ]
        except np.linalg.LinAlgError:
            raise WorkError("the starts of the runs are where the twin cannot be linearised") from None
        self._taken = [self.beyond(b, d) * size for b, d in enumerate(of.nuisance_along)]
        self._volume = np.array([2.0 * float(np.log(np.diag(r)).sum()) for r in self._root]) + covariance.log_det

    def beyond(self, b: int, nuisance: Array) -> Array:
        """The part (q_b, m) of columns that a batch's nuisances explain, from their products (q_b, m) with these."""
        return solve_triangular(self._root[b], nuisance * self.nuisance_sd[b][:, None], lower=True)

    def _information(self, b: int) -> Array:
        """Of a batch on the directions, nuisances taken out, (K, K)."""
        size, taken = self.size, self._taken[b]
        return np.asarray(self.of.along_along[b] * size * size[:, None] - taken.T @ taken)

    @cached_property
    def _total(self) -> Array:
        return np.asarray(np.sum([self._information(b) for b in range(self.of.batches)], axis=0))

    @cached_property
    def factor(self) -> tuple[Array, bool]:
        """Cholesky factor (K, K) of the directions' information and prior in all batches."""
        return _factor(self._total)

    @cached_property
    def folds(self) -> list[tuple[Array, bool]]:
        """The same (K, K) without each batch in turn."""
        return [_factor(self._total - self._information(b)) for b in range(self.of.batches)]

    def products(self, grams: Grams) -> tuple[Array, Array]:
        """Products (B, m, m) of columns with each other and (B, K, m) with the directions, nuisances taken out."""
        inner, cross = grams.inner.copy(), grams.along * self.size[:, None]
        for b, nuisance in enumerate(grams.nuisance):
            taken = self.beyond(b, nuisance)
            inner[b] -= taken.T @ taken
            cross[b] -= self._taken[b].T @ taken
        return inner, cross

    def reduced(self, grams: Grams, without: int | None = None) -> Array:
        """Products (m, m) of the columns with the directions integrated out, in all batches or without one."""
        return self._reduced(*self.products(grams), without)

    def _reduced(self, each_inner: Array, each_cross: Array, without: int | None = None) -> Array:
        inner, cross, factor = each_inner.sum(axis=0), each_cross.sum(axis=0), self.factor
        if without is not None:
            inner, cross, factor = inner - each_inner[without], cross - each_cross[without], self.folds[without]
        return np.asarray(inner - cross.T @ cho_solve(factor, cross))

    def log_evidence(self, grams: Grams, z: Array | None = None) -> float:
        """Log marginal likelihood, up to a constant, of columns [model (p), target]: parameters of prior
        N(0, 1) integrated out. The peak is taken where the columns promise it, or at z (p,), where it was
        simulated: derivatives of another point promise too much."""
        return self._log_evidence(self.products(grams), z=z)

    def _log_evidence(self, products: tuple[Array, Array], without: int | None = None, z: Array | None = None) -> float:
        try:
            c = self._reduced(*products, without)
            root = np.linalg.cholesky(c[:-1, :-1] + np.eye(len(c) - 1))
        except np.linalg.LinAlgError:  # columns of values that no machine has
            return -np.inf
        if z is None:
            fitted = solve_triangular(root, c[:-1, -1], lower=True)
            left = float(c[-1, -1] - fitted @ fitted)
        else:
            aim = np.append(-z, 1.0)
            left = float(aim @ c @ aim + z @ z)
        factor = self.factor if without is None else self.folds[without]
        logs = 2.0 * float(np.log(np.diag(root)).sum() + np.log(np.diag(factor[0])).sum())
        logs += float(self._volume.sum())
        if without is not None:
            logs -= float(self._volume[without])
        return -0.5 * (left + logs)

    def log_predictive_density(self, grams: Grams) -> Array:
        """Log density (B,) of every batch, predicted from all others."""
        products = self.products(grams)
        whole = self._log_evidence(products)
        return np.array([whole - self._log_evidence(products, b) for b in range(self.of.batches)])

    def screened(self, grams: Grams, many: Many) -> Scores:
        """Candidate columns as further parameters of a model [model (p), target] at its optimum."""
        inner, cross = (x.sum(axis=0) for x in self.products(grams))
        mixed, along, squares = many.mixed.copy(), many.along * self.size[:, None], many.squares.copy()
        for b, nuisance in enumerate(many.nuisance):
            other = self.beyond(b, nuisance)
            mixed -= self.beyond(b, grams.nuisance[b]).T @ other
            along -= self._taken[b].T @ other
            squares -= np.einsum("qc,qc->c", other, other)
        by_directions = cho_solve(self.factor, np.hstack([along, cross]))
        mixed -= cross.T @ by_directions[:, : along.shape[1]]
        squares -= np.einsum("kc,kc->c", along, by_directions[:, : along.shape[1]])
        c = inner - cross.T @ by_directions[:, along.shape[1] :]
        shadow = np.linalg.solve(c[:-1, :-1] + np.eye(len(c) - 1), mixed[:-1])
        left = np.maximum(squares - np.einsum("pc,pc->c", mixed[:-1], shadow), TINY)
        return Scores(left, mixed[-1] - shadow.T @ c[:-1, -1], shadow)

    def optimum(self, grams: Grams, without: int | None = None) -> Array:
        """z (p,) of columns [model (p), target]."""
        c = self.reduced(grams, without)
        return np.asarray(np.linalg.solve(c[:-1, :-1] + np.eye(len(c) - 1), c[:-1, -1]), float)

    def leftover(self, columns: Sequence[Array], z: Array, grams: Grams) -> list[Array]:
        """Whitened rows (n_b,) left of the target in columns [model (p), target] at z and at the likeliest directions
        and nuisances."""
        of, aim = self.of, np.append(-z, 1.0)
        along = self.size * cho_solve(self.factor, self.products(grams)[1].sum(axis=0) @ aim)
        out = []
        for b, x in enumerate(columns):
            rest = x @ aim - of.along[b] @ along
            taken = self.beyond(b, (of.nuisance[b].T @ rest)[:, None])
            v = solve_triangular(self._root[b], taken, lower=True, trans="T")
            out.append(rest - of.nuisance[b] @ (self.nuisance_sd[b] * v[:, 0]))
        return out


def _factor(information: Array) -> tuple[Array, bool]:
    return cho_factor(information + np.eye(len(information)), lower=True)
