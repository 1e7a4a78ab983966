"""Multiple linear regression."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from models.families.linear import DIGITS_LEFT, EPS, Linear, Pool, Task


class MLR(Linear):
    """Ordinary least squares; of equally good solutions the one of least norm.

    `condition` bounds the accuracy of the coefficients: with head sensors 10²–10⁴ is usual.
    Where the covariance cannot carry the answer (near-deficient inputs) the fit goes back to the rows.
    """

    key = "mlr"
    summary = "multiple linear regression: least squares on all chosen inputs"
    source = "Legendre (1805); minimum norm by singular values: Golub and Kahan (1965)"
    has_sd = True
    rank = 10

    def _solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        pool = task.pool
        coef, values = _from_sums(pool)
        for f in np.flatnonzero(~(values[:, 0] * DIGITS_LEFT > values[:, -1] * pool.loss)):
            x, y_um = task.centred_rows(int(f))
            cut = EPS * max(float(pool.count[f]), x.shape[1])
            coef[f] = np.linalg.lstsq(x, y_um, rcond=cut)[0] / pool.scale[f]
        first = np.zeros(len(task.masks), np.int64)
        return coef, self._spread(task, lambda inner: _from_sums(inner)[0][:, :, None], first)


def _from_sums(pool: Pool) -> tuple[Array, Array]:
    """Coefficients (S, p) and eigenvalues (S, p) of the correlation; eigenvalues below rounding are dropped."""
    correlation, spread = pool.correlation()
    values, vectors = np.linalg.eigh(correlation)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(values > EPS * values[:, -1:], 1.0 / values, 0.0)
        scores = np.einsum("sji,sj->si", vectors, pool.xy / spread) * inverse
    return np.einsum("sji,si->sj", vectors, scores) / (spread * pool.scale), values
