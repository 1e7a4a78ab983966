"""The real machine's frame as the grafted heat finds it: its file's bodies cut into cells, with values of their own.

A file's network is lumped; a response computed with the very same network would be no test. So every body is a bar
of cells with a gradient inside, joined, heated and sensed at cells of its own, and no conductance or capacity is
quite the file's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from twin.plants.grafted.told import ROOM, Array, ends, told

Cells = NDArray[np.int64]
CELLS = 5
SCATTER = 0.15  # sd of the logarithm by which conductances and capacities differ from the file's
GAIN_SCATTER = 0.1
STIFF = (3.0, 15.0)  # a bar's conductance from end to end, in units of all that leaves its body


@dataclass(frozen=True)
class Seat:
    """Where a sensor sits, and the share of the surface's temperature that it shows."""

    body: str
    cell: int
    bonding: float


@dataclass(frozen=True)
class Frame:
    """N cells in bars. capacity_J_per_K (N,), losses L (N, N) with what goes to the room on its diagonal, W/K.

    `spots` are the cells into which a heat of a body goes, `room_W_per_K` what each body exchanges with the room,
    `gains_um_per_K` what a kelvin of each body does to an error channel.
    """

    bodies: Mapping[str, Cells]
    capacity_J_per_K: Array
    losses: sparse.csc_matrix
    spots: Mapping[str, int]
    seats: Mapping[str, Seat]
    room_W_per_K: Mapping[str, float]
    gains_um_per_K: Mapping[str, Mapping[str, float]]

    @property
    def size(self) -> int:
        return len(self.capacity_J_per_K)


def draw_frame(twin: Mapping[str, Any], rng: np.random.Generator) -> Frame:
    """The frame of a machine file's twin part (plain data).

    Raises:
        InputError: a value whose unit is not read here.
    """
    near = {key: told(value, f"links.{key}") * _off(rng) for key, value in twin["links"].items()}
    room = {
        ends(key)[0]: told(value, f"exposures.{key}") * _off(rng)
        for key, value in twin.get("exposures", {}).items()
        if ends(key)[1] == ROOM
    }
    bodies = {name: k * CELLS + np.arange(CELLS) for k, name in enumerate(twin["bodies"])}
    capacity = np.concatenate([
        np.full(CELLS, told(b["capacity"], f"bodies.{n}") * _off(rng) / CELLS) for n, b in twin["bodies"].items()
    ])  # fmt: skip
    edges = [_joint(bodies, key, g, rng) for key, g in near.items()]
    for name, cells in bodies.items():
        leaves = sum(g for key, g in near.items() if name in ends(key)) + room.get(name, 0.0)
        inside = CELLS * leaves * float(np.exp(rng.uniform(*np.log(STIFF))))
        edges += [(int(a), int(a) + 1, inside) for a in cells[:-1]]
    one, other, conductance = (np.array(column) for column in zip(*edges, strict=True))
    n = len(capacity)
    off = sparse.coo_matrix((conductance, (one, other)), shape=(n, n))
    diagonal = np.zeros(n)
    for side in (one, other):
        np.add.at(diagonal, side, conductance)
    for name, g in room.items():
        diagonal[bodies[name]] += g / CELLS
    return Frame(
        bodies,
        capacity,
        sparse.csc_matrix(sparse.diags(diagonal) - off - off.T),
        {name: int(rng.choice(cells)) for name, cells in bodies.items()},
        {c: _seat(s, bodies, rng) for c, s in twin.get("sensors", {}).items()},
        room,
        {c: _gains(c, e, rng) for c, e in twin.get("errors", {}).items()},
    )


def _off(rng: np.random.Generator, sd: float = SCATTER) -> float:
    return float(np.exp(sd * rng.standard_normal()))


def _joint(
    bodies: Mapping[str, Cells], key: str, conductance: float, rng: np.random.Generator
) -> tuple[int, int, float]:
    one, other = ends(key)
    return int(rng.choice(bodies[one])), int(rng.choice(bodies[other])), conductance


def _seat(sensor: Mapping[str, Any], bodies: Mapping[str, Cells], rng: np.random.Generator) -> Seat:
    body = sensor["at"].partition("@")[0]
    return Seat(body, int(rng.choice(bodies[body])), told(sensor.get("bonding", 1.0), "sensors.bonding"))


def _gains(channel: str, error: Mapping[str, Any], rng: np.random.Generator) -> dict[str, float]:
    """um/K of each body of a chain that is stated by gains."""
    where = f"errors.{channel}.chain"
    return {
        part["body"]: told(part["gain"], where) * _off(rng, GAIN_SCATTER)
        for part in error.get("chain", ())
        if "gain" in part
    }
