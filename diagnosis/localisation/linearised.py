"""A fit's linearised rows, free of what each batch has of its own.

Under Gaussian priors a nuisance only adds to the rows' covariance (Lindley and Smith 1972): what is free of it is
``Xᵀ (1 + N Nᵀ)⁻¹ X``, and the parameters, which all batches share, are the last rows and columns of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import blas, cho_solve, cholesky, solve_triangular

from data.arrays import Array
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import Block, Noise, estimate
from twin.calibration.problem import CalibrationProblem
from twin.simulation.channels import Rows, shown
from twin.simulation.run import TOLERANCE_K, Solved, rows_of, solved_balance
from twin.simulation.sensitivity import Unknown, _Tangents


@dataclass(frozen=True)
class Optimum:
    """The parameters' step dz (p,) in prior sd, nuisances by batch with those of series held last, the noise left."""

    dz: Array
    nuisance: list[Array]
    noise: Noise


@dataclass(frozen=True)
class FitRows:
    """Blocks by batch, and the point of the fit: parameters z (p,) and nuisances (q_b,), in prior sd.

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

        `more` (n_b, k) are nuisances N(0, 1) in addition to the batch's own.
        """
        rows, own, now, _ = self._scaled(b, weight, more)
        rows = np.vstack([*(c * np.sqrt(weight[self.blocks[b].channel]) for c in columns), rows.T])
        seen = rows @ own
        seen[-1] -= now  # the prior's own rows: nuisances are at `now`, not at 0
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
        """Derivatives and residual (n, p + 1), nuisances (n, q) and their values (q,), the rows' scale (n,)."""
        block, now = self.blocks[b], self.nuisance[b]
        scale = np.sqrt(weight[block.channel])
        rows = np.column_stack([block.jacobian * self.spread, block.residual]) * scale[:, None]
        own = np.column_stack([block.nuisance, *more]) * scale[:, None]
        return rows, own, np.pad(now, (0, own.shape[1] - len(now))), scale

    @staticmethod
    def _root(own: Array) -> Array:
        """Upper triangular (q, q) of ``1 + Nᵀ N``."""
        return np.asarray(cholesky(np.eye(own.shape[1]) + own.T @ own))


MAX_MODAL_VALUES = 6_000_000  # modal heat held at once (50 MB): bodies beyond it are worked out one after the other


@dataclass(frozen=True)
class Hats:
    """Piecewise-linear basis functions (Schoenberg 1946) over a batch's time: hat k is 1 at `knot_s[k]`, 0 at others.

    `knot_s` (K,) is evenly spaced from 0 and the same in every batch; behind a batch's end hats have no effect.
    """

    knot_s: Array

    @classmethod
    def over(cls, longest_s: float, knot_s: float = POLICY.knot_spacing_s) -> Hats:
        """Hats over a time, `knot_s` apart or as many as `max_knots`."""
        count = int(np.clip(np.ceil(longest_s / knot_s - 1e-9), 1, POLICY.max_knots - 1))
        return cls(np.linspace(0.0, longest_s, count + 1))

    @property
    def step_s(self) -> float:
        return float(self.knot_s[1])

    def at(self, time_s: Array) -> Array:
        """Values (..., K) at times (...)."""
        return np.clip(1.0 - np.abs(time_s[..., None] - self.knot_s) / self.step_s, 0.0, 1.0)


@dataclass(frozen=True)
class ForcedNetwork:
    """A calibrated network, solved once at its fit; B batches, M intervals, K rows of the recordings, C channels."""

    problem: CalibrationProblem
    solved: Solved

    @classmethod
    def of(cls, problem: CalibrationProblem, x: Array, nuisance: Sequence[Array]) -> ForcedNetwork:
        """At the free parameters' fitting coordinates x (p,) and the batches' nuisances.

        Raises:
            WorkError: the simulation fails there.
        """
        values = problem.values_at(x)[None]
        solved = solved_balance(problem.network, values, *problem.inputs_at(nuisance), TOLERANCE_K)
        return cls(problem, solved)

    @cached_property
    def weights(self) -> Array:
        """Every body's cells (bodies, N), whose weights sum to 1: a watt spreads over them evenly."""
        network = self.problem.network
        out = np.zeros((len(network.bodies), network.n_cells))
        for k, cells in enumerate(network.bodies.values()):
            out[k, cells] = 1.0 / len(cells)
        return out

    @cached_property
    def rows(self) -> Rows:
        return rows_of(self.solved, 1)

    def answers(self, into: Array, series_W: Array) -> Array:
        """Channels (Q, B, K, C) in their units by Q heat series.

        `into` (Q, N) says where a watt goes, `series_W` (Q, B, M, 2) are the ends of every interval.
        """
        n_regimes = self.solved.balance.regimes.count
        unknowns = [
            Unknown(pairs=[(np.repeat(to[None], n_regimes, axis=0), watts)])
            for to, watts in zip(into, series_W, strict=True)
        ]
        cells_degC = self.solved.states.at(np.eye(self.problem.network.n_cells)[None])[0]
        tangents = _Tangents(self.solved, unknowns, cells_degC).at_rows(self.rows)
        _, _, readings, errors = shown(self.rows, self.problem.network, tangents)
        return np.concatenate([readings, errors], axis=-1)

    def responses(self, hats: Hats) -> list[Array]:
        """By batch the whitened rows (bodies, K, n_b) of a watt's hat into every body, K hats."""
        inputs = self.problem.inputs
        ends = np.stack([inputs.time_s[:, :-1], inputs.time_s[:, 1:]], axis=-1)
        series = np.moveaxis(hats.at(ends), -1, 0)
        n = len(series)
        together = max(1, MAX_MODAL_VALUES // (series.size * self.problem.network.n_cells))
        parts: list[list[Array]] = [[] for _ in self.problem.measured]
        for first in range(0, len(self.weights), together):
            into = np.repeat(self.weights[first : first + together], n, axis=0)
            channels = self.answers(into, np.tile(series, (len(into) // n, 1, 1, 1)))
            for part, rows in zip(parts, whitened(self.problem, channels), strict=True):
                part.append(rows.reshape(-1, n, rows.shape[-1]))
        return [np.concatenate(part) for part in parts]


def whitened(problem: CalibrationProblem, channels: Array) -> list[Array]:
    """By batch the rows (Q, n_b) of channels (Q, B, K, C), divided by their noise, errors less their first sample."""
    return [m.of(channels[:, b]) / problem.noise[m.channel] for b, m in enumerate(problem.measured)]


def on_channels(problem: CalibrationProblem, hats: Hats, channels: Sequence[int]) -> list[Array]:
    """By batch the whitened rows (channels, K, n_b) of a unit's hat put on each channel itself, K hats."""
    out = []
    for b, m in enumerate(problem.measured):
        time_s = problem.inputs.time_s[b, :: problem.inputs.every]
        shape = hats.at(time_s)  # (rows, K)
        rows = np.zeros((len(channels), len(hats.knot_s), len(m.row)))
        for k, c in enumerate(channels):
            at = m.channel == c
            start = shape[m.first[c]] if m.is_error[c] else np.zeros(shape.shape[1])
            rows[k][:, at] = (shape[m.row[at]] - start).T / problem.noise[c]
        out.append(rows)
    return out
