"""A fit carried over to another network of the same machine: parameters, starts and offsets by their names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from twin.calibration.fit_problem import Array
from twin.calibration.problem import CalibrationProblem, Nuisances
from twin.network import Network
from twin.simulation.inputs import Inputs, inputs_of

_NO_PIECES: Mapping[str, str] = {}


def on_network(
    problem: CalibrationProblem,
    batches: Sequence[Batch],
    network: Network,
    free_starts: bool = False,
    pieces: Mapping[str, str] = _NO_PIECES,
) -> CalibrationProblem:
    """The same recordings posed to a network with more bodies, laws or drivers.

    A new body starts as the one that it is linked with most strongly; with `free_starts` each batch may say otherwise.
    `pieces` of a body, {piece: body}, start with it: a piece that started as it liked would be a store of its own.
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
    """Whether inputs of another network hold all that drives this one: what was worked out of them serves again."""
    recorded = {s.channel for s in network.surroundings if s.channel}
    first = {*(r.channel for r in network.readings), *(c for s in network.surroundings for c in s.first)}
    drivers = set(network.drivers) <= set(inputs.drivers)
    return drivers and recorded == set(inputs.recorded) and first <= set(inputs.first)


def carried_nuisances(old: CalibrationProblem, new: CalibrationProblem, nuisance: Sequence[Array]) -> list[Array]:
    """Each batch's own unknowns in the new network's order; what is new stands at its prior's mean, 0."""
    names, before = _names(new), {name: k for k, name in enumerate(_names(old))}
    out = []
    for own in nuisance:
        shared = np.array([own[before[n]] if n in before else 0.0 for n in names])
        out.append(np.concatenate([shared, own[old.nuisances.shared :]]))
    return out


def carried_z(old: CalibrationProblem, new: CalibrationProblem, z: Array) -> Array:
    """The parameters that both networks fit at their old place, the others at their priors' mean."""
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
