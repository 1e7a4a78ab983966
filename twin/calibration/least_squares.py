"""MAP least squares over batches: parameters with priors, nuisances per batch, with diagnosed convergence.

Minimises ``Σ |r_b|² + Σ ((x − prior) / spread)² + Σ nuisance²`` from one or several starts, on batches whose
nuisances are eliminated one batch at a time (`arrow`), with the noise as given or re-estimated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from data.arrays import Array
from data.errors import InputError, WorkError
from twin.calibration.arrow import Arrow, assemble
from twin.calibration.fit_problem import Block, Noise, Problem, Unknown, estimate, x_of, z_bounds

MOST_DAMPING = 1e12


@dataclass(frozen=True)
class Step:
    """One accepted step: the cost after it and how many tries were rejected before."""

    cost: float
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
        """Linearised at z (p,) and the batches' nuisances (q_b,).

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
        """True if the expected gain of a further step is below the tolerance."""
        dof = max(1.0, self.rows - self.arrow.effective_parameters())
        return self.expected <= tolerance * max(1.0, self.cost / dof)


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
        history = [*state.history, Step(moved.cost, rejected)]
        state = replace(moved, history=history)
        damping *= max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3)
        damping = 0.0 if damping < 1e-3 else damping


def _try(problem: Problem, state: State, dz: Array, share: float) -> tuple[State | None, float]:
    """The state after a step and its gain ratio (actual over expected decrease), or None where the step must be
    rejected."""
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


MISFIT, SMOOTH = 3.0, 5.0  # noise factor and rows that count as one: above both, a channel shows no noise but misfit
CONVERGED = 0.2  # change of a channel's weight in a round: 10 % of its sd, below what a few batches determine


def noise_left(problem: Problem, state: State) -> Noise:
    """The noise of each channel from the residuals of a state."""
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
    """Descent from a state until the noise converges, one step a round under the noise that is left.

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
        if change < CONVERGED or state.stuck or not steps < len(state.history) < max_iterations:
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
    inflation = np.minimum(*(n.inflation for n in noises))
    level = [log_posterior(problem, s, n, inflation) for s, n in zip((one, other), noises, strict=True)]
    return one if level[0] >= level[1] else other


def log_posterior(problem: Problem, state: State, noise: Noise, inflation: Array) -> float:
    """Nats, up to a constant, under the residual noise of a state; so many rows (c,) of a channel count as one."""
    rows = np.bincount(np.concatenate(state.channels), minlength=len(problem.channels)) / inflation
    priors = float(state.z @ state.z) + sum(float(v @ v) for v in state.nuisance)
    return -0.5 * (priors + float(np.sum(rows * np.log(noise.factor**2))))


SAME_COST = 1e-3  # starts whose costs differ by less, and which lie together, have reached the same optimum
# What a model's rounding and its derivatives may hide of the cost, where no step lowers it any more. An undamped step
# that promises g is sqrt(g) posterior standard deviations long: x is known to a third of one, all parameters together.
MODEL_NOISE = 0.1
NOISE_ROUNDS = 10


@dataclass(frozen=True)
class Fit:
    """The optimum and what is known about it; p parameters, B batches, c channels.

    `covariance` (p, p) of x: the inverse of the data's information plus the prior's, nuisances marginalised.
    `dof`: rows less the parameters and nuisances that the data determine.
    `noise_factor` and `inflation` (c,) divide the information, see `Noise`; ones without re-estimation.
    """

    x: Array
    nuisance: list[Array]
    covariance: Array
    cost: float
    history: tuple[Step, ...]
    converged: bool
    message: str
    at_bound: tuple[str, ...]
    dof: float
    rows: int
    noise_factor: Array
    inflation: Array


@dataclass(frozen=True)
class FitOptions:
    """How a fit searches.

    `starts`: the prior's mean, then draws from the prior by `seed`; the best is kept. Converged means that the linear
    model expects the cost to fall by less than `tolerance` times max(1, cost per degree of freedom): x is within
    √tolerance posterior standard deviations of its optimum. With `reweight` each channel's noise and its correlation
    are estimated on the way down from the prior's mean (`annealed`) and then from the residuals of the best start until
    they converge.
    """

    starts: int = 1
    seed: int = 0
    max_iterations: int = 60
    tolerance: float = 1e-6
    reweight: bool = False


_DEFAULT = FitOptions()


def fit(problem: Problem, options: FitOptions = _DEFAULT, progress: Callable[[str], None] | None = None) -> Fit:
    """The MAP estimate.

    Raises:
        InputError: no free parameter, or fewer usable rows than free parameters.
        WorkError: the model is not finite at the prior's mean.
    """
    best, notes = converge(problem, options, progress)
    return result(problem, best, options.tolerance, notes)


def converge(
    problem: Problem,
    options: FitOptions = _DEFAULT,
    progress: Callable[[str], None] | None = None,
    noise: Noise | None = None,
) -> tuple[State, str]:
    """Where `fit` ends, with the linearisation there, and remarks on the way; arguments and errors as there.

    `noise` is the initial noise, by default as given.
    """
    if not problem.unknowns:
        raise InputError("calibration: no parameter is free; give at least one a prior spread in the machine file")
    with _threads().limit(limits=1):  # small matrices: more threads cost time, and results must not depend on them
        first = _first(problem, noise, options, progress)
        best, notes = _best_start(problem, first, options, progress)
        if options.reweight:
            best, changed = _with_noise(problem, best, options, progress)
            notes += changed
        return best, notes


@cache
def _threads() -> ThreadpoolController:
    return ThreadpoolController()  # searches every loaded library: once is enough


def _starts(unknowns: Sequence[Unknown], starts: int, seed: int) -> Array:
    """Where to start, in z (starts, p): the prior's mean, then draws from the prior, put within the bounds."""
    draws = np.random.default_rng(seed).standard_normal((max(1, starts), len(unknowns)))
    draws[0] = 0.0
    return np.clip(draws, *z_bounds(unknowns))


def _first(problem: Problem, noise: Noise | None, options: FitOptions, progress: Callable[[str], None] | None) -> State:
    """The prior's mean, or what lies below it with the noise estimated on the way."""
    z, nuisance = _starts(problem.unknowns, 1, 0)[0], [np.zeros(q) for q in problem.nuisance_sizes]
    try:
        state = State.at(problem, z, nuisance, noise or Noise.as_given(len(problem.channels)))
    except WorkError as error:
        raise WorkError(f"calibration: the model fails at the prior's mean: {error}") from None
    if not options.reweight:
        return state
    max_iterations, tolerance = options.max_iterations, options.tolerance
    down = annealed(problem, state, max_iterations, tolerance, progress)
    if len(down.history) >= max_iterations or not misfits(noise_left(problem, down)):
        return down
    # From above, a misfit can pass for noise and stop the fit there: once more, every row counting in full.
    full = annealed(problem, down, len(down.history) + max_iterations, tolerance, progress, correlated=False)
    full = annealed(problem, full, len(full.history) + max_iterations, tolerance, progress)
    return likelier(problem, down, full)


def _best_start(
    problem: Problem, first: State, options: FitOptions, progress: Callable[[str], None] | None
) -> tuple[State, str]:
    """The lowest end of all starts, and remarks on the others."""
    starts = options.starts
    ends: list[State] = []
    lost = 0
    for number, z in enumerate(_starts(problem.unknowns, starts, options.seed)):
        try:
            nuisance = [np.zeros(q) for q in problem.nuisance_sizes]
            start = State.at(problem, z, nuisance, first.noise) if number else first
        except WorkError:
            lost += 1
            continue
        ends.append(descend(problem, start, len(start.history) + options.max_iterations, options.tolerance))
        if progress:
            progress(f"start {number + 1} of {starts}: cost {ends[-1].cost:.6g} after {len(ends[-1].history)} steps")
    best = min(ends, key=lambda e: e.cost)
    return best, _starts_in_words(best, ends, starts, lost)


def _with_noise(
    problem: Problem, state: State, options: FitOptions, progress: Callable[[str], None] | None
) -> tuple[State, str]:
    """The optimum under noise that is re-estimated from its own residuals, and a remark on it."""
    change = np.inf
    for number in range(NOISE_ROUNDS):
        noise = noise_left(problem, state)
        change = noise.change(state.noise)
        if change < CONVERGED:
            return state, f"; noise converged in round {number}"
        start = with_noise(problem, state, noise)
        state = descend(problem, start, len(start.history) + options.max_iterations, options.tolerance)
        if progress:
            progress(f"noise round {number + 1}: weights changed by up to {100 * change:.0f} %")
    return state, f"; noise not converged: weights still change by {100 * change:.0f} % a round"


def _starts_in_words(best: State, ends: Sequence[State], starts: int, lost: int) -> str:
    """How many starts reached the best one's optimum, and whether another place fits as well."""
    if starts < 2:
        return ""
    root = best.arrow.root
    alike = [e for e in ends if e.cost <= best.cost * (1 + SAME_COST)]
    near = max(1.0, 4 * SAME_COST * best.cost)
    same = [e for e in alike if float(np.sum((root @ (e.z - best.z)) ** 2)) <= near]
    remark = f"; {len(same)} of {starts} starts reached this optimum (cost within {100 * SAME_COST:g} %)"
    elsewhere = len(alike) - len(same)
    if elsewhere:
        remark += f"; {elsewhere} ended elsewhere at the same cost, so the recordings do not distinguish them"
    return remark + (f"; {lost} could not be simulated" if lost else "")


def result(problem: Problem, state: State, tolerance: float, notes: str) -> Fit:
    """What `fit` returns for the state where it ended."""
    unknowns, steps = problem.unknowns, len(state.history)
    by_noise = state.stuck and state.small(MODEL_NOISE)
    converged = by_noise or state.small(tolerance)
    if converged:
        message = f"converged after {steps} step{'' if steps == 1 else 's'}"
        if by_noise and not state.small(MODEL_NOISE / 100):
            message += (
                f" as far as the derivatives are exact, to {np.sqrt(state.expected):.2g} posterior standard deviations"
            )
        elif by_noise:
            message += " as far as the model is smooth"
    elif state.stuck:
        message = (
            f"stopped after {steps} steps: no step lowers the cost, though the linear model expects "
            f"{_percent(state.expected / state.cost)}; the derivatives do not fit the model or it is not smooth"
        )
    else:
        decrease = state.expected / state.cost  # costs of the history may be under other noise
        message = f"stopped after {steps} steps, cost still falling by {_percent(decrease)} a step"
    x = x_of(unknowns, state.z)
    low, high = z_bounds(unknowns)
    touching = (state.z <= low + 1e-9) | (state.z >= high - 1e-9)
    at_bound = tuple(u.name for u, touches in zip(unknowns, touching, strict=True) if touches)
    if at_bound:
        notes += f"; at its bound: {', '.join(at_bound)}"
    spread = np.array([u.spread for u in unknowns])
    return Fit(
        x=x,
        nuisance=state.nuisance,
        covariance=state.arrow.covariance * np.outer(spread, spread),
        cost=state.cost,
        history=tuple(state.history),
        converged=converged,
        message=message + notes,
        at_bound=at_bound,
        dof=state.rows - state.arrow.effective_parameters(),
        rows=state.rows,
        noise_factor=state.noise.factor,
        inflation=state.noise.inflation,
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
