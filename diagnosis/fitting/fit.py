"""A fit of a twin part under the covariance of its structure, and what follows from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from data.arrays import Array
from diagnosis.contracts import Point
from diagnosis.fitting.marginal import Grams, Hyper, Level, Marginal
from twin.calibration.fit_problem import Noise, estimate
from twin.calibration.least_squares import State


@dataclass(frozen=True, eq=False)
class Fitted(Point):
    """A point at its best fit under a covariance, at the hyperparameters `hyper` of that.

    `columns` (n_b, p + 1) of every batch are the whitened model, per unit of z, and the target; `runs` that the batches
    come from, where they are blocks of fewer. `nuisance` is where the batches' nuisances were linearised,
    `fitted_nuisance` what they are in this fit.
    """

    marginal: Marginal
    hyper: Hyper
    columns: list[Array]
    runs: int = 0
    base: Fitted | None = None  # that this one was begun from, by another twin part

    @cached_property
    def grams(self) -> Grams:
        return self.marginal.grams(self.columns)

    @property
    def level(self) -> Level:
        return self.marginal.level(self.hyper)

    @cached_property
    def log_evidence(self) -> float:
        """Nats, up to a constant of the recordings (Laplace approximation), of what z shows."""
        return self.level.log_evidence(self.grams, self.z)

    @cached_property
    def log_predictive_density(self) -> Array:
        """Log density (B,) of every batch, predicted from all others, in nats."""
        return self.level.log_predictive_density(self.grams)

    @cached_property
    def fitted_nuisance(self) -> list[Array]:
        """Nuisances (q_b,) of each batch by least squares under the covariance's blocks: a start is no structure."""
        white, blocks = self.marginal.covariance.white, self.problem.linearise(self.x, self.nuisance)
        starts = len(self.problem.nuisances.start_K)  # an effect may add a body to those of the marginal
        every = enumerate(zip(blocks, self.nuisance, strict=True))
        return [
            v + nuisance_step(white(k, b.nuisance), v, white(k, b.residual), self.hyper.nuisance_sds(len(v), starts))
            for k, (b, v) in every
        ]

    @cached_property
    def noise(self) -> Noise:
        """Residual noise of each channel, and how many rows count as one."""
        left = self.problem.residuals(self.x, self.fitted_nuisance)
        return estimate(left, [m.channel for m in self.problem.measured], len(self.problem.channels), len(self.z))

    @cached_property
    def state(self) -> State:
        """The fit as a calibration has it; its information is that with structure integrated out."""
        state = State.at(self.problem, self.z, self.fitted_nuisance, self.noise)
        c = self.level.reduced(self.grams)[:-1, :-1]
        root = np.asarray(np.linalg.cholesky(c + np.eye(len(c))).T, float)
        return replace(state, arrow=replace(state.arrow, root=root, target=np.zeros(len(c))))


def nuisance_step(jacobian: Array, nuisance: Array, left: Array, size: Array | float = 1.0) -> Array:
    """The least-squares step (q,) of a batch's nuisances from `nuisance` for residuals `left` (n,) and priors of sd
    `size`."""
    precision = np.broadcast_to(1.0 / np.asarray(size) ** 2, nuisance.shape)
    normal = jacobian.T @ jacobian + np.diag(precision)
    return np.asarray(np.linalg.solve(normal, jacobian.T @ left - precision * nuisance), float)
