"""LS-SVM regression with an RBF kernel and a linear part, tuned by exact leave-batch-out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError
from features.design import Design
from models.base import Array, Family, inner_groups
from models.batchwise import by_batch, too_few_rows
from models.bordered import Bordered, Kernel

Rows = NDArray[np.int64]
SCALES = {"K": 10.0, "degC": 10.0, "K/h": 10.0, "rpm": 1000.0, "mm/min": 1000.0}
LINEAR_WEIGHT = 10.0  # at equal weight the RBF takes half of every slope, and keeps it at home
_OTHER_SCALE = 10.0  # inputs without a known unit are taken for rises
_LEAST_ROWS_PER_BATCH = 8
_ROWS_AT_ONCE = 128  # of a prediction: its kernel stays in a processor's cache
_STACK_VALUES = 500_000  # of the matrices solved together: what fits a processor's cache


class LSSVM(Family):
    """Least-squares support vector regression: `[[0, 1ᵀ], [1, Ω + I/γ]] [b; α] = [0; y]`.

    `Ω_ij = exp(−|u_i − u_j|²/(2 p σ²))`, plus `10 u_i·u_j/p` with `linear`: an RBF alone falls back to b outside the
    trained seasons, the linear part goes on. u are the p inputs divided by a fixed scale per unit (`SCALES`: 10 K,
    10 K/h, 1000 rpm, …), the same for every fold, so all folds share one kernel; σ is in those scales. The model is
    linear in y, so scaling y would change nothing.

    γ and σ are chosen on the grid `gammas` × `sigmas` by leave-batch-out inside the training batches (contiguous
    quarters of one or two batches), least mean RMS over the batches left out. Batches are decimated evenly, all to
    at most `max_rows` over the number of batches in the design (at least 8 each); `fitted` tells the rows kept.

    Source: J. Suykens et al., Least squares support vector machines (2002); left-out residuals from the
    inverse: G. Cawley, Leave-one-out cross-validation based model selection criteria for weighted LS-SVMs (2006).
    """

    key = "lssvm"
    words = "least-squares support vector machine, RBF and linear kernel"
    source = "Suykens et al. 2002"
    effort = "quick"
    closed_form = False
    rank = 60

    def __init__(
        self,
        linear: bool = True,
        max_rows: int = 480,
        sigmas: Sequence[float] = (0.3, 1.0, 3.0, 10.0),
        gammas: Sequence[float] = (1.0, 10.0, 100.0, 1e3, 1e4),
    ) -> None:
        super().__init__()
        self.linear, self.max_rows = bool(linear), int(max_rows)
        self.sigmas, self.gammas = [float(s) for s in sigmas], [float(g) for g in gammas]

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        return self.fit_folds(design, [train])[0]

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """Folds that leave out one batch share one inverse per (γ, σ); the others are stacked where alike in size.

        Raises:
            InputError: fewer than 2 usable rows in a fold.
        """
        rows, batch = self._decimated(design)
        present = np.unique(batch)
        gaps = [present[~np.isin(present, list(fold))] for fold in folds]
        shared = [f for f, gap in enumerate(gaps) if len(gap) == 1 and len(present) >= 4]
        out: dict[int, Self] = {}
        if len(shared) > 1:
            out |= self._fit_shared(design, rows, batch, {f: int(gaps[f][0]) for f in shared})
        alone: dict[int, tuple[Rows, Rows]] = {}
        for f, fold in enumerate(folds):
            if f not in out:
                inside = rows[np.isin(batch, list(fold))]
                if len(inside) < 2:
                    raise too_few_rows(self.key, design, fold, len(inside), 2)
                alone[f] = inside, _layout(inner_groups(design.group[inside]))
        for stack in _stacks({f: layout.shape for f, (_, layout) in alone.items()}):
            out |= self._fit_stack(design, {f: alone[f] for f in stack})
        return [out[f] for f in range(len(folds))]

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        f = self.fitted
        scale, support, alpha = (np.asarray(f[k], float) for k in ("scale", "support", "alpha"))
        out = []
        for k in batches:
            u = design.x[design.rows(k)] / scale
            parts = [
                kernel(u[i : i + _ROWS_AT_ONCE], support, f["sigma"], self.linear) @ alpha
                for i in range(0, len(u), _ROWS_AT_ONCE)
            ]
            out.append(np.concatenate([*parts, np.empty(0)]) + f["bias"])
        return out

    def predict_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Models that share σ share the kernel of their united support rows."""
        out = np.empty((len(design.x), len(fitted)))
        asked = np.flatnonzero(np.isin(design.group, sorted({k for batches in wanted for k in batches})))
        by_kernel: dict[tuple[float, bytes], list[int]] = {}
        for f, m in enumerate(fitted):
            by_kernel.setdefault((m.fitted["sigma"], np.asarray(m.fitted["scale"]).tobytes()), []).append(f)
        for (sigma, _), members in by_kernel.items():
            models = [fitted[f] for f in members]
            support, place = _united([np.atleast_2d(m.fitted["support"]) for m in models])
            alpha = np.zeros((len(support), len(members)))
            for c, m in enumerate(models):
                np.add.at(alpha[:, c], place[c], m.fitted["alpha"])
            scale = np.asarray(models[0].fitted["scale"], float)
            bias = np.array([m.fitted["bias"] for m in models])
            for start in range(0, len(asked), _ROWS_AT_ONCE):
                some = asked[start : start + _ROWS_AT_ONCE]
                values = kernel(design.x[some] / scale, support, sigma, self.linear) @ alpha + bias
                out[some[:, None], members] = values
        return by_batch(design, out, wanted)

    def n_parameters(self) -> int:
        return int(np.size(self.fitted["alpha"])) + 3

    def _decimated(self, design: Design) -> tuple[Rows, Rows]:
        """Rows kept, evenly over each batch's usable rows, and their batch."""
        most = max(_LEAST_ROWS_PER_BATCH, self.max_rows // max(1, design.n_batches))
        kept = []
        for k in range(design.n_batches):
            usable = np.flatnonzero(design.usable[design.rows(k)]) + design.offsets[k]
            if len(usable) > most:
                usable = usable[np.round(np.linspace(0, len(usable) - 1, most)).astype(int)]
            kept.append(usable)
        rows = np.concatenate(kept) if kept else np.empty(0, np.int64)
        return rows, design.group[rows]

    def _fit_shared(self, design: Design, rows: Rows, batch: Rows, gap: dict[int, int]) -> dict[int, Self]:
        """Fold f leaves out batch gap[f]: its inner residuals are those of pairs of batches left out."""
        present, compact = np.unique(batch, return_inverse=True)
        problem = _Problem.of(design, [rows], [_layout(compact)])
        m, left = problem.group_rows, np.searchsorted(present, list(gap.values()))
        best = _Best.empty(len(gap), problem.n)
        for sigma, gamma, system in problem.systems(self):
            score = problem.score(system.pairs_left_out(m)[left], ~np.eye(len(present), dtype=bool)[left])
            better = np.flatnonzero(score < best.score)
            if len(better):
                best.take(better, sigma, gamma, score[better], *system.solutions(m, left[better]))
        folds = range(len(gap))
        inside = [problem.known[0] & (np.arange(problem.n) // m != left[f]) for f in folds]
        return {f: self._made(design, problem, best, i, 0, inside[i]) for i, f in enumerate(gap)}

    def _fit_stack(self, design: Design, alone: dict[int, tuple[Rows, Rows]]) -> dict[int, Self]:
        problem = _Problem.of(design, [r for r, _ in alone.values()], [layout for _, layout in alone.values()])
        best = _Best.empty(len(alone), problem.n)
        for sigma, gamma, system in problem.systems(self):
            score = problem.score(system.left_out(problem.group_rows))
            better = np.flatnonzero(score < best.score)
            if len(better):
                alpha, bias = system.solutions(problem.group_rows)
                best.take(better, sigma, gamma, score[better], alpha[better], bias[better])
        return {f: self._made(design, problem, best, i, i, problem.known[i]) for i, f in enumerate(alone)}

    def _made(self, design: Design, problem: _Problem, best: _Best, f: int, s: int, kept: NDArray[np.bool_]) -> Self:
        if not np.isfinite(best.score[f]):
            raise InputError(
                f"family lssvm: no gamma of {self.gammas} gives a solvable kernel; inputs reach "
                f"{np.abs(problem.u[s]).max():.3g} times their scale, expected about 1: check their units"
            )
        fitted = {
            "support": problem.u[s, kept],
            "alpha": best.alpha[f, kept],
            "bias": float(best.bias[f]),
            "gamma": float(best.gamma[f]),
            "sigma": float(best.sigma[f]),
            "scale": unit_scale(design),
            "inner_rms_um": float(best.score[f]),
        }
        return self._learned(design, fitted)


def kernel(u: Array, v: Array, sigma: float, linear: bool) -> Array:
    """Ω (n, m) of scaled inputs u (n, p), v (m, p); NaN rows give NaN."""
    return _kernel(*_products(u, v), sigma, linear)


def _products(u: Array, v: Array) -> tuple[Array, Array]:
    """−|u_i − v_j|²/(2p), never above 0, and u_i·v_j/p: all that a kernel needs besides σ."""
    p = max(1, u.shape[1])
    dot = u @ v.T / p
    half = dot - (u**2).sum(axis=1)[:, None] / (2.0 * p)
    half -= (v**2).sum(axis=1) / (2.0 * p)
    return np.minimum(half, 0.0, out=half), dot


def _kernel(half: Array, dot: Array, sigma: float, linear: bool) -> Array:
    omega: Array = half / sigma**2
    np.exp(omega, out=omega)
    if linear:
        omega += LINEAR_WEIGHT * dot
    return omega


@dataclass(frozen=True)
class _Problem:
    """S training sets, each in G groups of m rows, 0 where padded: u (S, n, p), y_um and known (S, n), n = G m."""

    u: Array
    y_um: Array
    known: NDArray[np.bool_]
    group_rows: int

    @classmethod
    def of(cls, design: Design, rows: Sequence[Rows], layouts: Sequence[Rows]) -> Self:
        n_groups, m = np.max([layout.shape for layout in layouts], axis=0)
        at = np.full((len(rows), n_groups, m), -1, np.int64)
        for s, (r, layout) in enumerate(zip(rows, layouts, strict=True)):
            at[s, : layout.shape[0], : layout.shape[1]] = np.where(layout >= 0, r[layout], -1)
        at = at.reshape(len(rows), -1)
        known = at >= 0
        u = np.where(known[:, :, None], design.x[at] / unit_scale(design), 0.0)
        return cls(u, np.where(known, design.y_um[at], 0.0), known, int(m))

    @property
    def n(self) -> int:
        return self.known.shape[1]

    def systems(self, family: LSSVM) -> Iterator[tuple[float, float, Bordered]]:
        """Every (σ, γ) of a family, solved."""
        known = self.known.astype(float)
        with np.errstate(all="ignore"):  # a γ lost in rounding gives NaN, and is not chosen
            products = [_products(u, u) for u in self.u]
            for sigma in family.sigmas:
                kernels = []
                for product, k in zip(products, known, strict=True):
                    omega = _kernel(*product, sigma, family.linear)
                    kernels.append(Kernel(omega if k.all() else omega * k[:, None] * k))
                for gamma in family.gammas:
                    yield sigma, gamma, Bordered.of(kernels, known, self.y_um, gamma)

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


def unit_scale(design: Design) -> Array:
    """What inputs are divided by for their unit, (p,): the same in every fold."""
    units = design.input_units or ("",) * len(design.inputs)
    return np.array([SCALES.get(u, _OTHER_SCALE) for u in units])


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


def _united(supports: Sequence[Array]) -> tuple[Array, list[Rows]]:
    """Distinct support rows and where each model's lie among them."""
    stacked = np.concatenate(supports)
    keys = np.ascontiguousarray(stacked).view(np.dtype((np.void, stacked.shape[1] * 8)))[:, 0]
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    borders = np.cumsum([len(s) for s in supports])[:-1]
    return stacked[first], np.split(place, borders)
