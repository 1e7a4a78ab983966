"""Inputs and small machines for tests of the simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from data.arrays import Array
from tests.twin.machines import machine
from twin.compile import compile_network
from twin.network import Network
from twin.simulation.inputs import Inputs

GREASE = {
    "friction": {"law": "bearing_viscous", "drivers": "rpm", "into": {"shaft": 0.7, "head": "rest"}},
    "grease": {"law": "viscosity_feedback", "at": {"oil": ["shaft", "head"]}, "acts_on": "friction"},
    "spin": {"law": "rotating_convection", "drivers": "rpm", "acts_on": ["shaft-room", "shaft-head"]},
}


def network(**changes: Any) -> Network:
    """The two bodies in a room, changed as `tests.twin.machines.machine` does."""
    return compile_network(machine(**changes))


def one_body(exposure: str | None = None, **changes: Any) -> Network:
    """The shaft alone, 5 kJ/K."""
    alone: dict[str, Any] = {
        "bodies__head": None, "links": {}, "sensors__t_head": None, "mechanisms": {},
        "errors__z__chain": [{"body": "shaft", "gain": "2 um/K"}],
        "exposures": {"shaft-room": exposure} if exposure else {},
    }  # fmt: skip
    return network(**(alone | changes))


def drive(
    time_s: Array, rpm: Any = 0.0, room: Any = 20.0, n_batches: int = 1, first: float | None = None, every: int = 1
) -> Inputs:
    """Batches on one grid of borders (M + 1,): rpm broadcasts to (B, M), room to (B, M + 1)."""
    n_intervals = len(time_s) - 1
    room = np.broadcast_to(np.asarray(room, float), (n_batches, n_intervals + 1))
    start = room[:, 0] if first is None else np.full(n_batches, first)
    return Inputs(
        batch_ids=tuple(f"b{k}" for k in range(n_batches)),
        time_s=np.repeat(np.asarray(time_s, float)[None], n_batches, axis=0),
        n_intervals=np.full(n_batches, n_intervals),
        drivers={"rpm": np.broadcast_to(np.asarray(rpm, float), (n_batches, n_intervals))},
        recorded={"room": room},
        clock_h=np.full(n_batches, np.nan),
        first={"t_shaft": start, "t_head": start, "room": room[:, 0]},
        every=every,
    )


def at(degC: Any, net: Network) -> Array:
    """Start temperatures (1, 1, N) of all cells alike, or one each."""
    return np.broadcast_to(np.asarray(degC, float), (1, 1, net.n_cells))


def closed(net: Network) -> Network:
    """The same without its exposures: no heat leaves."""
    return replace(net, edges=tuple(e for e in net.edges if e.surrounding is None))
