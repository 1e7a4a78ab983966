"""A fit whose rows remember each other: generalised least squares with the memory that the fit itself leaves.

Rows divided by a channel's own misfit and by the rows that count as one would let a fit give a channel up: what a
smooth misfit of tens of standard deviations costs there is little, and many white rows elsewhere are bought with it.
Filtered by its memory (`memory`), a slow misfit costs what it is worth and what is sharp counts in full.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from twin.calibration.descent import State, descend, x_of
from twin.calibration.fit_noise import Noise
from twin.calibration.fit_problem import Array, Block, Problem, Unknown
from twin.calibration.problem import CalibrationProblem
from twin.diagnosis.scoring.memory import Memory, memory_of

STANDS = 0.1  # of a prior's standard deviation: a round that moves no parameter further is the last


@dataclass(frozen=True)
class Filtered:
    """Implements `twin.calibration.fit_problem.Problem`: the problem's rows less what those before foretell."""

    problem: CalibrationProblem
    memory: Memory

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return self.problem.unknowns

    @property
    def channels(self) -> tuple[str, ...]:
        return self.problem.channels

    @property
    def nuisance_sizes(self) -> tuple[int, ...]:
        return self.problem.nuisance_sizes

    def linearise(self, x: Array, nuisance: Sequence[Array]) -> Iterator[Block]:
        for block in self.problem.linearise(x, nuisance):
            p = block.jacobian.shape[1]
            rows = self._innovations(np.column_stack([block.residual, block.jacobian, block.nuisance]), block.channel)
            yield replace(block, residual=rows[:, 0], jacobian=rows[:, 1 : p + 1], nuisance=rows[:, p + 1 :])

    def residuals(self, x: Array, nuisance: Sequence[Array]) -> list[Array]:
        every = zip(self.problem.residuals(x, nuisance), self.problem.measured, strict=True)
        return [self._innovations(rows, m.channel) for rows, m in every]

    def noise_at(self, z: Array, nuisance: Sequence[Array], parameters: float = 0.0) -> Noise:
        """The standard deviation of the rows of each channel, at least the given noise; `parameters` were fitted."""
        square, rows = np.zeros(len(self.channels)), np.zeros(len(self.channels))
        for left, m in zip(self.residuals(x_of(self.unknowns, z), nuisance), self.problem.measured, strict=True):
            square += np.bincount(m.channel, weights=left**2, minlength=len(square))
            rows += np.bincount(m.channel, minlength=len(rows))
        left_over = max(1.0 - parameters / max(1.0, rows.sum()), 0.1)
        factor = np.sqrt(square / (np.maximum(rows, 1.0) * left_over))
        return Noise(np.maximum(factor, 1.0), np.ones(len(factor)))

    def _innovations(self, rows: Array, channel: NDArray[np.int64]) -> Array:
        starts = np.flatnonzero(np.diff(channel, prepend=-1))
        ends = np.append(starts[1:], len(channel))
        every = zip(channel[starts].tolist(), starts.tolist(), ends.tolist(), strict=True)
        return np.concatenate([self.memory.filtered(c, rows[a:b]) for c, a, b in every])


def memory_left(problem: CalibrationProblem, z: Array, nuisance: Sequence[Array]) -> Memory:
    """What the rows of each channel remember of each other at a point."""
    left = problem.residuals(x_of(problem.unknowns, z), nuisance)
    return memory_of(left, [m.channel for m in problem.measured], len(problem.channels))


def own_first(problem: Problem, z: Array, nuisance: Sequence[Array], noise: Noise) -> list[Array]:
    """Where each batch's own unknowns follow to at z: their steps are safe."""
    state = State.at(problem, z, list(nuisance), noise)
    still = np.zeros(len(z))
    return [v + c.step(still) for v, c in zip(state.nuisance, state.arrow.corners, strict=True)]


def settled(problem: CalibrationProblem, state: State, steps: int, tolerance: float, rounds: int) -> State:
    """Down from a state, memory and noise estimated anew in every round of so many steps, until they stand."""
    for _ in range(rounds):
        filtered = Filtered(problem, memory_left(problem, state.z, state.nuisance))
        noise = filtered.noise_at(state.z, state.nuisance, state.arrow.effective_parameters())
        start = State.at(filtered, state.z, state.nuisance, noise)
        new = descend(filtered, start, steps, tolerance)
        stands = bool(np.abs(new.z - state.z).max(initial=0.0) < STANDS)
        state = new
        if stands:
            break
    return state
