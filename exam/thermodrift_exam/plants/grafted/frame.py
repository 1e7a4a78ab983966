"""The structure of the real machine for a grafted heat: the bodies of its file cut into cells, with values of their
own.

A file's network is lumped; a response of the same network would be no test. So every body is a bar of cells with a
gradient inside, joined, heated and sensed at cells of its own, and every conductance and capacity differs from the
file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from data.arrays import Array
from data.batch import Batch
from thermodrift_exam.plants.grafted.base import ROOM, ends, magnitude
from thermodrift_exam.plants.volumes.structure import integrate

Cells = NDArray[np.int64]
CELLS = 5
SCATTER = 0.15  # sd of the logarithm by which conductances and capacities differ from the file's
GAIN_SCATTER = 0.1
STIFF = (3.0, 15.0)  # a bar's conductance from end to end, in units of all that leaves its body


@dataclass(frozen=True)
class Placement:
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
    placements: Mapping[str, Placement]
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
    near = {key: magnitude(value, f"links.{key}") * _off(rng) for key, value in twin["links"].items()}
    room = {
        ends(key)[0]: magnitude(value, f"exposures.{key}") * _off(rng)
        for key, value in twin.get("exposures", {}).items()
        if ends(key)[1] == ROOM
    }
    bodies = {name: k * CELLS + np.arange(CELLS) for k, name in enumerate(twin["bodies"])}
    capacity = np.concatenate([
        np.full(CELLS, magnitude(b["capacity"], f"bodies.{n}") * _off(rng) / CELLS) for n, b in twin["bodies"].items()
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
        {c: _placement(s, bodies, rng) for c, s in twin.get("sensors", {}).items()},
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


def _placement(sensor: Mapping[str, Any], bodies: Mapping[str, Cells], rng: np.random.Generator) -> Placement:
    body = sensor["at"].partition("@")[0]
    return Placement(body, int(rng.choice(bodies[body])), magnitude(sensor.get("bonding", 1.0), "sensors.bonding"))


def _gains(channel: str, error: Mapping[str, Any], rng: np.random.Generator) -> dict[str, float]:
    """um/K of each body of a chain that is stated by gains."""
    where = f"errors.{channel}.chain"
    return {
        part["body"]: magnitude(part["gain"], where) * _off(rng, GAIN_SCATTER)
        for part in error.get("chain", ())
        if "gain" in part
    }


BEFORE_S = 10 * 3600.0


@dataclass(frozen=True)
class Push:
    """Action of an effect on each body over K steps of B runs, (K, B): watts, and additional losses of its rise in W/K.

    `spread` False: into the one cell where the body is heated; True: evenly over its surface.
    """

    drive_W: Mapping[str, Array]
    more_W_per_K: Mapping[str, Array] = field(default_factory=dict)
    spread: bool = False

    def times(self, factor: float) -> Push:
        """The same with another strength."""
        return Push(
            {b: factor * d for b, d in self.drive_W.items()},
            {b: factor * m for b, m in self.more_W_per_K.items()},
            self.spread,
        )


@dataclass(frozen=True)
class Clockwork:
    """Steps of the simulation: from `before` steps before the runs' starts to the end of the longest, `step_s` each."""

    step_s: float
    before: int
    steps: int

    @classmethod
    def of(cls, batches: Sequence[Batch]) -> Clockwork:
        step_s = batches[0].step_s
        before = round(BEFORE_S / step_s)
        return cls(step_s, before, before + max(b.n_rows for b in batches) - 1)

    @property
    def middle_s(self) -> Array:
        """Time from a run's start in the middle of each step, s, (K,)."""
        return np.asarray((np.arange(self.steps) - self.before + 0.5) * self.step_s)

    def means(self, rows: Sequence[Array]) -> Array:
        """Recorded series as means of the steps, (K, B): holes bridged, the first and last value held beyond."""
        return np.stack([self._mean(r) for r in rows], axis=1)

    def held(self, rows: Sequence[Array]) -> Array:
        """Drivers as they hold from row to row, (K, B); at rest before the start and after the end."""
        out = np.zeros((self.steps, len(rows)))
        for k, r in enumerate(rows):
            out[self.before : self.before + len(r) - 1, k] = r[:-1]
        return out

    def _mean(self, row: Array) -> Array:
        known = np.flatnonzero(np.isfinite(row))
        return np.interp(self.middle_s / self.step_s, known, row[known])


def response(frame: Frame, push: Push, clock: Clockwork) -> Array:
    """Rise of every cell by the push, K, (rows, N, B), from the runs' starts on."""
    runs = next(iter(push.drive_W.values())).shape[1]
    share = {b: _share(frame, b, push.spread) for b in push.drive_W}

    def heat_W(step: int, stage: int, rise_K: Array) -> Array:
        heat = np.zeros_like(rise_K)
        for body, cells in share.items():
            heat += cells[:, None] * push.drive_W[body][step]
            if body in push.more_W_per_K:
                heat -= cells[:, None] * push.more_W_per_K[body][step] * rise_K
        return heat

    start = np.zeros((frame.size, runs))
    rise = integrate(frame.capacity_J_per_K, frame.losses, heat_W, start, clock.step_s, clock.steps)
    return rise[clock.before :]


def on_channels(frame: Frame, rise_K: Array) -> dict[str, Array]:
    """Contribution of the rise to every sensor and error channel, (rows, B); errors are relative to the starts."""
    out = {c: placement.bonding * rise_K[:, placement.cell] for c, placement in frame.placements.items()}
    for channel, gains in frame.gains_um_per_K.items():
        moved = sum(
            (g * rise_K[:, frame.bodies[b]].mean(axis=1) for b, g in gains.items()), np.zeros_like(rise_K[:, 0])
        )
        out[channel] = moved - moved[:1]
    return out


def _share(frame: Frame, body: str, spread: bool) -> Array:
    out = np.zeros(frame.size)
    if spread:
        out[frame.bodies[body]] = 1.0 / len(frame.bodies[body])
    else:
        out[frame.spots[body]] = 1.0
    return out
