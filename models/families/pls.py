"""Family: partial least squares, number of components chosen by leave-batch-out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from models.families.linear import EPS, Pool, Tuned

_EXHAUSTED = 1e-9  # remaining covariance with the error, relative to the first: below it there is only rounding


class PLS(Tuned):
    """Partial least squares on the centred rises: components of largest covariance with the error.

    At most `max_components`; the number by leave-batch-out inside the training batches. For one error channel the
    components span a Krylov space of the covariance, so only cross-products are needed. `fitted` adds n_components.
    """

    key = "pls"
    summary = "partial least squares, number of components by leave-batch-out inside the training batches"
    source = "Wold, Martens and Wold (1983); from cross-products: de Jong and ter Braak (1994)"
    rank = 14

    def __init__(self, max_components: int = 10) -> None:
        super().__init__()
        if max_components < 1:
            raise InputError(f"pls: max_components {max_components}; expected at least 1")
        self.max_components = max_components

    def _path(self, pool: Pool) -> Array:
        path = krylov_path(pool.xx, pool.xy, min(self.max_components, pool.xy.shape[1]))
        out: Array = path / pool.scale[:, :, None]
        return out

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {"n_components": chosen + 1}


def krylov_path(xx: Array, xy: Array, n_components: int) -> Array:
    """PLS coefficients (S, p, c) with 1 … n_components from xx (S, p, p) and xy (S, p); constant once exhausted."""
    sets, p = xy.shape
    path = np.empty((sets, p, n_components))
    r, u = np.zeros((n_components, sets, p)), np.zeros((n_components, sets, p))
    variance = np.ones((n_components, sets))
    beta, gradient = np.zeros_like(xy), xy.copy()
    enough = _EXHAUSTED * np.linalg.norm(xy, axis=1)
    least = EPS * np.einsum("sjj->s", xx)
    live = np.ones(sets, bool)
    for a in range(n_components):
        size = np.linalg.norm(gradient, axis=1)
        live &= size > enough
        w = gradient / np.where(live, size, 1.0)[:, None]
        for _ in range(2 if a else 0):  # twice: rounding leaves residuals of earlier components
            w = w - np.einsum("as,asj->sj", np.einsum("asj,sj->as", u[:a], w) / variance[:a], r[:a])
        image = np.einsum("sij,sj->si", xx, w)
        square = np.einsum("sj,sj->s", w, image)
        live &= square > least * np.einsum("sj,sj->s", w, w)
        variance[a] = np.where(live, square, 1.0)
        weight = np.where(live, np.einsum("sj,sj->s", w, gradient) / variance[a], 0.0)
        r[a], u[a] = w * live[:, None], image * live[:, None]
        beta = beta + weight[:, None] * r[a]
        gradient = gradient - weight[:, None] * u[a]
        path[:, :, a] = beta
    return path
