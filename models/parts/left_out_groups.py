"""What a Gaussian process says of groups of rows that it is not shown, from one inverse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LeftOut:
    """C = (K + I)⁻¹ and α = C y over G groups of m rows; K and y are 0 on padding.

    Leaving out the rows g: the residual is C_gg⁻¹ α_g, its covariance C_gg⁻¹. With f left out too, C and α are first
    rid of f by elimination.
    Source: S. Sundararajan and S. Keerthi, Neural Computation 13 (2001), for single rows; C. Rasmussen and
    C. Williams (2006), eqs. 5.10 to 5.12.
    """

    blocks: Array  # (G, G, m, m)
    alpha: Array  # (G, m)

    @classmethod
    def of(cls, inverse: Array, y: Array, m: int) -> LeftOut:
        n_groups = len(y) // m
        blocks = inverse.reshape(n_groups, m, n_groups, m).transpose(0, 2, 1, 3)
        return cls(blocks, (inverse @ y).reshape(n_groups, m))

    def alone(self) -> tuple[Array, Array]:
        """Residual and variance (G, m) of each group left out by itself."""
        return _solved(np.einsum("ggij->gij", self.blocks), self.alpha)

    def beside(self, f: int) -> tuple[Array, Array]:
        """Residual and variance (G, m) of each group when it and group f are left out; of f itself 0 and 1."""
        own = np.linalg.inv(self.blocks[f, f])
        across = self.blocks[:, f] @ own  # C_gf C_ff⁻¹
        rest = np.einsum("ggij->gij", self.blocks) - across @ self.blocks[f]
        alpha = self.alpha - across @ self.alpha[f]
        rest[f], alpha[f] = np.eye(rest.shape[1]), 0.0
        return _solved(rest, alpha)


def _solved(precision: Array, alpha: Array) -> tuple[Array, Array]:
    covariance = np.linalg.inv(precision)
    return (covariance @ alpha[:, :, None])[:, :, 0], np.einsum("gii->gi", covariance).copy()
