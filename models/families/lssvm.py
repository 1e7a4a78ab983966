"""Family: least-squares support vector machine with RBF and linear kernel, tuned by exact leave-batch-out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, closest
from features.design import Design
from models.base import inner_groups
from models.numerics.batches import too_few_rows
from models.numerics.kernels import (
    Bordered,
    Kernel,
    KernelExpansion,
    Rows,
    evenly,
    from_origin,
    kernel_from_origin,
    kernel_of,
    products,
    unit_scale,
)
from models.numerics.particle_swarm import least

TUNINGS = ("closed_form", "particle_swarm")
_LEAST_ROWS_PER_BATCH = 8
_STACK_VALUES = 500_000  # of the matrices solved together: what fits a processor's cache


class LSSVM(KernelExpansion):
    """Least-squares support vector regression: `(Ω + I/γ) α = y`; `as_published` with a bias, `[0, 1ᵀ; 1, Ω + I/γ]`.

    `Ω_ij = exp(−|u_i − u_j|²/(2 p σ²))`, plus `10 u_i·u_j/p` with `linear`: an RBF alone falls back to a constant
    outside the trained seasons, the linear part extrapolates. u are the p inputs divided by a fixed scale per unit
    (`SCALES`: 10 K, 10 K/h, 1000 rpm, …), the same for every fold, so all folds share one kernel; σ is in those scales.
    The model is linear in y, so scaling y would change nothing.

    γ and σ are those of least mean RMS over the training batches (contiguous quarters of one or two), each left out
    once. `tuning` searches them on the grid `gammas` × `sigmas` (`closed_form`), or between the grid's ends by a
    `particle_swarm` over (log σ, log γ) of a seed, fold by fold: the same fitness, slower. Batches are decimated
    evenly, all to at most `max_rows` over the number of batches in the design (at least 8 each); `fitted` has the
    rows kept.

    Source: J. Suykens et al., Least squares support vector machines (2002); left-out residuals from the
    inverse: G. Cawley, Leave-one-out cross-validation based model selection criteria for weighted LS-SVMs (2006).
    """

    key = "lssvm"
    summary = "least-squares support vector machine, RBF and linear kernel"
    source = "Suykens et al. 2002"
    rank = 60

    def __init__(
        self,
        linear: bool = True,
        max_rows: int = 480,
        sigmas: Sequence[float] = (0.3, 1.0, 3.0, 10.0),
        gammas: Sequence[float] = (1.0, 10.0, 100.0, 1e3, 1e4),
        tuning: str = "closed_form",
        seed: int = 0,
    ) -> None:
        super().__init__()
        if tuning not in TUNINGS:
            raise InputError(f"{self.key}: unknown tuning {tuning!r}: {closest(tuning, TUNINGS)}")
        self.tuning, self.seed = tuning, int(seed)
        self.linear, self.max_rows = bool(linear), int(max_rows)
        self.sigmas, self.gammas = [float(s) for s in sigmas], [float(g) for g in gammas]

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """Folds that leave out at most half of the batches share one inverse per (γ, σ); the others are stacked where
        of equal size.

        Raises:
            InputError: fewer than 2 usable rows in a fold.
        """
        most = max(_LEAST_ROWS_PER_BATCH, self.max_rows // max(1, design.n_batches))
        rows = evenly(design, range(design.n_batches), most)
        batch = design.group[rows]
        present = np.unique(batch)
        gaps = [np.flatnonzero(~np.isin(present, list(fold))) for fold in folds]
        # From 3 batches on the inner groups are batches; beyond a half a fold's own inverse is the cheaper one.
        shared = [f for f, gap in enumerate(gaps) if 1 <= len(gap) <= min(len(present) / 2, len(present) - 3)]
        out: dict[int, Self] = {}
        if len(shared) > 1 and self.tuning == "closed_form":
            out |= self._fit_shared(design, rows, batch, {f: gaps[f] for f in shared})
        alone: dict[int, tuple[Rows, Rows]] = {}
        for f, fold in enumerate(folds):
            if f not in out:
                inside = rows[np.isin(batch, list(fold))]
                if len(inside) < 2:
                    raise too_few_rows(self.key, design, fold, len(inside), 2)
                alone[f] = inside, _layout(inner_groups(design.group[inside]))
        if self.tuning == "particle_swarm":
            return [self._fit_swarm(design, *alone[f]) for f in range(len(folds))]
        for stack in _stacks({f: layout.shape for f, (_, layout) in alone.items()}):
            out |= self._fit_stack(design, {f: alone[f] for f in stack})
        return [out[f] for f in range(len(folds))]

    def _problem(self, design: Design, rows: Sequence[Rows], layouts: Sequence[Rows]) -> _Problem:
        return _Problem.of(self.started(design), rows, layouts)

    def _fit_shared(self, design: Design, rows: Rows, batch: Rows, gaps: dict[int, Rows]) -> dict[int, Self]:
        """Fold f leaves out the batches gaps[f]: its inner residuals are those of one more batch left out."""
        _, compact = np.unique(batch, return_inverse=True)
        problem = self._problem(design, [rows], [_layout(compact)])
        m, sets = problem.group_rows, list(gaps.values())
        inside = np.ones((len(sets), problem.n // m), bool)
        for i, gap in enumerate(sets):
            inside[i, gap] = False
        alike = [np.flatnonzero([len(gap) == size for gap in sets]) for size in sorted({len(gap) for gap in sets})]
        best = _Best.empty(len(sets), problem.n)
        for sigma, gamma, system in problem.systems(self):
            score = problem.score(system.others_left_out(m, sets), inside)
            for some in alike:
                better = some[score[some] < best.score[some]]
                if len(better):
                    left = np.stack([sets[i] for i in better])
                    best.take(better, sigma, gamma, score[better], *system.solutions(m, left))
        kept = problem.known[0] & np.repeat(inside, m, axis=1)
        return {f: self._made(design, problem, best, i, 0, kept[i]) for i, f in enumerate(gaps)}

    def _fit_stack(self, design: Design, alone: dict[int, tuple[Rows, Rows]]) -> dict[int, Self]:
        problem = self._problem(design, [r for r, _ in alone.values()], [layout for _, layout in alone.values()])
        best = _Best.empty(len(alone), problem.n)
        for sigma, gamma, system in problem.systems(self):
            score = problem.score(system.left_out(problem.group_rows))
            better = np.flatnonzero(score < best.score)
            if len(better):
                alpha, bias = system.solutions(problem.group_rows)
                best.take(better, sigma, gamma, score[better], alpha[better], bias[better])
        return {f: self._made(design, problem, best, i, i, problem.known[i]) for i, f in enumerate(alone)}

    def _fit_swarm(self, design: Design, rows: Rows, layout: Rows) -> Self:
        problem = self._problem(design, [rows], [layout])
        best = _Best.empty(1, problem.n)

        def fitness(at: Array) -> Array:
            """Left-out RMS in µm at (log σ, log γ), (P, 2)."""
            systems = [problem.system(problem.kernels(sigma, self.linear), gamma) for sigma, gamma in np.exp(at)]
            return np.array([problem.score(system.left_out(problem.group_rows))[0] for system in systems])

        low, high = (np.log([end(self.sigmas), end(self.gammas)]) for end in (min, max))
        with np.errstate(all="ignore"):
            at, score = least(fitness, low, high, self.seed)
            sigma, gamma = (float(v) for v in np.exp(at))
            system = problem.system(problem.kernels(sigma, self.linear), gamma)
            best.take(np.array([0]), sigma, gamma, np.array([score]), *system.solutions(problem.group_rows))
        return self._made(design, problem, best, 0, 0, problem.known[0])

    def _made(self, design: Design, problem: _Problem, best: _Best, f: int, s: int, kept: NDArray[np.bool_]) -> Self:
        if not np.isfinite(best.score[f]):
            raise InputError(
                f"family lssvm: no gamma of {self.gammas} gives a solvable kernel; inputs reach "
                f"{np.abs(problem.u[s]).max():.3g} times their scale, expected about 1: check their units"
            )
        support, alpha = problem.u[s, kept], best.alpha[f, kept]
        if self.zero_start:
            support, alpha = from_origin(support, alpha)
        fitted = {
            "support": support,
            "alpha": alpha,
            "bias": float(best.bias[f]),
            "gamma": float(best.gamma[f]),
            "sigma": float(best.sigma[f]),
            "scale": unit_scale(design),
            "inner_rms_um": float(best.score[f]),
        }
        return self._learned(design, fitted)


@dataclass(frozen=True)
class _Problem:
    """S training sets, each in G groups of m rows, 0 where padded: u (S, n, p), y_um and known (S, n), n = G m.

    `bias`: the level is free.
    """

    u: Array
    y_um: Array
    known: NDArray[np.bool_]
    group_rows: int
    bias: bool

    @classmethod
    def of(cls, design: Design, rows: Sequence[Rows], layouts: Sequence[Rows]) -> Self:
        n_groups, m = np.max([layout.shape for layout in layouts], axis=0)
        at = np.full((len(rows), n_groups, m), -1, np.int64)
        for s, (r, layout) in enumerate(zip(rows, layouts, strict=True)):
            at[s, : layout.shape[0], : layout.shape[1]] = np.where(layout >= 0, r[layout], -1)
        at = at.reshape(len(rows), -1)
        known = at >= 0
        u = np.where(known[:, :, None], design.x[at] / unit_scale(design), 0.0)
        return cls(u, np.where(known, design.y_um[at], 0.0), known, int(m), not design.about_start)

    @property
    def n(self) -> int:
        return self.known.shape[1]

    @cached_property
    def _products(self) -> tuple[Array, Array]:
        return products(self.u, self.u)

    def kernels(self, sigma: float, linear: bool) -> list[Kernel]:
        """The kernel of every training set."""
        omega = (kernel_of if self.bias else kernel_from_origin)(*self._products, sigma, linear)
        if not self.known.all():
            omega *= self.known[:, :, None] & self.known[:, None, :]
        return [Kernel(own) for own in omega]

    def system(self, kernels: list[Kernel], gamma: float) -> Bordered:
        """Solved; NaN where γ is lost in rounding."""
        return Bordered.of(kernels, self.known.astype(float), self.y_um, gamma, self.bias)

    def systems(self, family: LSSVM) -> Iterator[tuple[float, float, Bordered]]:
        """Every (σ, γ) of a family's grid, solved."""
        with np.errstate(all="ignore"):  # a γ lost in rounding gives NaN, and is not chosen
            for sigma in family.sigmas:
                kernels = self.kernels(sigma, family.linear)
                for gamma in family.gammas:
                    yield sigma, gamma, self.system(kernels, gamma)

    def score(self, residual: Array, member: NDArray[np.bool_] | None = None) -> Array:
        """Mean over the groups of the RMS of residual (F, G, m); ∞ where it is not a number."""
        count = self.known.reshape(len(self.known), -1, self.group_rows).sum(axis=2)
        counted = (count > 0) if member is None else (count > 0) & member
        rms = np.sqrt((residual**2).sum(axis=2) / np.maximum(count, 1))
        score = np.where(counted, rms, 0.0).sum(axis=1) / np.maximum(counted.sum(axis=1), 1)
        return np.where(np.isfinite(score), score, np.inf)


@dataclass
class _Best:
    """The best (γ, σ) of every fold so far, with its solution."""

    score: Array
    sigma: Array
    gamma: Array
    alpha: Array
    bias: Array

    @classmethod
    def empty(cls, n_folds: int, n: int) -> Self:
        zero = np.zeros(n_folds)
        return cls(zero + np.inf, zero.copy(), zero.copy(), np.zeros((n_folds, n)), zero.copy())

    def take(self, at: Rows, sigma: float, gamma: float, score: Array, alpha: Array, bias: Array) -> None:
        self.score[at], self.sigma[at], self.gamma[at] = score, sigma, gamma
        self.alpha[at], self.bias[at] = alpha, bias


def _stacks(shapes: dict[int, tuple[int, ...]]) -> list[list[int]]:
    """Folds of like shape together, as long as their matrices stay few."""
    stacks: dict[tuple[int, ...], list[list[int]]] = {}
    for f, shape in shapes.items():
        same = stacks.setdefault(shape, [[]])
        if same[-1] and (len(same[-1]) + 1) * (shape[0] * shape[1]) ** 2 > _STACK_VALUES:
            same.append([])
        same[-1].append(f)
    return [stack for same in stacks.values() for stack in same]


def _layout(group: Rows) -> Rows:
    """Row numbers per group (G, m), −1 behind a group's end."""
    parts = [np.flatnonzero(group == k) for k in range(int(group.max()) + 1)]
    out = np.full((len(parts), max(len(p) for p in parts)), -1, np.int64)
    for i, part in enumerate(parts):
        out[i, : len(part)] = part
    return out
