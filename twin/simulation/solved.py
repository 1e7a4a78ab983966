"""Parameter sets solved on inputs: the heat balance, its temperature-dependent heat, and all states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.network import Network
from twin.simulation.balance import Balance, balance_of
from twin.simulation.channels import Rows, watch
from twin.simulation.coupling import Coupled, outlets, plain_modes, solve
from twin.simulation.inputs import Inputs
from twin.simulation.response import Response, States
from twin.simulation.sources import HeatSource, Places, Source, sources_of
from twin.simulation.start import excess_K

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solved:
    """One group of parameter sets, solved: the balance, its sources and the states at every row or border."""

    balance: Balance
    sources: Sequence[Source]
    places: Places
    start_degC: Array
    response: Response
    coupled: Coupled | None
    states: States
    asleep: Sequence[HeatSource] = ()  # heat of candidates, which does not count


def solved_balance(
    network: Network,
    values: Array,
    inputs: Inputs,
    start_degC: Array,
    tolerance_K: float,
    every: int = 1,
    offsets_K: Array | None = None,
) -> Solved:
    """Solve P sets, values (P, n), from start temperatures (P or 1, B, N) to which the laws of the start are added.

    The states of a linear network stand at every `every`-th border, of another at all of them.
    """
    balance, places = balance_of(network, values, inputs, offsets_K), Places()
    sources, asleep = sources_of(balance, places)
    n_places = len(places.rows)
    watch(network, places)
    excess = excess_K(network, values, inputs)
    if excess is not None:
        start_degC = start_degC + excess
    if not sources:
        response = Response(plain_modes(balance), balance.schedule)
        states = response.run(balance.forcing(response), start_degC, every)
        return Solved(balance, sources, places, start_degC, response, None, states, asleep)
    rows = np.array(places.rows[:n_places]).reshape(n_places, network.n_cells)
    coupled = solve(balance, sources, rows, start_degC, tolerance_K)
    response = Response(coupled.chord.modes, balance.schedule)
    heat = balance.forcing(response) + response.forcing(outlets(balance, sources), coupled.series_W)
    return Solved(balance, sources, places, start_degC, response, coupled, response.run(heat, start_degC), asleep)


def rows_of(solved: Solved, every: int, states_every: int) -> Rows:
    """What sensors and errors look at, at the rows; the states stand at every `states_every`-th border."""
    b, n_places = solved.balance, len(solved.places.rows)
    matrix = seen_matrix(b.network, b.values, solved.places)
    seen = np.moveaxis(solved.states.at(matrix, every // states_every), -1, 0)
    chain = seen[n_places:] - seen[n_places:, ..., :1]
    return Rows(b.inputs, every, b.values, seen[:n_places], chain, b.air, solved.places)


def seen_matrix(network: Network, values: Array, places: Places) -> Array:
    """Rows over cells (P, n_places + n_errors, N): the places, then the errors' chains and tilts."""
    rows = np.array(places.rows).reshape(1, len(places.rows), network.n_cells)
    errors = [e.matrix(values)[:, None] for e in network.errors]
    return np.concatenate([np.repeat(rows, len(values), axis=0), *errors], axis=1)
