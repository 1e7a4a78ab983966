"""What a heat does to the frame: the difference of two simulations of a linear machine, with the heat and without."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from data.batch import Batch
from twin.plants.grafted.frame import Frame
from twin.plants.grafted.told import Array
from twin.plants.volumes.solver import integrate

BEFORE_S = 10 * 3600.0


@dataclass(frozen=True)
class Push:
    """What an effect does to each body over K steps of B runs, (K, B): watts, and W/K that its own rise loses more.

    `spread` False: into the one cell where the body is heated; True: evenly over its surface.
    """

    drive_W: Mapping[str, Array]
    more_W_per_K: Mapping[str, Array] = field(default_factory=dict)
    spread: bool = False

    def times(self, factor: float) -> Push:
        """The same of another strength."""
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
    """What the rise adds to every sensor and error channel, (rows, B); errors count from the runs' starts."""
    out = {c: seat.bonding * rise_K[:, seat.cell] for c, seat in frame.seats.items()}
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
