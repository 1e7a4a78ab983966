"""Recordings of the two-body machine whose truth differs from its file: heat, links, starts, and friction by batch."""

from __future__ import annotations

import numpy as np
import pandas as pd

from data.batch import Batch
from data.machine import Machine
from tests.twin.machines import machine
from twin.compile import compile_network
from twin.network import Network
from twin.simulation import simulate
from twin.simulation.inputs import Inputs

STEP_S, ROWS = 300.0, 61
NOISE_K, NOISE_UM = 0.03, 0.3
TRUTH = {"mechanisms.belt.power": 1.4, "links.shaft-head.conductance": 0.7, "bodies.head.capacity": 1.2}


def two_errors() -> Machine:
    """The machine file: as in `tests.twin.machines`, with a second error channel and small noise."""
    plain = machine(sensors__t_shaft__noise="0.03 K", sensors__t_head__noise="0.03 K", errors__z__noise="0.3 um")
    raw = plain.model_dump()
    raw["channels"]["x"] = {"role": "error", "unit": "um", "resolution": 0.1}
    raw["twin"]["errors"]["x"] = {
        "noise": "0.3 um",
        "chain": [{"body": "head", "gain": "3 um/K"}, {"body": "shaft", "gain": "-3 um/K"}],
    }
    raw["recording"]["step_s"] = STEP_S
    return Machine.model_validate(raw)


def true_values(network: Network, friction: float = 1.0) -> np.ndarray:
    """What the machine is, beside its file."""
    values = np.array([p.value for p in network.parameters])
    for name, factor in TRUTH.items():
        values[network.index(name)] *= factor
    values[network.index("mechanisms.belt.power")] *= friction
    return values


def recording(given: Machine, k: int, scatter: float = 0.0, start_K: float = 0.5) -> Batch:
    """The k-th batch, 5 h with a stop; `scatter` of its friction, `start_K` by how much it starts above the room."""
    rng = np.random.default_rng(100 + k)
    network = compile_network(given)
    time_s = STEP_S * np.arange(ROWS)
    rpm = np.where((time_s >= 600) & (time_s < 12000), 2000.0 + 2000.0 * (k % 3), 0.0)
    room = 12.0 + 2.0 * k + rng.uniform(0, 2) * time_s / time_s[-1]
    inputs = Inputs(
        (f"B{k + 1}",), time_s[None], np.array([ROWS - 1]), {"rpm": rpm[None, :-1]}, {"room": room[None]},
        np.array([np.nan]), {},
    )  # fmt: skip
    start = np.full((1, 1, network.n_cells), room[0] + start_K + rng.normal(0, 0.3))
    done = simulate(network, true_values(network, 1.0 + scatter * rng.normal()), inputs, start)
    table = pd.DataFrame({"time_s": time_s, "room": room, "rpm": rpm})
    for j, reading in enumerate(network.readings):
        table[reading.channel] = done.readings[0, 0, :, j] + rng.normal(0, NOISE_K, ROWS)
    for j, error in enumerate(network.errors):
        table[error.channel] = 5.0 + done.errors[0, 0, :, j] + rng.normal(0, NOISE_UM, ROWS)
    return Batch(given.machine, f"B{k + 1}", table, given.batch_channels(), simulated=True)


def year(n: int, scatter: float = 0.0) -> tuple[Machine, list[Batch]]:
    given = two_errors()
    return given, [recording(given, k, scatter) for k in range(n)]
