"""Recordings that a network itself makes: its own physics with a start, rounding and noise of each batch's own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from data.arrays import Array
from data.batch import Batch
from data.machine import Machine
from twin.compile import compile_network
from twin.network import Network
from twin.quantity import values_of
from twin.simulation import simulate
from twin.simulation.inputs import inputs_of


def drawn(network: Network, rng: np.random.Generator) -> Array:
    """Parameter values (n,) with the free ones drawn from their priors, within their bounds."""
    values = values_of(network.parameters)
    for k in network.free:
        p = network.parameters[k]
        values[k] = np.clip(p.from_x(p.to_x(p.prior_value) + p.spread * rng.standard_normal()), p.low, p.high)
    return values


def empty_batches(machine: Machine, count: int, hours: float = 4.0, step_s: float = 300.0) -> list[Batch]:
    """Batches with a moving room and a driver that runs, stops and runs faster; nothing measured yet."""
    network = compile_network(machine)
    out = []
    for k in range(count):
        time_s = np.arange(0.0, hours * 3600 + 1, step_s)
        room = 16.0 + 3.0 * k + np.sin(time_s / (2000.0 + 300 * k)) + 0.2 * k * time_s / 3600
        running = np.where(time_s < 0.6 * time_s[-1], 1.0, 0.0) * (time_s >= step_s)
        table = {"time_s": time_s}
        for name, channel in machine.channels.items():
            table[name] = np.zeros(len(time_s))
            if channel.role == "ambient":
                table[name] = room
            elif name in network.drivers:
                table[name] = running * (2000.0 + 1500.0 * (k % 3))
        out.append(
            Batch(machine.machine, f"b{k:02d}", pd.DataFrame(table), machine.batch_channels(), simulated=True,
                  start=pd.Timestamp("2026-01-05 07:00") + pd.Timedelta(days=k))
        )  # fmt: skip
    return out


def recorded(
    machine: Machine,
    batches: Sequence[Batch],
    values: Array | None = None,
    seed: int = 0,
    noise: float = 1.0,
    start_K: float | None = None,
    substeps: int = 2,
) -> list[Batch]:
    """The batches with what the machine's network shows at parameter values (n,), noise times the file's own.

    Every body starts off the room by a normal deviate of `start_K`, by default the file's `initial_spread`.
    """
    network = compile_network(machine)
    rng = np.random.default_rng(seed)
    values = values_of(network.parameters) if values is None else values
    spread = network.start_spread_K if start_K is None else start_K
    start = np.array([np.full(network.n_cells, b.values(ambient_of(machine))[0]) for b in batches])
    for cells in network.bodies.values():
        start[:, cells] += spread * rng.standard_normal((len(batches), 1))
    shown = simulate(network, values, inputs_of(network, batches, substeps), start[None])
    out = []
    for k, batch in enumerate(batches):
        table = batch.table.copy()
        n = len(table)
        for c, r in enumerate(network.readings):
            table[r.channel] = shown.readings[0, k, :n, c] + noise * r.noise * rng.standard_normal(n)
        for c, e in enumerate(network.errors):
            table[e.channel] = shown.errors[0, k, :n, c] + noise * e.noise * rng.standard_normal(n)
        out.append(replace(batch, table=table))
    return out


def ambient_of(machine: Machine) -> str:
    return machine.names("ambient")[0]
