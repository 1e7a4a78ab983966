"""Fits of a twin part to recordings: the baseline, refits with a changed part, predictions of batches left out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from diagnosis.contracts import Fitted, pieces_of
from diagnosis.fitting.regression import Filtered, Whitened, left_where_own_follow, memory_left, settle_filtered, whiter
from diagnosis.policy import POLICY
from twin.calibration.estimate import check_batches
from twin.calibration.fit_problem import Noise
from twin.calibration.least_squares import FitOptions, State, descend, settled, x_of, z_bounds
from twin.calibration.problem import EVERY_S, CalibrationProblem, Nuisances
from twin.compile import compile_network
from twin.network import Network
from twin.schema import TwinPart
from twin.simulation.inputs import Inputs, inputs_of

_NO_PIECES: Mapping[str, str] = {}


def on_network(
    problem: CalibrationProblem,
    batches: Sequence[Batch],
    network: Network,
    free_starts: bool = False,
    pieces: Mapping[str, str] = _NO_PIECES,
) -> CalibrationProblem:
    """The calibration problem of the same recordings with another network (more bodies, laws or drivers).

    A new body starts at the temperature of the body that it is linked with most strongly; with `free_starts` its start
    is an unknown of each batch. `pieces`, {piece: body}, start with their body: with a start of its own a piece would
    be a heat store that no body is.
    """
    inputs = problem.inputs
    if not _drives(inputs, network):
        inputs = inputs_of(network, list(batches)).refined(inputs.every)
    start = np.full((problem.inputs.n_batches, network.n_cells), np.nan)
    nuisances = Nuisances.of(network)
    start_K = nuisances.start_K.copy()
    for name, cells in network.bodies.items():
        before = problem.start_degC[:, problem.network.bodies[name]] if name in problem.network.bodies else None
        if before is not None:  # a body that is cut finer starts at its mean
            start[:, cells] = before if before.shape[1] == len(cells) else before.mean(axis=1, keepdims=True)
    for k, (name, cells) in enumerate(network.bodies.items()):
        if name not in problem.network.bodies:
            start[:, cells] = _beside(network, start, cells)[:, None]
            if len(start_K) and name in pieces:
                start_K[list(network.bodies).index(pieces[name]), cells] = network.start_spread_K
            if len(start_K) and (not free_starts or name in pieces):
                start_K[k] = 0.0
    return CalibrationProblem(network, inputs, problem.measured, start, replace(nuisances, start_K=start_K))


def _drives(inputs: Inputs, network: Network) -> bool:
    """Whether the inputs of another network hold all that drives this one, so that they can be used again."""
    recorded = {s.channel for s in network.surroundings if s.channel}
    first = {*(r.channel for r in network.readings), *(c for s in network.surroundings for c in s.first)}
    drivers = set(network.drivers) <= set(inputs.drivers)
    return drivers and recorded == set(inputs.recorded) and first <= set(inputs.first)


def carried_nuisances(old: CalibrationProblem, new: CalibrationProblem, nuisance: Sequence[Array]) -> list[Array]:
    """Each batch's own unknowns in the new network's order; new ones are at their prior mean, 0."""
    names, before = _names(new), {name: k for k, name in enumerate(_names(old))}
    out = []
    for own in nuisance:
        shared = np.array([own[before[n]] if n in before else 0.0 for n in names])
        out.append(np.concatenate([shared, own[old.nuisances.shared :]]))
    return out


def carried_z(old: CalibrationProblem, new: CalibrationProblem, z: Array) -> Array:
    """z (p,) of the new problem: parameters that both problems fit at their old values, others at their prior means."""
    by_name = {u.name: u.prior + u.spread * v for u, v in zip(old.unknowns, z, strict=True)}
    return np.array([(by_name.get(u.name, u.prior) - u.prior) / u.spread for u in new.unknowns])


def _names(problem: CalibrationProblem) -> list[str]:
    bodies = list(problem.network.bodies) if len(problem.nuisances.start_K) else []
    air = [f"surrounding {problem.network.surroundings[s].name}" for s in problem.nuisances.surroundings]
    varying = [problem.network.parameters[k].name for k in problem.nuisances.parameters]
    return bodies + air + varying


def _beside(network: Network, start: Array, cells: NDArray[np.int64]) -> Array:
    """The start temperature (B,) of the known cell that new ones are linked with most strongly."""
    conductance = -network.conductance_W_per_K(network.values)[cells].sum(axis=0)
    conductance[np.isnan(start[0])] = -np.inf
    return np.asarray(start[:, int(np.argmax(conductance))])


def carried_start(
    old: Fitted, part: TwinPart, at: Mapping[str, float] | None = None
) -> tuple[CalibrationProblem, Array, list[Array]]:
    """The problem of a changed twin part, and z (p,) and the batches' own unknowns where its fit begins.

    `at` gives start values by parameter name; other new parameters start at their value in the part.

    Raises:
        InputError: the part does not compile.
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
    return problem, z, carried_nuisances(old.problem, problem, old.state.nuisance)


def refitted(
    old: Fitted,
    part: TwinPart,
    at: Mapping[str, float] | None = None,
    steps: int = POLICY.refit_steps,
    tolerance: float = POLICY.refit_tolerance,
) -> Fitted:
    """The same recordings fitted by a changed twin part, starting from the old fit.

    `at` gives start values by parameter name; other new parameters start at their value in the part.

    Noise and memory are estimated before every step, and neither exceeds that of the old fit: a start that is still far
    off must not make a channel count for less.

    Raises:
        InputError: the part does not compile; WorkError: it cannot be simulated there.
    """
    problem, z, nuisance = carried_start(old, part, at)
    z = np.clip(z, *z_bounds(problem.unknowns))
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
    """The state with memory and noise of the residuals `left`, neither above that of the old fit."""
    filtered = Filtered(problem, whiter(old.memory, memory_left(problem, left)))
    here = filtered.noise_of(left, parameters)
    noise = replace(state.noise, factor=np.minimum(here.factor, state.noise.factor))
    return filtered, State.at(filtered, state.z, state.nuisance, noise)


def settle(
    fitted: Fitted,
    steps: int = POLICY.settle_steps,
    tolerance: float = POLICY.settle_tolerance,
    rounds: int = POLICY.settle_rounds,
) -> Fitted:
    """The fit continued to its optimum, with noise and memory estimated in every round until no parameter moves."""
    return replace(fitted, state=settle_filtered(fitted.problem, fitted.state, steps, tolerance, rounds))


def check(machine: Machine, batches: Sequence[Batch]) -> None:
    """Raises InputError: no batches, one of another machine, or the same twice."""
    if not batches:
        raise InputError(f"machine {machine.machine}: no batches to diagnose; give recordings")
    check_batches(machine, batches)


def baseline(
    machine: Machine,
    part: TwinPart,
    batches: Sequence[Batch],
    progress: Callable[[str, int, int], None] | None = None,
    runs: int = 0,
) -> Fitted:
    """The twin part fitted to all batches, with noise and memory of every channel estimated from its residuals.

    `runs` is the number of runs, where batches are blocks of fewer.

    Raises:
        InputError: batches of another machine, twice the same, or that cannot be simulated.
        WorkError: the model fails at the priors' means.
    """
    check(machine, batches)
    problem = CalibrationProblem.of(compile_network(machine, part=part), batches, spacing_s(batches))
    steps = 0

    def count(_: str) -> None:
        nonlocal steps
        steps += 1
        if progress:
            progress("baseline", steps, 0)

    k = len(problem.channels)
    alike = Noise(np.full(k, POLICY.initial_noise_factor), np.full(k, POLICY.initial_rows_per_value))
    options = FitOptions(max_iterations=POLICY.baseline_steps, tolerance=POLICY.baseline_tolerance)
    state, _ = settled(problem, options, count, alike)
    return settle(Fitted(machine, part, tuple(batches), problem, state, runs or len(batches)))


def spacing_s(batches: Sequence[Batch]) -> float:
    """Seconds between the rows that are fitted."""
    lengths = sorted(b.step_s * b.n_rows for b in batches) or [
        0.0
    ]  # an empty recording is refused where it is simulated
    return min(EVERY_S, lengths[len(lengths) // 2] / POLICY.min_rows_per_batch) or EVERY_S


RMS_COLUMNS = ("batch", "channel", "unit", "rows", "rms")


@dataclass(frozen=True)
class LeftOutRows:
    """Measured less predicted (n_b,) of every batch in the channels' units, and the rms by batch and channel."""

    error: list[Array]
    rms: pd.DataFrame


@lru_cache(maxsize=8)
def left_out_rows(fitted: Fitted) -> LeftOutRows:
    """Every batch predicted by the fit to all others.

    Its own starts and zeros are those of plain least squares: an error is stated in the unit of its channel, and what
    counts a drift as memory leaves a zero almost free.
    """
    problem, state = fitted.problem, fitted.state
    weight = 1.0 / fitted.noise.factor**2
    blocks = list(problem.linearise(fitted.x, state.nuisance))
    rows = [
        Whitened.at(b, v, state.z, problem.unknowns, (), weight, fitted.memory)
        for b, v in zip(blocks, state.nuisance, strict=True)
    ]
    own = [w.jacobian.T @ w.jacobian for w in rows]
    to = [w.jacobian.T @ w.target for w in rows]
    information, total = np.sum(own, axis=0) + np.eye(len(state.z)), np.sum(to, axis=0)
    low, high = z_bounds(problem.unknowns)
    spread = np.array([u.spread for u in problem.unknowns])
    every_z = [
        np.clip(cho_solve(cho_factor(information - own[k]), total - to[k]), low, high) for k in range(len(blocks))
    ]
    nuisance = []
    for k, (block, w, z) in enumerate(zip(blocks, rows, every_z, strict=True)):
        moved = block.residual + block.nuisance @ state.nuisance[k] - block.jacobian @ (spread * (z - state.z))
        nuisance.append(_least_squares(*((part.T * w.scale).T for part in (block.nuisance, moved))))
    return _rows_left(problem, every_z, nuisance)


def rows_as_given(fitted: Fitted) -> LeftOutRows:
    """Every batch predicted by the machine file's own values; its starts and zeros alone are fitted."""
    problem = fitted.problem
    z = np.zeros(len(problem.unknowns))
    nuisance = [np.zeros_like(own) for own in fitted.state.nuisance]
    for _ in range(2):  # starts enter the temperatures linearly, through laws nearly so
        blocks = problem.linearise(x_of(problem.unknowns, z), nuisance)
        nuisance = [
            _least_squares(b.nuisance, b.residual + b.nuisance @ own) for b, own in zip(blocks, nuisance, strict=True)
        ]
    return _rows_left(problem, [z] * len(nuisance), nuisance)


def worsened(before: LeftOutRows, after: LeftOutRows) -> dict[str, tuple[float, float]]:
    """Channels whose left-out rms rises, with the mean over runs before and after in the channel's unit.

    A rise counts that is larger than its standard error over runs, each run a sample of its own. So small a rise as
    that may come from other runs.
    """
    old, new = (r.rms.pivot(index="batch", columns="channel", values="rms") for r in (before, after))
    rise, n = new.mean() - old.mean(), len(old)
    se = np.sqrt((old.var(ddof=min(1, n - 1)) + new.var(ddof=min(1, n - 1))) / n)
    return {str(c): (float(old[c].mean()), float(new[c].mean())) for c in rise.index[rise > se]}


def _least_squares(jacobian: Array, aim: Array) -> Array:
    """Unknowns of unit prior spread (q,) by regularised least squares."""
    normal = jacobian.T @ jacobian + np.eye(jacobian.shape[1])
    return np.asarray(np.linalg.solve(normal, jacobian.T @ aim), float)


def _rows_left(problem: CalibrationProblem, every_z: Sequence[Array], nuisance: Sequence[Array]) -> LeftOutRows:
    """What each batch leaves, predicted by parameters and starts of its own."""
    errors = []
    table = []
    for k, (z, own) in enumerate(zip(every_z, nuisance, strict=True)):
        residual = problem.only([k]).residuals(x_of(problem.unknowns, z), [own])[0]
        m = problem.measured[k]
        errors.append(residual * problem.noise[m.channel])
        for c in m.usable.tolist():
            at = m.channel == c
            rms = float(np.sqrt(np.mean(errors[-1][at] ** 2)))
            table.append((m.batch_id, problem.channels[c], problem.units[c], int(at.sum()), rms))
    return LeftOutRows(errors, pd.DataFrame(table, columns=list(RMS_COLUMNS)))
