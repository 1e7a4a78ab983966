"""Down from one start: Gauss–Newton steps, damped in the prior's metric when one fails.

Levenberg (1944); the damping follows the gain ratio as Nielsen (1999), IMM-REP-1999-05, eq. 2.21.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError, WorkError
from twin.calibration.arrow import Arrow, assemble
from twin.calibration.fit_noise import Noise
from twin.calibration.fit_problem import Array, Block, Problem, Unknown

MOST_DAMPING = 1e12


@dataclass(frozen=True)
class Step:
    """One accepted step: the cost after it, the damping it took and how many tries were rejected before."""

    cost: float
    damping: float
    rejected: int


@dataclass(frozen=True)
class State:
    """A point z (p,) = (x − prior) / spread with its linearisation there; `channels` of every batch's rows."""

    z: Array
    nuisance: list[Array]
    cost: float
    arrow: Arrow
    channels: list[NDArray[np.int64]]
    noise: Noise
    expected: float = np.inf  # by how much the linear model expects the undamped step to lower the cost
    stuck: bool = False
    history: list[Step] = field(default_factory=list)

    @classmethod
    def at(cls, problem: Problem, z: Array, nuisance: list[Array], noise: Noise) -> State:
        """Linearised at z.

        Raises:
            WorkError: not finite there, or the simulation failed.
            InputError: fewer rows than parameters.
        """
        channels: list[NDArray[np.int64]] = []
        squares = [float(z @ z) + sum(float(v @ v) for v in nuisance)]

        def watched(blocks: Iterable[Block]) -> Iterable[Block]:
            for block in blocks:
                channels.append(block.channel)
                squares.append(float(np.sum(noise.weight[block.channel] * block.residual**2)))
                yield block

        with np.errstate(over="ignore", invalid="ignore"):
            blocks = watched(problem.linearise(x_of(problem.unknowns, z), nuisance))
            arrow = assemble(blocks, nuisance, z, problem.unknowns, noise.weight)
        rows = sum(map(len, channels))
        if rows < len(z):
            raise InputError(
                f"calibration: {rows} usable rows for {len(z)} free parameters; "
                "give more batches or channels, or make parameters fixed in the machine file"
            )
        return cls(z, nuisance, sum(squares), arrow, channels, noise)

    @property
    def rows(self) -> int:
        return sum(map(len, self.channels))

    def small(self, tolerance: float) -> bool:
        """Is what a further step could gain below the tolerance?"""
        dof = max(1.0, self.rows - self.arrow.effective_parameters())
        return self.expected <= tolerance * max(1.0, self.cost / dof)


def x_of(unknowns: Sequence[Unknown], z: Array) -> Array:
    """Fitting coordinates x (p,) at z (p,), never outside the bounds by rounding."""
    prior, spread, low, high = np.array([(u.prior, u.spread, u.low, u.high) for u in unknowns]).reshape(-1, 4).T
    return np.clip(prior + spread * z, low, high)


def z_bounds(unknowns: Sequence[Unknown]) -> tuple[Array, Array]:
    """Lower and upper bounds in z, (p,) each."""
    low = np.array([(u.low - u.prior) / u.spread for u in unknowns])
    return low, np.array([(u.high - u.prior) / u.spread for u in unknowns])


def descend(problem: Problem, state: State, max_iterations: int, tolerance: float) -> State:
    """From a state down to an optimum, or as far as the iterations go. Only accepted steps are linearised."""
    low, high = z_bounds(problem.unknowns)
    damping = 0.0
    while True:
        full = state.arrow.step(0.0, low - state.z, high - state.z)
        state = replace(state, expected=state.arrow.gain(full))
        if state.small(tolerance) or len(state.history) >= max_iterations:
            return state
        growth, rejected = 4.0, 0
        while True:
            dz = full if damping == 0 else state.arrow.step(damping, low - state.z, high - state.z)
            # Nuisances take their whole step unless damping alone has not helped.
            share = min(1.0, 1e4 / damping) if damping > 0 else 1.0
            moved, ratio = _try(problem, state, dz, share)
            if moved is not None:
                break
            rejected += 1
            damping, growth = max(1.0, damping * growth), growth * 2
            if damping > MOST_DAMPING:
                return replace(state, stuck=True)
        history = [*state.history, Step(moved.cost, damping, rejected)]
        state = replace(moved, history=history)
        damping *= max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
        damping = 0.0 if damping < 1e-3 else damping


def _try(problem: Problem, state: State, dz: Array, share: float) -> tuple[State | None, float]:
    """The state after a step and its gain ratio (real fall over expected), or None where the step must be rejected."""
    z = state.z + dz
    nuisance = [v + c.step(dz, share) for v, c in zip(state.nuisance, state.arrow.corners, strict=True)]
    cost = float(z @ z) + sum(float(v @ v) for v in nuisance)
    weight = state.noise.weight
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            for residual, channel in zip(
                problem.residuals(x_of(problem.unknowns, z), nuisance), state.channels, strict=True
            ):
                cost += float(np.sum(weight[channel] * residual**2))
        expected = state.arrow.gain(dz, share)
        ratio = (state.cost - cost) / expected if expected > 0 else -1.0
        if not np.isfinite(cost) or ratio < 1e-3:
            return None, 0.0
        return State.at(problem, z, nuisance, state.noise), ratio
    except (WorkError, InputError):  # the simulation refuses values that no machine has: too far a step
        return None, 0.0
