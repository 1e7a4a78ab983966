"""A twin part at its best fit, and how well it predicts batches left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from data.batch import Batch
from data.machine import Machine
from twin.calibration.descent import State, descend, x_of, z_bounds
from twin.calibration.fit_noise import Noise
from twin.calibration.fit_problem import Array
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.diagnosis.proposals.pieces import pieces_of
from twin.diagnosis.scoring.carried import carried_nuisances, carried_z, on_network
from twin.diagnosis.scoring.filtered import Filtered, left_where_own_follow, memory_left, settled
from twin.diagnosis.scoring.memory import Memory, whiter
from twin.schema import TwinPart

STEPS, TOLERANCE = 1, 0.1  # of a refit: whether a candidate is in the running needs no more


@dataclass(frozen=True, eq=False)  # one is the same as itself alone: what is worked out of it may be kept by it
class Fitted:
    """A twin part at its best fit: the problem that its recordings pose and where the descent ended."""

    machine: Machine
    part: TwinPart
    batches: tuple[Batch, ...]
    problem: CalibrationProblem
    state: State
    runs: int = 0  # that the batches come from, where they are blocks of fewer

    @cached_property
    def x(self) -> Array:
        return x_of(self.problem.unknowns, self.state.z)

    @cached_property
    def values(self) -> Array:
        """Parameter values (n,) of the network."""
        return self.problem.values_at(self.x)

    @cached_property
    def memory(self) -> Memory:
        """What the rows of each channel remember of each other, in what this fit leaves over."""
        return memory_left(self.problem, self._left)

    @cached_property
    def noise(self) -> Noise:
        """What this fit leaves over in each channel, and how many rows count as one."""
        filtered = Filtered(self.problem, self.memory)
        return replace(
            filtered.noise_of(self._left, self.state.arrow.effective_parameters()), inflation=self.memory.inflation
        )

    @cached_property
    def _left(self) -> list[Array]:
        return self.problem.residuals(self.x, self.state.nuisance)

    @property
    def step_s(self) -> float:
        """The longest spacing of the recordings' rows."""
        return max(b.step_s for b in self.batches)

    @cached_property
    def rows(self) -> Array:
        """Rows (K,) of each channel in all batches."""
        return np.bincount(np.concatenate(self.state.channels), minlength=len(self.problem.channels)).astype(float)


def refitted(
    old: Fitted, part: TwinPart, at: Mapping[str, float] | None = None, steps: int = STEPS, tolerance: float = TOLERANCE
) -> Fitted:
    """The same recordings fitted by a changed twin part, from the old fit; `at` gives values where to begin.

    What is new begins otherwise at its value in the part, which is its prior's centre where that is not stated.

    Noise and memory are estimated again before every step; no channel counts as noisier, and no row remembers longer,
    than in the old fit: none is given up for a start that is still far off.

    Raises:
        InputError: the part does not compile; WorkError: it cannot be simulated there.
    """
    network = compile_network(old.machine, part=part)
    problem = on_network(old.problem, old.batches, network, free_starts=True, pieces=pieces_of(part))
    z = carried_z(old.problem, problem, old.state.z)
    known = {u.name for u in old.problem.unknowns}
    for k, u in enumerate(problem.unknowns):
        p = network.parameters[network.index(u.name)]
        begin = at.get(u.name) if at else None
        if begin is None and u.name not in known:
            begin = p.value
        if begin is not None:
            z[k] = (float(p.to_x(begin)) - u.prior) / u.spread
    z = np.clip(z, *z_bounds(problem.unknowns))
    nuisance = carried_nuisances(old.problem, problem, old.state.nuisance)
    state = State.at(
        Filtered(problem, old.memory), z, nuisance, Noise(old.noise.factor, np.ones(len(problem.channels)))
    )
    left = left_where_own_follow(problem, state)
    filtered, state = _counted(old, problem, state, left, old.state.arrow.effective_parameters())
    for _ in range(steps):
        state = descend(filtered, state, 1, tolerance)
        left = problem.residuals(x_of(problem.unknowns, state.z), state.nuisance)
        filtered, state = _counted(old, problem, state, left, state.arrow.effective_parameters())
    return replace(old, part=part, problem=problem, state=state)


def _counted(
    old: Fitted, problem: CalibrationProblem, state: State, left: list[Array], parameters: float
) -> tuple[Filtered, State]:
    """The state with rows that remember no longer, and channels no noisier, than in the old fit and in what is left."""
    filtered = Filtered(problem, whiter(old.memory, memory_left(problem, left)))
    here = filtered.noise_of(left, parameters)
    noise = replace(state.noise, factor=np.minimum(here.factor, state.noise.factor))
    return filtered, State.at(filtered, state.z, state.nuisance, noise)


def settle(fitted: Fitted, steps: int = 4, tolerance: float = 0.01, rounds: int = 10) -> Fitted:
    """The same fit taken on to its optimum, noise and memory estimated until it stands."""
    return replace(fitted, state=settled(fitted.problem, fitted.state, steps, tolerance, rounds))
