"""A network and its recordings as a least-squares problem: free parameters shared, start and offsets per batch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from twin.calibration.fit_problem import Block, Unknown
from twin.network import Network
from twin.quantity import Parameter
from twin.simulation import choose_substeps, simulate
from twin.simulation.coupling import Trajectory
from twin.simulation.inputs import MAX_GAP_S, Inputs, inputs_of
from twin.simulation.sensitivity import Selected, sensitivities
from twin.simulation.start import start_of

# A body or a well bonded sensor moves within minutes, and neighbouring samples repeat each other's rounding: rows
# nearer than this cost time and add almost no information.
EVERY_S = 300.0


@dataclass(frozen=True)
class Measured:
    """One batch's usable values, channel by channel in time order; n values of C channels.

    `row` (n,) of the recording, `channel` (n,) and `value` (n,): K for sensors in degC, and for errors what is shown
    less the channel's first usable sample, at row `first` (C,), which is no value of its own.
    """

    batch_id: str
    row: NDArray[np.int64]
    channel: NDArray[np.int64]
    value: Array
    first: NDArray[np.int64]
    is_error: NDArray[np.bool_]  # (C,)
    stride: int = 1  # rows of the recording from one that is used to the next

    @cached_property
    def usable(self) -> NDArray[np.int64]:
        """Numbers of the channels that have a value."""
        return np.unique(self.channel)

    @cached_property
    def usable_errors(self) -> NDArray[np.int64]:
        """Those of them that are errors."""
        return self.usable[self.is_error[self.usable]]

    @cached_property
    def at_rest(self) -> Array:
        """What would be shown (n,) if nothing ever moved from its first value."""
        out = np.zeros(len(self.value))
        for c in self.usable[~self.is_error[self.usable]].tolist():
            out[self.channel == c] = self.value[int(np.argmax(self.channel == c))]
        return out

    def of(self, series: Array) -> Array:
        """The same rows (..., n) of simulated channels (..., K, C), errors less their first sample."""
        seen = series[..., self.row, self.channel]
        error = self.is_error[self.channel]
        at = self.channel[error]
        seen[..., error] -= series[..., self.first[at], at]
        return np.asarray(seen)


def channels_of(network: Network, wanted: Sequence[str] | None = None) -> tuple[str, ...]:
    """The sensors and error channels of a network, or those of them that are wanted.

    Raises:
        InputError: an unknown channel, with the closest.
    """
    every = (*(r.channel for r in network.readings), *(e.channel for e in network.errors))
    for name in wanted or ():
        if name not in every:
            raise InputError(
                f"machine {network.machine}: the twin has no sensor or error {name!r}; {closest(name, every)}"
            )
    return tuple(n for n in every if wanted is None or n in wanted)


def measured(
    network: Network, batches: Sequence[Batch], every_s: float = EVERY_S, channels: Sequence[str] | None = None
) -> list[Measured]:
    """The usable values of each batch, one row every `every_s` or the recording's step, whichever is longer.

    Channels count in the order of `channels_of(network)`, sensors first; `channels` leaves out all others.

    Raises:
        InputError: an unknown channel, a step that is not above 0, or a batch with no usable value of any channel.
    """
    every = channels_of(network)
    wanted = set(channels_of(network, channels))
    if not every_s > 0:
        raise InputError(f"calibration: every_s: got {every_s:g}, expected seconds above 0, e.g. {EVERY_S:g}")
    out = []
    for batch in batches:
        values = [_values(batch, n) if n in wanted else np.full(batch.n_rows, np.nan) for n in every]
        out.append(_one(network, batch, values, max(1, round(every_s / (batch.step_s or every_s)))))
        if not len(out[-1].row):
            raise InputError(
                f"batch {batch.batch_id}: has no usable value of the channels that the twin of {network.machine} "
                f"measures ({', '.join(n for n in every if n in wanted)}); leave it out, or check its masks"
            )
    return out


def _values(batch: Batch, channel: str) -> Array:
    return batch.masked(channel) if channel in batch.table.columns else np.full(batch.n_rows, np.nan)


def _one(network: Network, batch: Batch, values: Sequence[Array], stride: int) -> Measured:
    sensors = len(network.readings)
    first = np.zeros(len(values), np.int64)
    rows, channels, shown = [], [], []
    for c, series in enumerate(values):
        usable = np.isfinite(series)
        if c >= sensors and usable.any():
            first[c] = int(np.argmax(usable))
            series = series - series[first[c]]
            usable[first[c]] = False
        at = np.flatnonzero(usable[::stride]) * stride
        rows.append(at)
        channels.append(np.full(len(at), c))
        shown.append(series[at])
    return Measured(
        batch.batch_id, np.concatenate(rows), np.concatenate(channels), np.concatenate(shown), first,
        np.arange(len(values)) >= sensors, stride,
    )  # fmt: skip


# An error is shown less its first sample, whose noise shifts the whole batch; half as much again, since a display
# that rounds or a machine that moves within the first sample makes it worse than the others.
FIRST_SAMPLE = 1.5
MOST_NUMBERS = 20_000_000  # derivatives held at once (160 MB): batches beyond it are linearised one after the other


@dataclass(frozen=True)
class Nuisances:
    """What each batch has of its own, all of prior N(0, 1): start of every body, first samples, surroundings' offsets,
    parameters that differ from run to run.

    `start_K` (bodies, N) cells' deviation per unit, `surroundings` their numbers with `offset_K` per unit,
    `parameters` numbers with their `deviation` per unit in fitting coordinates.
    """

    start_K: Array
    surroundings: NDArray[np.int64]
    offset_K: Array
    parameters: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    deviation: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, network: Network) -> Nuisances:
        start_K = np.zeros((len(network.bodies), network.n_cells))
        for k, cells in enumerate(network.bodies.values()):
            start_K[k, cells] = network.start_spread_K
        spread = np.array([s.per_batch_K for s in network.surroundings])
        at = np.flatnonzero(spread > 0)
        own = np.array([p.per_batch for p in network.parameters])
        varying = np.flatnonzero(own > 0)
        return cls(start_K if network.start_spread_K > 0 else start_K[:0], at, spread[at], varying, own[varying])

    @property
    def size(self) -> Array:
        """Per unit of each that a batch's errors and sensors share: K, or a parameter's fitting coordinate."""
        return np.concatenate([self.start_K.max(axis=1), self.offset_K, self.deviation])

    @property
    def shared(self) -> int:
        """How many come before a batch's error offsets, which are as many as its usable error channels."""
        return len(self.start_K) + len(self.surroundings) + len(self.parameters)


@dataclass(frozen=True)
class CalibrationProblem:
    """Implements `twin.calibration.fit_problem.Problem`; residuals are whitened by the channels' noise.

    `start_degC` (B, N) follows from the first readings at the machine file's values, the centre of every batch's own
    start; `inputs` already hold the substeps that keep the simulation's error there below the finest sensor's noise.
    """

    network: Network
    inputs: Inputs
    measured: tuple[Measured, ...]
    start_degC: Array
    nuisances: Nuisances
    _last: dict[bytes, list[Block]] = field(default_factory=dict, repr=False, compare=False)
    _trajectory: Trajectory = field(default_factory=Trajectory, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        network: Network,
        batches: Sequence[Batch],
        every_s: float = EVERY_S,
        channels: Sequence[str] | None = None,
        max_gap_s: float = MAX_GAP_S,
    ) -> CalibrationProblem:
        """The problem that the recordings pose.

        Raises:
            InputError: batches that cannot be simulated (`inputs_of`) or measured (`measured`), or too few rows.
        """
        inputs = inputs_of(network, batches, max_gap_s=max_gap_s)
        values = network.values
        start_degC = start_of(network, values, inputs)[None]
        finest = min((r.noise for r in network.readings), default=0.03)
        inputs = inputs.refined(choose_substeps(network, values, inputs, start_degC, max(0.01, finest)))
        return cls(
            network, inputs, tuple(measured(network, batches, every_s, channels)), start_degC[0], Nuisances.of(network)
        )

    def __getstate__(self) -> dict[str, Any]:
        """Without the last point's blocks, which are long and quickly made anew."""
        return {**self.__dict__, "_last": {}, "_trajectory": Trajectory()}

    @cached_property
    def unknowns(self) -> tuple[Unknown, ...]:
        return tuple(unknown(self.network.parameters[k]) for k in self.network.free)

    @cached_property
    def channels(self) -> tuple[str, ...]:
        return channels_of(self.network)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Of a difference in each channel: K for sensors."""
        return (*("K" for _ in self.network.readings), *(e.unit for e in self.network.errors))

    @cached_property
    def noise(self) -> Array:
        """Standard deviation (C,) of each channel's noise, in its unit."""
        return np.array([r.noise for r in self.network.readings] + [e.noise for e in self.network.errors])

    @cached_property
    def nuisance_sizes(self) -> tuple[int, ...]:
        return tuple(self.nuisances.shared + len(m.usable_errors) for m in self.measured)

    def only(self, batches: Sequence[int]) -> CalibrationProblem:
        """Some of the batches."""
        if list(batches) == list(range(len(self.measured))):
            return self  # with what its inputs have worked out
        kept = tuple(self.measured[b] for b in batches)
        return replace(
            self, inputs=self.inputs.batch(batches), measured=kept, start_degC=self.start_degC[batches], _last={},
            _trajectory=Trajectory(),
        )  # fmt: skip

    def values_at(self, x: Array) -> Array:
        """All parameter values (n,) at the free ones' fitting coordinates (p,)."""
        values = self.network.values.copy()
        for k, v in zip(self.network.free, x, strict=True):
            values[k] = self.network.parameters[k].from_x(v)
        return values

    def linearise(self, x: Array, nuisance: Sequence[Array]) -> Iterator[Block]:
        """One block per batch at x (p,) and nuisances (q_b,); batches are linearised together as far as `MOST_NUMBERS`
        allows.

        The last point's blocks are kept, since a new noise needs them again, where they are small.
        """
        key = _key(x, nuisance)
        if key not in self._last:
            self._last.clear()
            blocks = self._linearised(x, nuisance)
            if self._size > MOST_NUMBERS:
                yield from blocks
                return
            self._last[key] = list(blocks)
        yield from self._last[key]

    @property
    def _size(self) -> int:
        """Numbers in all blocks."""
        return sum(
            len(m.row) * (len(self.unknowns) + q) for m, q in zip(self.measured, self.nuisance_sizes, strict=True)
        )

    def _linearised(self, x: Array, nuisance: Sequence[Array]) -> Iterator[Block]:
        for part in self._together(len(self.unknowns) + self.nuisances.shared):
            yield from self.only(part)._blocks(x, [nuisance[b] for b in part])

    def columns(self, x: Array, nuisance: Sequence[Array], numbers: Sequence[int]) -> Iterator[Array]:
        """Derivatives (n_b, k) of every batch's whitened rows by the fitting coordinates of k numbered parameters."""
        for part in self._together(len(numbers)):
            some = self.only(part)
            own = [nuisance[b] for b in part]
            _, *slopes = sensitivities(self.network, self.values_at(x), *some.inputs_at(own), Selected(numbers))
            slope = np.concatenate(slopes, axis=-1)
            for b, m in enumerate(some.measured):
                yield (m.of(slope[:, b]) / self.noise[m.channel]).T

    def _together(self, columns: int) -> Iterator[list[int]]:
        """Numbers of the batches whose derivatives by so many unknowns are held at once."""
        per_batch = columns * len(self.channels) * (self.inputs.time_s.shape[1] - 1) // self.inputs.every
        together = max(1, MOST_NUMBERS // max(1, per_batch))
        for first in range(0, len(self.measured), together):
            yield list(range(first, min(first + together, len(self.measured))))

    def residuals(self, x: Array, nuisance: Sequence[Array]) -> list[Array]:
        """(measured − simulated) / noise of every batch, (n_b,) each."""
        kept = self._last.get(_key(x, nuisance))
        if kept is not None:
            return [block.residual for block in kept]
        run = simulate(self.network, self.values_at(x), *self.inputs_at(nuisance), last=self._trajectory)
        series = run.shown[0]
        return [self._residual(m, s, v) for m, s, v in zip(self.measured, series, nuisance, strict=True)]

    @cached_property
    def _heats(self) -> list[tuple[str, ...]]:
        """The heat laws that each varying parameter scales."""
        laws = [h.law for h in self.network.heats if not h.disabled]
        return [tuple(w.name for w in laws if k in w.parameters.values()) for k in self.nuisances.parameters]

    def nuisance_offsets(self, nuisance: Sequence[Array]) -> Array:
        """Offsets of each batch's own parameters (B, varying), in fitting coordinates."""
        first = self.nuisances.shared - len(self.nuisances.parameters)
        return np.array([v[first : self.nuisances.shared] for v in nuisance]) * self.nuisances.deviation

    def _own_times(self, nuisance: Sequence[Array]) -> dict[str, Array]:
        """Each batch's own factor (B,) of the heats that differ from run to run, by law."""
        times: dict[str, Array] = {}
        for names, deviation in zip(self._heats, self.nuisance_offsets(nuisance).T, strict=True):
            for name in names:
                times[name] = times.get(name, 1.0) * np.exp(deviation)
        return times

    def free_running_errors(self, values: Array) -> list[Array]:
        """Measured − simulated (n_b,) of every batch in the channels' units, started from its first readings alone."""
        start = start_of(self.network, values, self.inputs)
        series = simulate(self.network, values, self.inputs, start[None]).shown[0]
        return [m.value - m.of(s) for m, s in zip(self.measured, series, strict=True)]

    def residual_series(self, x: Array, nuisance: Sequence[Array]) -> dict[str, dict[str, Array]]:
        """Measured − simulated (rows,) by batch and channel in the channel's unit, NaN where nothing was measured."""
        out: dict[str, dict[str, Array]] = {}
        for m, residual in zip(self.measured, self.residuals(x, nuisance), strict=True):
            out[m.batch_id] = {}
            for c in m.usable.tolist():
                at = m.channel == c
                rows = np.full(int((m.row[at][-1] - m.row[at][0]) // m.stride) + 1, np.nan)
                rows[(m.row[at] - m.row[at][0]) // m.stride] = residual[at] * self.noise[c]
                out[m.batch_id][self.channels[c]] = rows
        return out

    def _blocks(self, x: Array, nuisance: Sequence[Array]) -> Iterator[Block]:
        numbers = list(dict.fromkeys([*self.network.free.tolist(), *self.nuisances.parameters.tolist()]))
        selected = Selected(numbers, len(self.nuisances.start_K) > 0, self.nuisances.surroundings.tolist())
        simulation, *slopes = sensitivities(
            self.network, self.values_at(x), *self.inputs_at(nuisance), selected, last=self._trajectory
        )
        series = simulation.shown[0]
        slope = np.concatenate(slopes, axis=-1)  # (Q, B, K, C)
        free = len(self.unknowns)
        varying = [numbers.index(k) for k in self.nuisances.parameters.tolist()]
        slope = np.concatenate([slope[:free], slope[len(numbers) :], slope[varying]])
        for b, m in enumerate(self.measured):
            whitened = (m.of(slope[:, b]) / self.noise[m.channel]).T
            own = [whitened[:, free:] * self.nuisances.size, self._first_samples(m)]
            yield Block(
                m.batch_id, self._residual(m, series[b], nuisance[b]), whitened[:, :free], np.hstack(own), m.channel
            )

    def inputs_at(self, nuisance: Sequence[Array]) -> tuple[Inputs, Array]:
        """The inputs with the heats and surroundings of the batches' nuisances, and start temperatures (1, B, N)."""
        bodies = len(self.nuisances.start_K)
        shared = np.array([v[: self.nuisances.shared] for v in nuisance]).reshape(len(nuisance), -1)
        start = self.start_degC + shared[:, :bodies] @ self.nuisances.start_K
        times = self._own_times(nuisance) or self.inputs.times
        if not len(self.nuisances.surroundings):
            return self.inputs.with_own(times), start[None]
        offset = np.zeros((len(nuisance), len(self.network.surroundings)))
        own = shared[:, bodies : bodies + len(self.nuisances.surroundings)]
        offset[:, self.nuisances.surroundings] = own * self.nuisances.offset_K
        return self.inputs.with_own(times, offset[None]), start[None]

    def _residual(self, m: Measured, series: Array, nuisance: Array) -> Array:
        """(n_b,) of one batch whose channels were simulated as (K, C)."""
        with np.errstate(invalid="ignore", over="ignore"):
            plain = (m.value - m.of(series)) / self.noise[m.channel]
        return plain - self._first_samples(m) @ nuisance[self.nuisances.shared :]

    def _first_samples(self, m: Measured) -> Array:
        """What the errors' first samples do to the whitened rows, (n_b, usable error channels)."""
        return FIRST_SAMPLE * (m.channel[:, None] == m.usable_errors)


def _key(x: Array, nuisance: Sequence[Array]) -> bytes:
    return np.concatenate([x, *nuisance]).tobytes()


def unknown(p: Parameter) -> Unknown:
    """A free parameter in its fitting coordinate: the prior's centre, not the value, is where it starts."""
    with np.errstate(divide="ignore"):
        low, high = (float(p.to_x(v)) if np.isfinite(v) else v for v in (p.low, p.high))
    return Unknown(p.name, p.unit, float(p.to_x(p.prior_value)), p.spread, low, high, p.scale)
