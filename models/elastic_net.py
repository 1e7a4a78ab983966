"""Family: elastic net, penalty and mixing chosen by leave-batch-out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from models.linear import Pool, Task, Tuned
from models.solvers.penalised import sparse_coefficients


class ElasticNet(Tuned):
    """Least squares that shrinks coefficients and sets some of them to zero.

    Minimises `|y − X β|²/(2 n) + α (ρ |β|₁ + (1 − ρ) |β|²/2)` over the centred training rows. ρ is one of `mixings`
    (1 is the lasso). α is k times the α above which every coefficient is zero, k from a logarithmic grid of
    `n_penalties` between 1 and `least`. `fitted` adds k, alpha (scikit-learn's), mixing and n_active. Of equal scores
    the strongest penalty wins, then the first mixing. Solved exactly by active sets on the covariances, no rows.
    """

    key = "elastic_net"
    summary = "elastic net, penalty and mixing by leave-batch-out inside the training batches"
    source = "Zou and Hastie (2005), eq. 3; active sets: Lee, Battle, Raina and Ng (2007), algorithm 1"
    rank = 15

    def __init__(self, mixings: Sequence[float] = (1.0, 0.5, 0.1), least: float = 1e-5, n_penalties: int = 21) -> None:
        super().__init__()
        self.mixings, self.least, self.n_penalties = [float(m) for m in mixings], float(least), int(n_penalties)
        if not self.mixings or not all(0 < m <= 1 for m in self.mixings) or not 0 < least <= 1 or n_penalties < 1:
            raise InputError(
                f"elastic_net: mixings {self.mixings}, least {least}, n_penalties {n_penalties}; expected mixings "
                "above 0 and at most 1 (ridge is a family of its own), least likewise, and at least one penalty"
            )

    def _grid(self) -> tuple[Array, Array]:
        """k and ρ of every setting, (G,) each."""
        k = np.geomspace(1.0, self.least, self.n_penalties)
        return np.repeat(k, len(self.mixings)), np.tile(self.mixings, self.n_penalties)

    def _path(self, pool: Pool) -> Array:
        n = np.maximum(pool.count, 1.0)
        xx, xy = pool.xx / n[:, None, None], pool.xy / n[:, None]
        k, mixing = self._grid()
        path = np.empty((*xy.shape, len(k)))
        m = len(self.mixings)
        beta = np.zeros((len(xy) * m, xy.shape[1]))
        xx_m, xy_m, highest = (np.repeat(a, m, axis=0) for a in (xx, xy, np.abs(xy).max(axis=1)))
        for g in range(0, len(k), m):
            absolute = k[g] * highest
            square = absolute * np.tile(1.0 / mixing[g : g + m] - 1.0, len(xy))
            beta = sparse_coefficients(xx_m, xy_m, absolute, square, beta)
            path[:, :, g : g + m] = beta.reshape(len(xy), m, -1).transpose(0, 2, 1)
        out: Array = path / pool.scale[:, :, None]
        return out

    def _refit(self, task: Task, chosen: NDArray[np.int64]) -> tuple[Array, dict[str, NDArray[Any]]]:
        coef, setting = super()._refit(task, chosen)
        return coef, setting | {"n_active": np.count_nonzero(coef, axis=1)}

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        k, mixing = self._grid()
        highest = np.abs(pool.xy).max(axis=1) / np.maximum(pool.count, 1.0)
        return {"k": k[chosen], "alpha": k[chosen] * highest / mixing[chosen], "mixing": mixing[chosen]}
