"""Start temperatures from first readings, as the sensors show them: offset, bonding and lag undone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.network import Network
from twin.simulation import simulate
from twin.simulation.inputs import Inputs
from twin.simulation.start import start_of

Array = NDArray[np.float64]

ROUNDS = 3  # a sensor bonded to 90 % shows all but a thousandth of what it sees by then


def first_state(network: Network, values: Array, inputs: Inputs) -> Array:
    """Start temperatures (B, N), degC, at which the sensors show the first readings at parameter values (n,).

    `start_of` puts a body at its sensor's reading; here what the sensor adds to that is taken off, in a few rounds.
    """
    begin = _first_interval(inputs)
    first = dict(inputs.first)
    for _ in range(ROUNDS):
        start = start_of(network, values[None], replace(inputs, first=first))
        if not any(r.effects for r in network.readings):
            break
        shows = simulate(network, values, begin, start).readings[0, :, 0]
        for k, reading in enumerate(network.readings):
            if reading.effects and reading.channel in first:
                first[reading.channel] = first[reading.channel] + inputs.first[reading.channel] - shows[:, k]
    return np.asarray(start[0])


def _first_interval(inputs: Inputs) -> Inputs:
    """Each batch's first row to its second."""
    n = inputs.every
    return replace(
        inputs,
        time_s=inputs.time_s[:, : n + 1],
        n_intervals=np.full(inputs.n_batches, n),
        drivers={k: v[:, :n] for k, v in inputs.drivers.items()},
        recorded={k: v[:, : n + 1] for k, v in inputs.recorded.items()},
    )
