"""The bordered matrix of an LS-SVM: its inverse, and left-out residuals of whole groups from that inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

Array = NDArray[np.float64]

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
    def of(cls, kernels: list[Kernel], known: Array, y: Array, gamma: float) -> Self:
        n = y.shape[1]
        inverse = np.empty((len(kernels), n, n))
        for s, kernel in enumerate(kernels):
            try:
                inverse[s] = kernel.inverse(gamma)
            except np.linalg.LinAlgError:
                inverse[s] = np.nan
        u = (inverse @ known[:, :, None])[..., 0]
        corner = -1.0 / (u * known).sum(axis=1)
        ones = -corner[:, None] * u
        for s in range(len(kernels)):
            inverse[s] -= u[s][:, None] * ones[s]
        return cls(kernels, known, y, gamma, inverse, ones, corner, (inverse @ y[:, :, None])[..., 0])

    def left_out(self, m: int) -> Array:
        """Residuals (S, G, m) of each group when it is left out: `C_gg⁻¹ α_g`."""
        s, n = self.alpha.shape
        own = np.einsum("sgigj->sgij", self.inverse.reshape(s, n // m, m, n // m, m))
        return _solved(own, self.alpha.reshape(s, n // m, m))

    def pairs_left_out(self, m: int) -> Array:
        """Residuals (G, G, m) of the first system: [f, g] those of group g when f and g are both left out.

        `C_PP⁻¹ α_P` over the rows P of both, by elimination of f; one solve serves [f, g] and [g, f].
        Source: G. Cawley, Leave-one-out cross-validation based model selection criteria for weighted LS-SVMs (2006).
        """
        n = self.alpha.shape[1]
        n_groups = n // m
        blocks = self.inverse[0].reshape(n_groups, m, n_groups, m).transpose(0, 2, 1, 3)
        alpha = self.alpha[0].reshape(n_groups, m)
        alone = self.left_out(m)[0]
        f, g = np.triu_indices(n_groups, 1)
        own = np.einsum("ggij->gij", blocks)
        try:
            across = np.linalg.inv(own) @ self.inverse[0].reshape(n_groups, m, n)
        except np.linalg.LinAlgError:
            return np.full((n_groups, n_groups, m), np.nan)
        across = across.reshape(n_groups, m, n_groups, m).transpose(0, 2, 1, 3)[f, g]  # C_ff⁻¹ C_fg
        to_f = blocks[g, f]
        rest = own[g] - to_f @ across
        out = np.full((n_groups, n_groups, m), np.nan)
        e_g = _solved(rest, alpha[g] - (to_f @ alone[f][:, :, None])[..., 0])
        out[f, g] = e_g
        out[g, f] = alone[f] - (across @ e_g[:, :, None])[..., 0]
        return out

    def solutions(self, m: int, left: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
        """α (S, n) and b (S,); given `left` those of the first system, one for each group left out (F, n), (F,).

        Refined once against Ω itself: an explicit inverse loses digits where γ is large.
        """
        inside = self.known[:, :, None]
        if left is not None:
            inside = np.repeat(inside, len(left), axis=2)
            inside.reshape(-1, m, len(left))[left, :, np.arange(len(left))] = 0.0
        alpha, bias = self._applied(inside * self.y[:, :, None], np.zeros((len(self.y), inside.shape[2])), m, left)
        alpha *= inside
        smooth = np.stack([k.omega @ a for k, a in zip(self.kernels, alpha, strict=True)])
        rest = inside * (self.y[:, :, None] - smooth - alpha / self.gamma - bias[:, None])
        more, shift = self._applied(rest, -alpha.sum(axis=1), m, left)
        alpha, bias = alpha + inside * more, bias + shift
        return (alpha[:, :, 0], bias[:, 0]) if left is None else (alpha[0].T, bias[0])

    def _applied(self, right: Array, top: Array, m: int, left: NDArray[np.int64] | None) -> tuple[Array, Array]:
        """The inverse times [top; right] (S, 1 + n, F), with α held at 0 on each column's group left out."""
        alpha = self.inverse @ right + self.ones[:, :, None] * top[:, None]
        bias = (self.ones[:, None] @ right)[:, 0] + self.corner[:, None] * top
        if left is not None:
            n, at = self.alpha.shape[1], np.arange(len(left))
            own = self.inverse[0].reshape(n // m, m, n // m, m)[left, :, left]
            pull = _solved(own, alpha[0].reshape(n // m, m, -1)[left, :, at])
            held = np.zeros((n // m, m, len(left)))
            held[left, :, at] = pull
            alpha = alpha - self.inverse @ held.reshape(1, n, -1)
            bias = bias - self.ones @ held.reshape(n, -1)
        return alpha, bias


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
