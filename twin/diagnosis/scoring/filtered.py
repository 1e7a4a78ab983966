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
from twin.diagnosis.scoring.memory import Memory, memory_of, slices_of

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

    def noise_of(self, left: Sequence[Array], parameters: float = 0.0) -> Noise:
        """The standard deviation of the innovations of each channel in rows left over (n_b,), at least the given
        noise; `parameters` were fitted."""
        own = [self._innovations(rows, m.channel) for rows, m in zip(left, self.problem.measured, strict=True)]
        square = square_sums(self.problem, own)
        rows = np.bincount(np.concatenate([m.channel for m in self.problem.measured]), minlength=len(square))
        left_over = max(1.0 - parameters / max(1.0, rows.sum()), 0.1)
        factor = np.sqrt(square / (np.maximum(rows, 1.0) * left_over))
        return Noise(np.maximum(factor, 1.0), np.ones(len(factor)))

    def _innovations(self, rows: Array, channel: NDArray[np.int64]) -> Array:
        return self.memory.filtered(slices_of(channel), rows)


def square_sums(problem: CalibrationProblem, rows: Sequence[Array]) -> Array:
    """Sums (K,) over each channel of the squares of every batch's rows (n_b,)."""
    k = len(problem.channels)
    every = [np.bincount(m.channel, r**2, k) for m, r in zip(problem.measured, rows, strict=True)]
    return np.asarray(np.sum(every, axis=0))


def memory_left(problem: CalibrationProblem, left: Sequence[Array]) -> Memory:
    """What the rows of each channel remember of each other in rows left over (n_b,)."""
    return memory_of(left, [m.channel for m in problem.measured], len(problem.channels))


def left_where_own_follow(problem: Problem, state: State) -> list[Array]:
    """The rows (n_b,) that would be left once each batch's own unknowns follow to the state's z: these act linearly."""
    still = np.zeros(len(state.z))
    blocks = problem.linearise(x_of(problem.unknowns, state.z), state.nuisance)
    return [b.residual - b.nuisance @ c.step(still) for b, c in zip(blocks, state.arrow.corners, strict=True)]


def settled(problem: CalibrationProblem, state: State, steps: int, tolerance: float, rounds: int) -> State:
    """Down from a state, memory and noise estimated anew in every round of so many steps, until they stand."""
    for _ in range(rounds):
        left = problem.residuals(x_of(problem.unknowns, state.z), state.nuisance)
        filtered = Filtered(problem, memory_left(problem, left))
        noise = filtered.noise_of(left, state.arrow.effective_parameters())
        before = state.z
        state = descend(filtered, State.at(filtered, before, state.nuisance, noise), steps, tolerance)
        if np.abs(state.z - before).max(initial=0.0) < STANDS:
            break
    return state
