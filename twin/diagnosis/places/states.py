"""Drivers, temperatures and times of the fitted network, with what a search has found at work, for describing it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.batch import Batch
from twin.calibration.fit_problem import Array
from twin.diagnosis.places.terms import States, levels
from twin.diagnosis.places.where_when import Located
from twin.network import Network
from twin.simulation.inputs import intervals_at_rows


def states_of_heat(located: Located, batches: Sequence[Batch]) -> States:
    """At both ends of every interval, (B, M, 2)."""
    problem, forced = located.point.problem, located.point.forced
    inputs, network = problem.inputs, problem.network
    drivers = levels(batches, inputs.time_s.shape[1] - 1, inputs.every)
    rooms = {s.name: _ends(forced.surrounding_degC(k)) for k, s in enumerate(network.surroundings)}
    bodies = dict(zip(network.bodies, map(_ends, _bodies_degC(located)), strict=True))
    time_s = _ends(inputs.time_s)
    return States([d.at_ends() for d in drivers], bodies, rooms, time_s, _clock_h(inputs.clock_h, time_s))


def states_of_shift(located: Located, batches: Sequence[Batch]) -> States:
    """At the rows of the recordings, (B, K), drivers as there; bodies' rises."""
    problem = located.point.problem
    inputs, every = problem.inputs, problem.inputs.every
    intervals = inputs.time_s.shape[1] - 1
    drivers = [d.at(intervals_at_rows(intervals, every)) for d in levels(batches, intervals, every)]
    degC = _bodies_degC(located)[..., ::every]
    time_s = inputs.time_s[:, ::every]
    rises = dict(zip(problem.network.bodies, degC - degC[..., :1], strict=True))
    return States(drivers, rises, {}, time_s, _clock_h(inputs.clock_h, time_s))


def neighbours_of(network: Network, body: str) -> list[str]:
    """Bodies that a link joins to a body."""
    own = set(network.bodies[body].tolist())
    joined: set[int] = set()
    for edge in network.edges:
        at = set(np.flatnonzero(edge.direction).tolist())
        if edge.surrounding is None and at & own:
            joined |= at
    return [n for n, cells in network.bodies.items() if n != body and joined & set(cells.tolist())]


def _bodies_degC(located: Located) -> Array:
    """Bodies' temperatures (bodies, B, M + 1): as fitted, and what the heat found adds to them."""
    point = located.point
    inputs, names = point.problem.inputs, list(point.problem.network.bodies)
    out = np.array(point.forced.borders_degC)
    time_s = _ends(inputs.time_s)
    for f in located.found:
        if f.kind != "heat":
            continue
        watts = np.einsum("bmek,bk->bme", point.hats.at(time_s), f.series.mean)
        _, added_K = point.forced.answers(point.forced.weights[names.index(f.place)][None], watts[None])
        out += _at_borders(added_K[0], inputs.every)
    return out


def _at_borders(rows: Array, every: int) -> Array:
    """Rows (..., K) as a straight line from one to the next, at the borders (..., M + 1)."""
    share = np.arange(every) / every
    inner = rows[..., :-1, None] * (1 - share) + rows[..., 1:, None] * share
    return np.concatenate([inner.reshape(*rows.shape[:-1], -1), rows[..., -1:]], axis=-1)


def _ends(borders: Array) -> Array:
    return np.stack([borders[..., :-1], borders[..., 1:]], axis=-1)


def _clock_h(start_h: Array, time_s: Array) -> Array:
    start = start_h.reshape(-1, *(1,) * (time_s.ndim - 1))
    return np.asarray((start + time_s / 3600.0) % 24.0)
