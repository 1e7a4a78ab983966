"""Multiple linear regression."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.base import Array
from models.linear import DIGITS_LEFT, EPS, Linear, Task


class MLR(Linear):
    """Ordinary least squares with intercept; of equally good solutions the one of least norm.

    `condition` tells how far the coefficients can be trusted: with head sensors 10²–10⁴ is usual.
    Where the covariance cannot carry the answer (near-deficient inputs) the fit goes back to the rows.
    """

    key = "mlr"
    words = "multiple linear regression: least squares on all chosen inputs"
    source = "Legendre (1805); minimum norm by singular values: Golub and Kahan (1965)"
    effort = "quick"
    rank = 10

    def _solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        pool = task.pool
        correlation, spread = pool.correlation()
        values, vectors = np.linalg.eigh(correlation)
        with np.errstate(divide="ignore", invalid="ignore"):
            scores = np.einsum("sji,sj->si", vectors, pool.xy / spread) / values
            coef = np.einsum("sji,si->sj", vectors, scores) / (spread * pool.scale)
        for f in np.flatnonzero(~(values[:, 0] * DIGITS_LEFT > values[:, -1] * pool.loss)):
            x, y_um = task.centred_rows(int(f))
            cut = EPS * max(float(pool.count[f]), x.shape[1])
            coef[f] = np.linalg.lstsq(x, y_um, rcond=cut)[0] / pool.scale[f]
        return coef, {}
