"""Forced responses: what heat that no source explains would do to every channel of the fitted network.

Heat added to the heat balance makes a linear run with the simulation's own modes, as a parameter's derivative does
(`twin.simulation.sensitivity`); temperature-dependent heat answers to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from twin.calibration.problem import CalibrationProblem
from twin.simulation.channels import Rows, shown
from twin.simulation.run import TOLERANCE_K
from twin.simulation.sensitivity import _Tangents
from twin.simulation.solved import Solved, rows_of, solved_balance
from twin.simulation.tangent_forcing import Unknown

Array = NDArray[np.float64]

MOST_NUMBERS = 6_000_000  # modal heat held at once (50 MB): bodies beyond it are worked out one after the other
KNOT_S = 1800.0  # heat that changes faster is smoothed by any body's capacity
MOST_KNOTS = 25  # of one batch: longer batches have them farther apart


@dataclass(frozen=True)
class Hats:
    """Piecewise-linear basis functions (Schoenberg 1946) over a batch's time: hat k is 1 at `knot_s[k]`, 0 at others.

    `knot_s` (K,) is evenly spaced from 0 and the same in every batch; behind a batch's end hats have no effect.
    """

    knot_s: Array

    @classmethod
    def over(cls, longest_s: float, knot_s: float = KNOT_S) -> Hats:
        """Hats over a time, `knot_s` apart or as many as `MOST_KNOTS`."""
        count = int(np.clip(np.ceil(longest_s / knot_s - 1e-9), 1, MOST_KNOTS - 1))
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
        start, offset = problem.own(nuisance)
        values = problem.values_at(x)[None]
        solved = solved_balance(problem.network, values, problem.own_heat(nuisance), start, TOLERANCE_K, 1, offset)
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
        return rows_of(self.solved, self.problem.inputs.every, 1)

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
        tangents = _Tangents(self.solved, unknowns, cells_degC, self.problem.inputs.every).at_rows(self.rows)
        _, _, readings, errors = shown(self.rows, self.problem.network, tangents)
        return np.concatenate([readings, errors], axis=-1)

    def responses(self, hats: Hats) -> list[Array]:
        """By batch the whitened rows (bodies, K, n_b) of a watt's hat into every body, K hats."""
        inputs = self.problem.inputs
        ends = np.stack([inputs.time_s[:, :-1], inputs.time_s[:, 1:]], axis=-1)
        series = np.moveaxis(hats.at(ends), -1, 0)
        n = len(series)
        together = max(1, MOST_NUMBERS // (series.size * self.problem.network.n_cells))
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
