"""The same recordings with another network: unknowns and batches' nuisances carried over by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from diagnosis.contracts import Point
from twin.calibration.fit_problem import z_bounds
from twin.calibration.problem import CalibrationProblem, Nuisances
from twin.compile import compile_network
from twin.network import Network
from twin.schema import TwinPart
from twin.simulation.inputs import Inputs, inputs_of


def on_network(
    problem: CalibrationProblem,
    batches: Sequence[Batch],
    network: Network,
    free_starts: bool = False,
) -> CalibrationProblem:
    """The calibration problem of the same recordings with another network (more bodies, laws or drivers).

    A new body starts at the temperature of the body that it is linked with most strongly; with `free_starts` its start
    is an unknown of each batch.
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
            if len(start_K) and not free_starts:
                start_K[k] = 0.0
    return CalibrationProblem(network, inputs, problem.measured, start, replace(nuisances, start_K=start_K))


def _drives(inputs: Inputs, network: Network) -> bool:
    """Whether the inputs of another network hold all that drives this one, so that they can be used again."""
    recorded = {s.channel for s in network.surroundings if s.channel}
    first = {*(r.channel for r in network.readings), *(c for s in network.surroundings for c in s.first)}
    drivers = set(network.drivers) <= set(inputs.drivers)
    return drivers and recorded == set(inputs.recorded) and first <= set(inputs.first)


def carried_nuisances(old: CalibrationProblem, new: CalibrationProblem, nuisance: Sequence[Array]) -> list[Array]:
    """Nuisances (q_b,) of each batch in the order of the new network; new ones are at their prior mean, 0."""
    names, before = _names(new), {name: k for k, name in enumerate(_names(old))}
    out = []
    for v in nuisance:
        shared = np.array([v[before[n]] if n in before else 0.0 for n in names])
        out.append(np.concatenate([shared, v[old.nuisances.shared :]]))
    return out


def carried_z(old: CalibrationProblem, new: CalibrationProblem, z: Array, other: Array | None = None) -> Array:
    """z (p,) of the new problem: parameters that both problems fit at their old values, others at `other` (p,) or their
    prior means."""
    by_name = {u.name: u.prior + u.spread * v for u, v in zip(old.unknowns, z, strict=True)}
    begin = np.zeros(len(new.unknowns)) if other is None else other
    values = [
        (by_name[u.name] - u.prior) / u.spread if u.name in by_name else v
        for u, v in zip(new.unknowns, begin, strict=True)
    ]
    return np.clip(values, *z_bounds(new.unknowns))


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


def carried_start(old: Point, part: TwinPart) -> tuple[CalibrationProblem, Array, list[Array]]:
    """The problem of a changed twin part, and z (p,) and the batches' nuisances where a fit from the old one begins;
    new parameters start at their value in the part.

    Raises:
        InputError: the part does not compile.
    """
    network = compile_network(old.machine, part=part)
    problem = on_network(old.problem, old.batches, network, free_starts=True)
    begin = [
        (float(p.to_x(p.value)) - u.prior) / u.spread
        for u, p in ((u, network.parameters[network.index(u.name)]) for u in problem.unknowns)
    ]
    z = carried_z(old.problem, problem, old.z, np.array(begin))
    return problem, z, carried_nuisances(old.problem, problem, old.nuisance)
