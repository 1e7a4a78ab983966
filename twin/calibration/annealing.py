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

MISFIT, SMOOTH = 3.0, 5.0  # noise factor and rows that count as one: above both, a channel shows no noise but misfit
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
    correlated: bool = True,
) -> State:
    """From a state down until the noise settles, one step a round under the noise that is left.

    With `correlated` False every row counts in full, however smooth the residuals are.

    Raises:
        WorkError: not finite on the way.
    """
    still = np.zeros(len(state.z))
    own = [v + c.step(still) for v, c in zip(state.nuisance, state.arrow.corners, strict=True)]
    state = State.at(problem, state.z, own, state.noise)

    def left() -> Noise:
        noise = noise_left(problem, state)
        return noise if correlated else replace(noise, inflation=np.ones_like(noise.inflation))

    noise = left()
    while True:
        steps = len(state.history)
        state = descend(problem, with_noise(problem, state, noise), steps + 1, tolerance)
        noise = left()
        change = noise.change(state.noise)
        if progress:
            progress(f"step {len(state.history)}: noise weights changed by up to {100 * change:.0f} %")
        if change < SETTLED or state.stuck or not steps < len(state.history) < max_iterations:
            return state


def misfits(noise: Noise) -> bool:
    """Whether what is called noise in some channel is far above the instrument's and smooth: a missed optimum?"""
    return bool(np.any((noise.factor > MISFIT) & (noise.inflation > SMOOTH)))


def likelier(problem: Problem, one: State, other: State) -> State:
    """The state of the higher posterior when every channel's noise is unknown, sum n log(rms²) + priors.

    Rows that count as one are those of the state whose residuals are less correlated, for both: each state's own would
    reward the smoother misfit.
    """
    noises = [noise_left(problem, s) for s in (one, other)]
    every_row = np.bincount(np.concatenate(one.channels), minlength=len(problem.channels))
    rows = every_row / np.minimum(noises[0].inflation, noises[1].inflation)

    def cost(state: State, noise: Noise) -> float:
        priors = float(state.z @ state.z) + sum(float(v @ v) for v in state.nuisance)
        return priors + float(np.sum(rows * np.log(noise.factor**2)))

    return one if cost(one, noises[0]) <= cost(other, noises[1]) else other
