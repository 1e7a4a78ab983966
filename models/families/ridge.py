"""Family: ridge regression, penalty chosen by leave-batch-out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from models.families.linear import Pool, Tuned
from models.numerics.pooled_sums import mean_diagonal


class Ridge(Tuned):
    """Least squares with the penalty alpha · |coef|².

    The penalty is k times the mean variance of the inputs: alpha = k · trace(XᵀX)/p over the centred training
    rows, k from a logarithmic grid of `n_penalties` between `least` and `most`. `fitted` adds k and alpha (the
    summed penalty, scikit-learn's alpha). Of equal scores the largest k wins.
    """

    key = "ridge"
    summary = "ridge regression, penalty by leave-batch-out inside the training batches"
    source = "Hoerl and Kennard (1970), eq. 2.1"
    has_sd = True
    rank = 12

    def __init__(self, least: float = 1e-6, most: float = 1e2, n_penalties: int = 25) -> None:
        super().__init__()
        if not 0 < least <= most or n_penalties < 1:
            raise InputError(
                f"ridge: least {least}, most {most}, n_penalties {n_penalties}; expected 0 < least <= most and at "
                "least one penalty"
            )
        self.least, self.most, self.n_penalties = least, most, n_penalties

    def _grid(self) -> Array:
        return np.geomspace(self.most, self.least, self.n_penalties)

    def _path(self, pool: Pool) -> Array:
        values, vectors = np.linalg.eigh(pool.xx)
        scores = np.einsum("sji,sj->si", vectors, pool.xy)
        alpha = mean_diagonal(pool.xx)[:, None, None] * self._grid()
        weights = scores[:, :, None] / (np.maximum(values, 0.0)[:, :, None] + alpha)
        out: Array = (vectors @ weights) / pool.scale[:, :, None]
        return out

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        k = self._grid()[chosen]
        return {"k": k, "alpha": k * mean_diagonal(pool.xx)}
