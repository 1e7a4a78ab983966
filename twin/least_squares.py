"""MAP least squares over batches: parameters with priors, nuisances per batch, convergence told honestly.

Minimises ``Σ |r_b|² + Σ ((x − prior) / spread)² + Σ nuisance²`` by Gauss–Newton steps, damped in the prior's metric
when one fails (Levenberg 1944; damping by gain ratio after Nielsen 1999, IMM-REP-1999-05, eq. 2.21).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from data.errors import InputError, WorkError
from twin.arrow import Arrow, assemble
from twin.fit_noise import Noise, estimate
from twin.fit_problem import Array, Block, Problem, Scale, Unknown

__all__ = ["Block", "Fit", "Problem", "Scale", "Step", "Unknown", "fit"]

SAME_COST = 1e-3  # starts whose costs differ by less, and which lie together, have reached the same optimum
MOST_DAMPING = 1e12
NOISE_ROUNDS, NOISE_SETTLED = 10, 0.03


@dataclass(frozen=True)
class Step:
    """One accepted step: the cost after it, the damping it took and how many tries were rejected before."""

    cost: float
    damping: float
    rejected: int


@dataclass(frozen=True)
class Fit:
    """The optimum and what is known about it; p parameters, B batches, c channels.

    `covariance` (p, p) of x: the inverse of the data's information plus the prior's, nuisances marginalised;
    `information_data` (p, p) without the prior. `dof`: rows less the parameters and nuisances that the data determine.
    `noise_factor` and `inflation` (c,) divide the information as `Noise` says; ones without re-estimation.
    """

    x: Array
    nuisance: list[Array]
    covariance: Array
    information_data: Array
    cost: float
    history: tuple[Step, ...]
    converged: bool
    words: str
    at_bound: tuple[str, ...]
    dof: float
    rows: int
    noise_factor: Array
    inflation: Array


def fit(
    problem: Problem,
    starts: int = 1,
    seed: int = 0,
    max_iterations: int = 60,
    tolerance: float = 1e-6,
    progress: Callable[[str], None] | None = None,
    reweight: bool = False,
) -> Fit:
    """The MAP estimate, best of `starts`: the prior's mean, then draws from the prior by `seed`.

    Converged means that the linear model expects the cost to fall by less than `tolerance` times max(1, cost per
    degree of freedom): x is within √tolerance posterior standard deviations of its optimum. With `reweight` each
    channel's noise and its correlation are re-estimated from the best start's residuals until they settle.

    Raises:
        InputError: no free parameter, or fewer usable rows than free parameters.
        WorkError: the model is not finite at the prior's mean.
    """
    unknowns = problem.unknowns
    if not unknowns:
        raise InputError("calibration: no parameter is free; give at least one a prior spread in the machine file")
    limits = max_iterations, tolerance
    with threadpool_limits(limits=1):  # small matrices: more threads cost time, and results must not depend on them
        best, notes = _best_start(problem, starts, seed, *limits, progress)
        if reweight:
            best, settled = _with_noise(problem, best, *limits, progress)
            notes += settled
        return _result(problem, best, tolerance, notes)


@dataclass(frozen=True)
class _State:
    """A point z with its linearisation there."""

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
    def at(cls, problem: Problem, z: Array, nuisance: list[Array], noise: Noise) -> _State:
        channels: list[NDArray[np.int64]] = []
        squares = [float(z @ z) + sum(float(v @ v) for v in nuisance)]

        def watched(blocks: Iterable[Block]) -> Iterable[Block]:
            for block in blocks:
                channels.append(block.channel)
                squares.append(float(np.sum(noise.weight[block.channel] * block.residual**2)))
                yield block

        with np.errstate(over="ignore", invalid="ignore"):
            blocks = watched(problem.linearise(_x(problem.unknowns, z), nuisance))
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


def _x(unknowns: Sequence[Unknown], z: Array) -> Array:
    return np.array([np.clip(u.prior + u.spread * v, u.low, u.high) for u, v in zip(unknowns, z, strict=True)])


def _z_bounds(unknowns: Sequence[Unknown]) -> tuple[Array, Array]:
    low = np.array([(u.low - u.prior) / u.spread for u in unknowns])
    return low, np.array([(u.high - u.prior) / u.spread for u in unknowns])


def _starts(unknowns: Sequence[Unknown], starts: int, seed: int) -> Array:
    """Where to start, in z (starts, p): the prior's mean, then draws from the prior, put within the bounds."""
    draws = np.random.default_rng(seed).standard_normal((max(1, starts), len(unknowns)))
    draws[0] = 0.0
    return np.clip(draws, *_z_bounds(unknowns))


def _best_start(
    problem: Problem,
    starts: int,
    seed: int,
    max_iterations: int,
    tolerance: float,
    progress: Callable[[str], None] | None,
) -> tuple[_State, str]:
    """The lowest end of all starts, and what the others did in words."""
    ends: list[_State] = []
    lost = 0
    for number, z in enumerate(_starts(problem.unknowns, starts, seed)):
        try:
            nuisance = [np.zeros(q) for q in problem.nuisance_sizes]
            start = _State.at(problem, z, nuisance, Noise.as_given(len(problem.channels)))
        except WorkError as error:
            if number == 0:
                raise WorkError(f"calibration: the model fails at the prior's mean: {error}") from None
            lost += 1
            continue
        ends.append(_descend(problem, start, max_iterations, tolerance))
        if progress:
            progress(f"start {number + 1} of {starts}: cost {ends[-1].cost:.6g} after {len(ends[-1].history)} steps")
    best = min(ends, key=lambda e: e.cost)
    return best, _starts_in_words(best, ends, starts, lost)


def _descend(problem: Problem, state: _State, max_iterations: int, tolerance: float) -> _State:
    """From a state down to an optimum, or as far as the iterations go. Only accepted steps are linearised."""
    low, high = _z_bounds(problem.unknowns)
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


def _try(problem: Problem, state: _State, dz: Array, share: float) -> tuple[_State | None, float]:
    """The state after a step and its gain ratio (real fall over expected), or None where the step must be rejected."""
    z = state.z + dz
    nuisance = [v + c.step(dz, share) for v, c in zip(state.nuisance, state.arrow.corners, strict=True)]
    cost = float(z @ z) + sum(float(v @ v) for v in nuisance)
    weight = state.noise.weight
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            for residual, channel in zip(
                problem.residuals(_x(problem.unknowns, z), nuisance), state.channels, strict=True
            ):
                cost += float(np.sum(weight[channel] * residual**2))
        expected = state.arrow.gain(dz, share)
        ratio = (state.cost - cost) / expected if expected > 0 else -1.0
        if not np.isfinite(cost) or ratio < 1e-3:
            return None, 0.0
        return _State.at(problem, z, nuisance, state.noise), ratio
    except WorkError:
        return None, 0.0


def _with_noise(
    problem: Problem, state: _State, max_iterations: int, tolerance: float, progress: Callable[[str], None] | None
) -> tuple[_State, str]:
    """The optimum under noise that is re-estimated from its own residuals, and how that went in words."""
    change = np.inf
    for number in range(NOISE_ROUNDS):
        residuals = problem.residuals(_x(problem.unknowns, state.z), state.nuisance)
        parameters = state.arrow.effective_parameters()
        noise = estimate(residuals, state.channels, len(problem.channels), parameters)
        change = noise.change(state.noise)
        if change < NOISE_SETTLED:
            return state, f"; noise settled in round {number}"
        start = _State.at(problem, state.z, state.nuisance, noise)
        state = _descend(problem, replace(start, history=state.history), max_iterations, tolerance)
        if progress:
            progress(f"noise round {number + 1}: weights changed by up to {100 * change:.0f} %")
    return state, f"; noise not settled: weights still change by {100 * change:.0f} % a round"


def _starts_in_words(best: _State, ends: Sequence[_State], starts: int, lost: int) -> str:
    """How many starts reached the best one's optimum, and whether another place fits as well."""
    if starts < 2:
        return ""
    root = best.arrow.root
    alike = [e for e in ends if e.cost <= best.cost * (1 + SAME_COST)]
    near = max(1.0, 4 * SAME_COST * best.cost)
    same = [e for e in alike if float(np.sum((root @ (e.z - best.z)) ** 2)) <= near]
    words = f"; {len(same)} of {starts} starts reached this optimum (cost within {100 * SAME_COST:g} %)"
    elsewhere = len(alike) - len(same)
    if elsewhere:
        words += f"; {elsewhere} ended elsewhere at the same cost, so the recordings do not tell these apart"
    return words + (f"; {lost} could not be simulated" if lost else "")


def _result(problem: Problem, state: _State, tolerance: float, notes: str) -> Fit:
    unknowns, steps = problem.unknowns, len(state.history)
    converged = state.small(tolerance)
    if converged:
        words = f"converged after {steps} step{'' if steps == 1 else 's'}"
    elif state.stuck:
        words = (
            f"stopped after {steps} steps: no step lowers the cost, though the linear model expects "
            f"{_percent(state.expected / state.cost)}; the derivatives do not fit the model or it is not smooth"
        )
    else:
        costs = [s.cost for s in state.history[-2:]]
        fall = 1 - costs[1] / costs[0] if len(costs) == 2 else state.expected / state.cost
        words = f"stopped after {steps} steps, cost still falling by {_percent(fall)} a step"
    x = _x(unknowns, state.z)
    at_bound = tuple(u.name for u, v in zip(unknowns, x, strict=True) if v in (u.low, u.high))
    if at_bound:
        notes += f"; at its bound: {', '.join(at_bound)}"
    spread = np.array([u.spread for u in unknowns])
    scale = np.outer(spread, spread)
    return Fit(
        x=x,
        nuisance=state.nuisance,
        covariance=state.arrow.covariance * scale,
        information_data=state.arrow.information / scale,
        cost=state.cost,
        history=tuple(state.history),
        converged=converged,
        words=words + notes,
        at_bound=at_bound,
        dof=state.rows - state.arrow.effective_parameters(),
        rows=state.rows,
        noise_factor=state.noise.factor,
        inflation=state.noise.inflation,
    )


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
