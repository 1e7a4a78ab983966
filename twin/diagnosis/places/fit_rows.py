"""A fit's linearised rows, free of what each batch has of its own.

Under Gaussian priors a nuisance only adds to the rows' covariance (Lindley and Smith 1972): what is free of it is
``Xᵀ (1 + N Nᵀ)⁻¹ X``, and the parameters, which all batches share, are the last rows and columns of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import blas, cho_solve, cholesky, solve_triangular

from twin.calibration.fit_noise import Noise, estimate
from twin.calibration.fit_problem import Array, Block
from twin.calibration.problem import CalibrationProblem


@dataclass(frozen=True)
class Optimum:
    """The parameters' step dz (p,) in prior sd, nuisances by batch with those of series held last, the noise left."""

    dz: Array
    nuisance: list[Array]
    noise: Noise


@dataclass(frozen=True)
class FitRows:
    """Blocks by batch, and where the fit stands: parameters z (p,) and nuisances (q_b,), in prior sd.

    Rows and columns of other things are in given noises too; `weight` (channels,) is what a row's square counts.
    """

    problem: CalibrationProblem
    blocks: tuple[Block, ...]
    z: Array
    spread: Array
    nuisance: tuple[Array, ...]

    @classmethod
    def of(cls, problem: CalibrationProblem, x: Array, nuisance: Sequence[Array]) -> FitRows:
        """At free parameters x (p,) in fitting coordinates.

        Raises:
            WorkError: the simulation fails there.
        """
        spread = np.array([u.spread for u in problem.unknowns])
        z = (x - [u.prior for u in problem.unknowns]) / spread
        return cls(problem, tuple(problem.linearise(x, nuisance)), z, spread, tuple(nuisance))

    def gram(self, b: int, columns: Sequence[Array], weight: Array, more: Sequence[Array] = ()) -> Array:
        """Batch b's ``Xᵀ (1 + N Nᵀ)⁻¹ X`` (C, C), X being columns (·, n_b), derivatives by z and the residual.

        `more` (n_b, k) are nuisances N(0, 1) beside the batch's own.
        """
        rows, own, now, _ = self._scaled(b, weight, more)
        rows = np.vstack([*(c * np.sqrt(weight[self.blocks[b].channel]) for c in columns), rows.T])
        seen = rows @ own
        seen[-1] -= now  # the prior's own rows: nuisances stand at `now`, not at 0
        shadow = solve_triangular(self._root(own), seen.T, trans="T", check_finite=False)
        upper = blas.dsyrk(1.0, rows.T, trans=1)
        upper = blas.dsyrk(-1.0, np.asfortranarray(shadow), beta=1.0, c=upper, trans=1, overwrite_c=1)
        return np.asarray(np.triu(upper) + np.triu(upper, 1).T)

    def shared(self, gram: Array) -> tuple[Array, Array]:
        """Information A (p, p), prior included, and pull b (p,) from a sum over batches of Gram matrices of [J r].

        The cost of the parameters z + dz is dzᵀ A dz − 2 bᵀ dz + const.
        """
        return gram[:-1, :-1] + np.eye(len(self.z)), gram[:-1, -1] - self.z

    def optimum(self, held: Sequence[Sequence[Array]], weight: Array) -> Optimum:
        """The linear optimum of all unknowns, series held (n_b, k) by batch, of prior N(0, 1), among them."""
        of_batch = [[h[b] for h in held] for b in range(len(self.blocks))]
        gram = np.sum([self.gram(b, (), weight, more) for b, more in enumerate(of_batch)], axis=0)
        information, pull = self.shared(gram)
        dz = np.linalg.solve(information, pull)
        determined = len(pull) - float(np.trace(np.linalg.inv(information)))
        nuisance, left = [], []
        for b, more in enumerate(of_batch):
            rows, own, now, scale = self._scaled(b, weight, more)
            root, rest = self._root(own), rows[:, -1] - rows[:, :-1] @ dz
            step = cho_solve((root, False), own.T @ rest - now)
            nuisance.append(now + step)
            left.append((rest - own @ step) / scale)
            determined += len(root) - float(np.sum(np.linalg.inv(root) ** 2))
        noise = estimate(left, [b.channel for b in self.blocks], len(weight), determined)
        return Optimum(np.asarray(dz), nuisance, noise)

    def _scaled(self, b: int, weight: Array, more: Sequence[Array]) -> tuple[Array, Array, Array, Array]:
        """Derivatives and residual (n, p + 1), nuisances (n, q) and where they stand (q,), the rows' scale (n,)."""
        block, now = self.blocks[b], self.nuisance[b]
        scale = np.sqrt(weight[block.channel])
        rows = np.column_stack([block.jacobian * self.spread, block.residual]) * scale[:, None]
        own = np.column_stack([block.nuisance, *more]) * scale[:, None]
        return rows, own, np.pad(now, (0, own.shape[1] - len(now))), scale

    @staticmethod
    def _root(own: Array) -> Array:
        """Upper triangular (q, q) of ``1 + Nᵀ N``."""
        return np.asarray(cholesky(np.eye(own.shape[1]) + own.T @ own))
