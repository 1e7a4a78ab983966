"""Down from the priors' mean with the noise estimated on the way, from above.

A model with a smooth misfit, taken at the noise that its file states, is bent until it follows the misfit, and noise
estimated there is too small to undo it. So the first noise is what the priors' mean leaves over, and every step's
residuals lower it (a graduated fit, Blake & Zisserman 1987, "Visual Reconstruction", §7).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from twin.calibration.descent import State, descend, x_of
from twin.calibration.fit_noise import Noise, estimate
from twin.calibration.fit_problem import Problem

SETTLED = 0.2  # change of a channel's weight in a round: 10 % of its sd, less than residuals of a few batches tell


def noise_left(problem: Problem, state: State) -> Noise:
    """The noise of each channel from what a state leaves over."""
    residuals = problem.residuals(x_of(problem.unknowns, state.z), state.nuisance)
    return estimate(residuals, state.channels, len(problem.channels), state.arrow.effective_parameters())


def with_noise(problem: Problem, state: State, noise: Noise) -> State:
    """The same point under another noise, its history kept."""
    return replace(State.at(problem, state.z, state.nuisance, noise), history=state.history)


def annealed(
    problem: Problem,
    state: State,
    max_iterations: int,
    tolerance: float,
    progress: Callable[[str], None] | None = None,
) -> State:
    """From a state at the priors' mean down until the noise settles, one step a round under the noise that is left.

    Raises:
        WorkError: not finite on the way.
    """
    still = np.zeros(len(state.z))
    own = [v + c.step(still) for v, c in zip(state.nuisance, state.arrow.corners, strict=True)]
    state = State.at(problem, state.z, own, state.noise)
    noise = noise_left(problem, state)
    while True:
        steps = len(state.history)
        state = descend(problem, with_noise(problem, state, noise), steps + 1, tolerance)
        noise = noise_left(problem, state)
        change = noise.change(state.noise)
        if progress:
            progress(f"step {len(state.history)}: noise weights changed by up to {100 * change:.0f} %")
        if change < SETTLED or state.stuck or not steps < len(state.history) < max_iterations:
            return state
