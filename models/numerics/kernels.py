"""Kernel expansions over support rows, shared by LS-SVM and SVR."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from data.arrays import Array
from features.design import Design, even_rows
from models.base import Family
from models.numerics.batches import by_batch
from models.program import Builder

Rows = NDArray[np.int64]
SCALES = {"K": 10.0, "degC": 10.0, "K/h": 10.0, "rpm": 1000.0, "mm/min": 1000.0}
LINEAR_WEIGHT = 10.0  # at equal weight the RBF takes half of every slope, and keeps it at home
_OTHER_SCALE = 10.0  # inputs without a known unit are taken for rises
_ROWS_AT_ONCE = 128  # of a prediction: its kernel stays in a processor's cache


class KernelExpansion(Family):
    """`ŷ(u) = b + Σ_s α_s k(u_s, u)`, u the p inputs over a fixed scale per unit (`SCALES`).

    `k(u, v) = exp(−|u − v|²/(2 p σ²))`, plus `10 u·v/p` with `linear`. `fitted` has support (s, p), alpha (s,), bias,
    sigma and scale (p,). u is relative to the batch's start, where it is 0, and so is ŷ: the kernel that is fitted is
    `k(u, v) − k(u, 0) − k(0, v) + k(0, 0)`, and b has no part (`as_published`: the inputs as they are, k and b).
    """

    closed_form = False
    linear: bool

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Models that share σ share the kernel of their united support rows."""
        x = fitted[0].started(design).x
        out = np.empty((len(design.x), len(fitted)))
        rows = np.flatnonzero(np.isin(design.group, sorted({k for batches in wanted for k in batches})))
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
            for start in range(0, len(rows), _ROWS_AT_ONCE):
                some = rows[start : start + _ROWS_AT_ONCE]
                values = kernel(x[some] / scale, support, sigma, self.linear) @ alpha + bias
                out[some[:, None], members] = values
        return by_batch(design, out, wanted)

    def operations(self, b: Builder) -> Sequence[int]:
        f = self.fitted
        scale, support, alpha = (np.asarray(f[k], float) for k in ("scale", "support", "alpha"))
        u = b.scaled(self.started_inputs(b), scale)
        p = max(1, len(self.inputs))
        curve = b.add("kernel", [u], 1, support=support, weights=alpha, sharpness=1.0 / (2.0 * p * f["sigma"] ** 2))
        line = b.affine(u, (LINEAR_WEIGHT / p * alpha @ support)[None] * self.linear)
        return [b.affine(b.join(curve, line), np.ones((1, 2)), f["bias"])]

    def n_parameters(self) -> int:
        return int(np.size(self.fitted["alpha"])) + 3


def kernel(u: Array, v: Array, sigma: float, linear: bool) -> Array:
    """Ω (n, m) of scaled inputs u (n, p), v (m, p); NaN rows give NaN."""
    return kernel_of(*products(u, v), sigma, linear)


def products(u: Array, v: Array) -> tuple[Array, Array]:
    """−|u_i − v_j|²/(2p), never above 0, and u_i·v_j/p, (..., n, m) each, of u (..., n, p) and v (..., m, p)."""
    p = max(1, u.shape[-1])
    dot = u @ np.swapaxes(v, -1, -2) / p
    half = dot - (u**2).sum(axis=-1)[..., :, None] / (2.0 * p)
    half -= (v**2).sum(axis=-1)[..., None, :] / (2.0 * p)
    return np.minimum(half, 0.0, out=half), dot


def kernel_of(half: Array, dot: Array, sigma: float, linear: bool) -> Array:
    """Ω (..., n, m) from what `products` gives."""
    omega: Array = half / sigma**2
    np.exp(omega, out=omega)
    if linear:
        omega += LINEAR_WEIGHT * dot
    return omega


def kernel_from_origin(half: Array, dot: Array, sigma: float, linear: bool) -> Array:
    """`k(u, v) − k(u, 0) − k(0, v) + k(0, 0)` (..., n, n) between n rows u, from what `products` gives."""
    omega = kernel_of(half, dot, sigma, linear)
    to_origin = np.exp(-np.einsum("...ii->...i", dot) / (2.0 * sigma**2))
    omega += 1.0 - to_origin[..., :, None] - to_origin[..., None, :]
    return omega


def from_origin(support: Array, alpha: Array) -> tuple[Array, Array]:
    """Support rows (n + 1, p) and weights (n + 1,) for `kernel_of` that predict as those of `kernel_from_origin`, but
    for the level."""
    return np.vstack([support, np.zeros(support.shape[1])]), np.append(alpha, -alpha.sum())


def unit_scale(design: Design) -> Array:
    """What inputs are divided by for their unit, (p,): the same in every fold."""
    units = design.input_units or ("",) * len(design.inputs)
    return np.array([scale_of(u) for u in units])


def scale_of(unit: str) -> float:
    """What an input of that unit is divided by."""
    return SCALES.get(unit, _OTHER_SCALE)


def evenly(design: Design, batches: Sequence[int], most: int) -> Rows:
    """Numbers of at most `most` usable rows of each batch, evenly over them."""
    return np.concatenate([np.empty(0, np.int64), *(even_rows(design, k, most) for k in batches)])


def _united(supports: Sequence[Array]) -> tuple[Array, list[Rows]]:
    """Distinct support rows and where each model's lie among them."""
    stacked = np.concatenate(supports)
    keys = np.ascontiguousarray(stacked).view(np.dtype((np.void, stacked.shape[1] * 8)))[:, 0]
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    borders = np.cumsum([len(s) for s in supports])[:-1]
    return stacked[first], np.split(place, borders)


_LOST = 1e-14  # of a kernel's diagonal: below the rounding of the kernel itself
_THIN_FROM_ROWS, _THIN_SHARE = 100, 0.7  # a factor pays where the matrix is large and the factor clearly narrower
_THIN_MOST = 1e10  # γ times the trace, above which I − WᵀW has no digits left


class Kernel:
    """Ω (n, n) of one σ, and L (n, r) with Ω = L Lᵀ where a pivoted Cholesky ends at r well below n."""

    def __init__(self, omega: Array) -> None:
        self.omega, self.trace = omega, float(np.trace(omega))
        self.thin: Array | None = None
        if len(omega) >= _THIN_FROM_ROWS:
            factor, pivots, rank, _ = lapack.dpstrf(omega.T, tol=_LOST, lower=1)
            if rank <= _THIN_SHARE * len(omega):
                self.thin = np.empty((len(omega), rank))
                self.thin[pivots - 1] = np.tril(factor[:, :rank])
                self.gram = self.thin.T @ self.thin

    def inverse(self, gamma: float) -> Array:
        """(Ω + I/γ)⁻¹; from L it is γ (I − L (LᵀL + I/γ)⁻¹ Lᵀ) (Woodbury).

        Raises:
            LinAlgError: Ω + I/γ is not positive definite in floating point.
        """
        if self.thin is not None and gamma * self.trace < _THIN_MOST:
            factor = np.linalg.cholesky(self.gram + np.eye(len(self.gram)) / gamma)
            # dtrsm writes over a Fortran-ordered copy of L: that is W = R⁻¹ Lᵀ, column by column of Lᵀ.
            w = blas.dtrsm(np.sqrt(gamma), factor, self.thin.T, lower=1)
            inverse: Array = -(w.T @ w)
            inverse.flat[:: len(inverse) + 1] += gamma
            return inverse
        n = len(self.omega)
        matrix = self.omega.copy()
        matrix.flat[:: n + 1] += 1.0 / gamma
        factor, info = lapack.dpotrf(matrix.T, lower=1, overwrite_a=1)
        if info == 0:
            factor, info = lapack.dpotri(factor, lower=1, overwrite_c=1)
        if info != 0:
            raise np.linalg.LinAlgError(f"kernel matrix of {n} rows is not positive definite at gamma {gamma:g}")
        inverse = factor + factor.T
        inverse.flat[:: n + 1] *= 0.5
        return inverse


@dataclass(frozen=True)
class Bordered:
    """S systems `[[0, kᵀ], [k, Ω + I/γ]] [b; α] = [0; y]` over G groups of m rows, n = G m; k is 0 on padding, else 1.

    Without `bias` b is 0 and its row and column are gone: the border of the inverse is 0.

    The inverse is `[[corner, onesᵀ], [ones, inverse]]`: (S,), (S, n), (S, n, n). Ω and y (S, n) are 0 on padding, so
    that α = inverse y and every residual are too. Where Ω + I/γ is not positive definite, everything is NaN.
    """

    kernels: list[Kernel]
    known: Array
    y: Array
    gamma: float
    inverse: Array
    ones: Array
    corner: Array
    alpha: Array

    @classmethod
    def of(cls, kernels: list[Kernel], known: Array, y: Array, gamma: float, bias: bool = True) -> Self:
        """Solve S systems of n rows: `known` (S, n) is 1 where a row takes part, y (S, n), without `bias` no offset."""
        inverse = _inverses(kernels, gamma)
        if bias:
            u = (inverse @ known[:, :, None])[..., 0]
            corner = -1.0 / (u * known).sum(axis=1)
            ones = -corner[:, None] * u
            for s in range(len(kernels)):
                inverse[s] -= u[s][:, None] * ones[s]
        else:
            corner, ones = np.zeros(len(kernels)), np.zeros_like(y)
        return cls(kernels, known, y, gamma, inverse, ones, corner, (inverse @ y[:, :, None])[..., 0])

    def left_out(self, m: int) -> Array:
        """Residuals (S, G, m) of each group when it is left out: `C_gg⁻¹ α_g`."""
        s, n = self.alpha.shape
        own = np.einsum("sgigj->sgij", self.inverse.reshape(s, n // m, m, n // m, m))
        return _solved(own, self.alpha.reshape(s, n // m, m))

    def others_left_out(self, m: int, gaps: Sequence[NDArray[np.int64]]) -> Array:
        """Residuals (F, G, m) of the first system: [f, g] those of group g when it and the groups gaps[f] are left out.

        `C_PP⁻¹ α_P` over the rows P of both, by elimination of the gap; NaN for the groups in it.
        Source: G. Cawley, Leave-one-out cross-validation based model selection criteria for weighted LS-SVMs (2006).
        """
        n = self.alpha.shape[1]
        n_groups = n // m
        blocks = np.einsum("gigj->gij", self.inverse[0].reshape(n_groups, m, n_groups, m))
        own = np.empty((len(gaps), *blocks.shape))
        alpha = np.empty((len(gaps), n_groups, m))
        for f, gap in enumerate(gaps):
            at = _rows_of(gap, m)
            away = self.inverse[0][:, at]
            factor, info = lapack.dpotrf(away[at].T, lower=1, overwrite_a=1)
            # Written over the rows of `away`: R⁻¹ C_Pi for every row i, R Rᵀ = C_PP.
            away = blas.dtrsm(1.0 if info == 0 else np.nan, factor, away.T, lower=1, overwrite_b=1).T
            pull = blas.dtrsv(factor, self.alpha[0, at], lower=1)
            w = away.reshape(n_groups, m, len(at))
            own[f] = blocks - w @ w.transpose(0, 2, 1)
            alpha[f] = (self.alpha[0] - away @ pull).reshape(n_groups, m)
            own[f, gap], alpha[f, gap] = np.eye(m), np.nan
        return _solved(own, alpha)

    def solutions(self, m: int, left: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
        """α (S, n) and b (S,); given `left` (F, P), F sets of P groups, those of the first system without each set:
        (F, n), (F,).

        Refined once against Ω itself: an explicit inverse loses digits where γ is large.
        """
        inside = self.known[:, :, None]
        if left is not None:
            inside = np.repeat(inside, len(left), axis=2)
            inside.reshape(-1, m, len(left))[left, :, np.arange(len(left))[:, None]] = 0.0
        alpha, bias = self._applied(inside * self.y[:, :, None], np.zeros((len(self.y), inside.shape[2])), m, left)
        alpha *= inside
        smooth = np.stack([k.omega @ a for k, a in zip(self.kernels, alpha, strict=True)])
        rest = inside * (self.y[:, :, None] - smooth - alpha / self.gamma - bias[:, None])
        more, shift = self._applied(rest, -alpha.sum(axis=1), m, left)
        alpha, bias = alpha + inside * more, bias + shift
        return (alpha[:, :, 0], bias[:, 0]) if left is None else (alpha[0].T, bias[0])

    def _applied(self, right: Array, top: Array, m: int, left: NDArray[np.int64] | None) -> tuple[Array, Array]:
        """The inverse times [top; right] (S, 1 + n, F), with α held at 0 on each column's groups left out."""
        alpha = self.inverse @ right + self.ones[:, :, None] * top[:, None]
        bias = (self.ones[:, None] @ right)[:, 0] + self.corner[:, None] * top
        if left is not None:
            at, every = _rows_of(left, m), np.arange(len(left))
            pull = _solved(self.inverse[0][at[:, :, None], at[:, None, :]], alpha[0][at, every[:, None]])
            held = np.zeros(alpha.shape[1:])
            held[at, every[:, None]] = pull
            alpha = alpha - self.inverse @ held[None]
            bias = bias - self.ones @ held
        return alpha, bias


def _rows_of(groups: NDArray[np.int64], m: int) -> NDArray[np.int64]:
    """Rows (..., P m) of groups (..., P) of m rows each."""
    rows = groups[..., None] * m + np.arange(m)
    return np.asarray(rows.reshape(*groups.shape[:-1], -1))


def _inverses(kernels: Sequence[Kernel], gamma: float) -> Array:
    """(Ω + I/γ)⁻¹ of every kernel, (S, n, n), small ones at once; NaN where it is not positive definite."""
    n = len(kernels[0].omega)
    if len(kernels) > 1 and n < _THIN_FROM_ROWS:
        try:
            root = np.linalg.inv(np.linalg.cholesky(np.stack([k.omega for k in kernels]) + np.eye(n) / gamma))
            return np.asarray(root.transpose(0, 2, 1) @ root)
        except np.linalg.LinAlgError:
            pass  # one of them: the others are kept below
    out = np.empty((len(kernels), n, n))
    for s, kernel in enumerate(kernels):
        try:
            out[s] = kernel.inverse(gamma)
        except np.linalg.LinAlgError:
            out[s] = np.nan
    return out


def _solved(matrices: Array, right: Array) -> Array:
    """Solutions (..., m) of (..., m, m); NaN where a matrix is singular, whatever its neighbours are."""
    try:
        return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0], float)
    except np.linalg.LinAlgError:
        out = np.full(right.shape, np.nan)
        for i in np.ndindex(right.shape[:-1]):
            try:
                out[i] = np.linalg.solve(matrices[i], right[i])
            except np.linalg.LinAlgError:
                continue
    return out
