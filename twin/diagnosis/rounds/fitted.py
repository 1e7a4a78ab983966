"""A twin part at its best fit, and how well it predicts batches left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from data.batch import Batch
from data.machine import Machine
from twin.calibration.annealing import SETTLED, noise_left, with_noise
from twin.calibration.descent import State, descend, x_of, z_bounds
from twin.calibration.fit_noise import Noise
from twin.calibration.fit_problem import Array
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.diagnosis.scoring.carried import carried_nuisances, carried_z, on_network
from twin.diagnosis.scoring.memory import Memory, memory_of
from twin.schema import TwinPart

NEAR, FAR = "_near", "_far"  # how pieces of a body are called
STEPS, TOLERANCE = 2, 0.1  # of a refit: whether a candidate is in the running needs no more


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
        left = self.problem.residuals(self.x, self.state.nuisance)
        return memory_of(left, self.state.channels, len(self.problem.channels))

    @property
    def step_s(self) -> float:
        """The longest spacing of the recordings' rows."""
        return max(b.step_s for b in self.batches)

    @cached_property
    def rows(self) -> Array:
        """Rows (K,) of each channel in all batches."""
        return np.bincount(np.concatenate(self.state.channels), minlength=len(self.problem.channels)).astype(float)


def pieces_of(part: TwinPart) -> dict[str, str]:
    """The bodies that are pieces of others around or far from a sensor, as a finer network states them."""
    out = {}
    for name in part.bodies:
        for end in (NEAR, FAR):
            if name.endswith(end):
                ends = next((link.between for link in part.links.values() if link.between[0] == name), None)
                if ends is not None:
                    out[name] = ends[1]
    return out


def refitted(
    old: Fitted, part: TwinPart, at: Mapping[str, float] | None = None, steps: int = STEPS, tolerance: float = TOLERANCE
) -> Fitted:
    """The same recordings fitted by a changed twin part, from the old fit; `at` gives values where to begin.

    What is new begins otherwise at its value in the part, which is its prior's centre where that is not stated.

    The noise is estimated again before every step, so that a channel which the old fit had given up counts again; no
    channel is given up for a start that is still far off.

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
    state = State.at(problem, z, nuisance, old.state.noise)
    still = np.zeros(len(z))  # what each batch has of its own follows first: its steps are safe
    own = [v + c.step(still) for v, c in zip(state.nuisance, state.arrow.corners, strict=True)]
    state = State.at(problem, z, own, old.state.noise)
    for _ in range(steps):
        state = with_noise(problem, state, _least(state.noise, noise_left(problem, state)))
        state = descend(problem, state, len(state.history) + 1, tolerance)
    state = with_noise(problem, state, noise_left(problem, state))
    return replace(old, part=part, problem=problem, state=state)


def _least(one: Noise, other: Noise) -> Noise:
    return Noise(np.minimum(one.factor, other.factor), np.minimum(one.inflation, other.inflation))


def settle(fitted: Fitted, steps: int = 20, tolerance: float = 0.01, rounds: int = 4) -> Fitted:
    """The same fit taken on to its optimum, the noise estimated until it stands."""
    problem, state = fitted.problem, fitted.state
    for _ in range(rounds):
        state = descend(problem, state, len(state.history) + steps, tolerance)
        noise = noise_left(problem, state)
        change = noise.change(state.noise)
        state = with_noise(problem, state, noise)
        if change < SETTLED:
            break
    return replace(fitted, state=state)
