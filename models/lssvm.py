"""LS-SVM regression with an RBF kernel and a linear part, tuned by exact leave-batch-out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError
from features.design import Design
from models.base import Array, Family, inner_groups
from models.batchwise import too_few_rows
from models.bordered import bordered_inverse, left_out

Rows = NDArray[np.int64]
SCALES = {"K": 10.0, "degC": 10.0, "K/h": 10.0, "rpm": 1000.0, "mm/min": 1000.0}
LINEAR_WEIGHT = 10.0  # at equal weight the RBF takes half of every slope, and keeps it at home
_OTHER_SCALE = 10.0  # inputs without a known unit are taken for rises
_LEAST_ROWS_PER_BATCH = 8
_ROWS_AT_ONCE = 4096  # of a prediction: bounds the kernel's memory


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
        return self._fit_alone(design, train, *self._decimated(design))

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """Folds that leave out less than half of the rows come from one inverse per (γ, σ); others one by one.

        Raises:
            InputError: fewer than 2 usable rows in a fold.
        """
        rows, batch = self._decimated(design)
        shared = [f for f, fold in enumerate(folds) if _shares(fold, batch)]
        out: dict[int, Self] = {}
        if len(shared) > 1:
            out = dict(zip(shared, self._fit_shared(design, [folds[f] for f in shared], rows, batch), strict=True))
        for f, fold in enumerate(folds):
            if f not in out:
                out[f] = self._fit_alone(design, fold, rows, batch)
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

    def predict_folds(self, design: Design, fitted: Sequence[Self]) -> Array:
        """Models that share σ share the kernel of their united support rows."""
        out = np.empty((len(design.x), len(fitted)))
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
            for start in range(0, len(out), _ROWS_AT_ONCE):
                some = slice(start, start + _ROWS_AT_ONCE)
                out[some, members] = kernel(design.x[some] / scale, support, sigma, self.linear) @ alpha + bias
        return out

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

    def _fit_alone(self, design: Design, train: Sequence[int], rows: Rows, batch: Rows) -> Self:
        inside = np.isin(batch, np.asarray(list(train), int))
        rows, batch = rows[inside], batch[inside]
        if len(rows) < 2:
            raise too_few_rows(self.key, design, train, len(rows), 2)
        groups = inner_groups(batch)
        none_out = np.zeros((1, 0), np.int64)
        best = self._search(design, rows, _layout(groups), np.ones((1, groups.max() + 1), bool), none_out)
        return self._made(design, rows, best, 0)

    def _fit_shared(self, design: Design, folds: Sequence[Sequence[int]], rows: Rows, batch: Rows) -> list[Self]:
        present, compact = np.unique(batch, return_inverse=True)
        member = np.array([np.isin(present, list(fold)) for fold in folds])
        outs = _padded_rows([np.flatnonzero(~member[f][compact]) for f in range(len(folds))])
        best = self._search(design, rows, _layout(compact), member, outs)
        return [self._made(design, rows, best, f) for f in range(len(folds))]

    def _search(self, design: Design, rows: Rows, groups: Rows, member: NDArray[np.bool_], outs: Rows) -> _Best:
        u, y = design.x[rows] / _scale(design), design.y_um[rows]
        best = _Best.empty(len(member), len(rows))
        for sigma in self.sigmas:
            omega = kernel(u, u, sigma, self.linear)
            for gamma in self.gammas:
                try:
                    inverse, ones = bordered_inverse(omega, gamma)
                    found = left_out(inverse, ones, y, groups, member, outs)
                except np.linalg.LinAlgError:
                    continue  # inputs so large that 1/γ is lost in rounding: a smaller γ still does
                best.take(sigma, gamma, *found)
        if not np.isfinite(best.score).all():
            raise InputError(
                f"family lssvm: no gamma of {self.gammas} gives a solvable kernel; inputs reach "
                f"{np.abs(u).max():.3g} times their scale, expected about 1: check their units"
            )
        return best

    def _made(self, design: Design, rows: Rows, best: _Best, f: int) -> Self:
        kept = best.inside[f]
        scale = _scale(design)
        fitted = {
            "support": design.x[rows[kept]] / scale,
            "alpha": best.alpha[f, kept],
            "bias": float(best.bias[f]),
            "gamma": float(best.gamma[f]),
            "sigma": float(best.sigma[f]),
            "scale": scale,
            "inner_rms_um": float(best.score[f]),
        }
        return self._learned(design, fitted)


def kernel(u: Array, v: Array, sigma: float, linear: bool) -> Array:
    """Ω (n, m) of scaled inputs u (n, p), v (m, p); NaN rows give NaN."""
    p = max(1, u.shape[1])
    dot = u @ v.T
    square = (u**2).sum(axis=1)[:, None] + (v**2).sum(axis=1) - 2.0 * dot
    omega: Array = np.exp(np.minimum(-square / (2.0 * p * sigma**2), 0.0))
    return omega + LINEAR_WEIGHT * dot / p if linear else omega


@dataclass
class _Best:
    """The best (γ, σ) of every fold so far, with its solution."""

    score: Array
    sigma: Array
    gamma: Array
    alpha: Array
    bias: Array
    inside: NDArray[np.bool_]

    @classmethod
    def empty(cls, n_folds: int, n: int) -> _Best:
        zero = np.zeros(n_folds)
        return cls(zero + np.inf, zero.copy(), zero.copy(), np.zeros((n_folds, n)), zero.copy(),
                   np.ones((n_folds, n), bool))  # fmt: skip

    def take(
        self, sigma: float, gamma: float, score: Array, alpha: Array, bias: Array, inside: NDArray[np.bool_]
    ) -> None:
        better = score < self.score
        self.score[better], self.sigma[better], self.gamma[better] = score[better], sigma, gamma
        self.alpha[better], self.bias[better], self.inside = alpha[better], bias[better], inside


def _scale(design: Design) -> Array:
    units = design.input_units or ("",) * len(design.inputs)
    return np.array([SCALES.get(u, _OTHER_SCALE) for u in units])


def _shares(fold: Sequence[int], batch: Rows) -> bool:
    """Whether a fold has batches enough to leave one out, and itself leaves out some rows but less than half."""
    inside = np.isin(batch, list(fold))
    return len(np.unique(batch[inside])) >= 3 and 0.5 <= inside.mean() < 1.0


def _layout(group: Rows) -> Rows:
    """Row numbers per group (G, m), −1 behind a group's end."""
    return _padded_rows([np.flatnonzero(group == k) for k in range(int(group.max()) + 1)])


def _padded_rows(parts: Sequence[Rows]) -> Rows:
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
