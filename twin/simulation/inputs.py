"""Inputs of a simulation: held drivers and linearly varying surroundings on one time grid per batch."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Numeric
from data.batch import Batch
from data.checks import why_missing
from data.errors import InputError, closest
from twin.mechanisms.base import View
from twin.network import Heat, Law
from twin.run_plan.table import fill_short_gaps

if TYPE_CHECKING:
    from twin.network import Network
    from twin.run_plan import RunPlan

STEP = 1e-30  # of a complex step: its square vanishes, so that derivatives have no truncation error
EVERY = slice(None)


@dataclass(frozen=True)
class Intervals:
    """Evaluates laws in intervals of B batches.

    A law that works point by point gets (…, B, 2, m): start and end of each interval, with the interval's drivers. A
    law along time gets (…, B, m): the starts, so that what it does in an interval depends on nothing later.
    """

    inputs: Inputs

    def call(
        self,
        law: Law,
        effect: str,
        values: Numeric,
        along: bool,
        part: slice = EVERY,
        degC: Mapping[str, Numeric] | None = None,
        rise_K: Mapping[str, Numeric] | None = None,
    ) -> Numeric:
        """A law's effect at values (P, n) in the intervals `part`: (…, m) `along` time, else (…, 2, m) at both ends.

        Temperatures by the law's ports; the result broadcasts to (P, B, …).
        """
        ends = 0 if along else slice(None)
        driver = {role: self.inputs.drivers[c][:, part] for role, c in law.drivers.items()}
        driver = driver if along else {role: d[:, None] for role, d in driver.items()}
        time_s, clock_h = self._time_s[:, ends, part], self._clock_h[:, ends, part]
        view = View(degC or {}, rise_K or {}, driver, time_s, clock_h, self._step_s)
        return np.asarray(getattr(law.mechanism, effect)(view, parameters_of(law, values, 2 if along else 3)))

    def ends(self, out: Numeric, n_sets: int, along: bool) -> Numeric:
        """What `call` gives for all intervals as (n_sets, B, M, 2); a law along time holds in each."""
        n_batches, n_intervals = self.inputs.valid.shape
        if along:
            out = np.broadcast_to(out, (n_sets, n_batches, n_intervals))
            return np.broadcast_to(out[..., None], (*out.shape, 2))
        return np.moveaxis(np.broadcast_to(out, (n_sets, n_batches, 2, n_intervals)), 2, 3)

    def times(self, heat: Heat, out: Numeric, along: bool) -> Numeric:
        """A heat as `call` gives it, times each batch's own factor where it has one."""
        times = self.inputs.times.get(heat.law.name)
        return out if times is None else out * times.reshape(-1, *(1,) * (1 if along else 2))

    @cached_property
    def _time_s(self) -> Numeric:
        start_s, end_s = self.inputs.time_s[:, :-1], self.inputs.time_s[:, 1:]
        # an end is just before the border: what switches there does so in the next interval
        return np.stack([start_s, end_s - 1e-7 * self.inputs.dt_s], axis=1)

    @cached_property
    def _clock_h(self) -> Numeric:
        if np.isnan(self.inputs.clock_h).all():
            return np.full(self._time_s.shape, np.nan)
        return np.asarray((self.inputs.clock_h[:, None, None] + self._time_s / 3600.0) % 24.0)

    @cached_property
    def _step_s(self) -> float:
        """The intervals' length, nan where it varies."""
        dt_s = self.inputs.dt_s
        return float(dt_s[0, 0]) if dt_s.size and np.ptp(dt_s) < 1e-6 * dt_s.max() else np.nan


def parameters_of(law: Law, values: Numeric, axes: int) -> dict[str, Numeric]:
    """A law's parameters (P, 1, …) with `axes` further axes, from values (P, n)."""
    return {name: values[:, j].reshape(-1, *(1,) * axes) for name, j in law.parameters.items()}


def at_borders(ends: Numeric) -> Numeric:
    """Values at both ends of every interval (…, M, 2) at the borders (…, M + 1): where they jump, before the jump."""
    return np.concatenate([ends[..., :1, 0], ends[..., 1]], axis=-1)


def stepped(values: Numeric, j: int) -> Numeric:
    """Values (P, n) with parameter j a complex step ahead."""
    out = values.astype(complex)
    out[:, j] += 1j * STEP
    return out


def along_time(heat: Heat) -> bool:
    return any(law.mechanism.along_time for law in (heat.law, *heat.factors))


def heat_W(heat: Heat, call: Callable[[Law, str], Numeric]) -> Numeric:
    """A heat's law times the laws that multiply it; `call` evaluates a law's effect."""
    out = call(heat.law, "heat_W")
    for factor in heat.factors:
        out = out * call(factor, "factor")
    about_W, exponent = heat.bent
    return out if exponent == 1.0 else np.sign(out) * about_W * np.abs(out / about_W) ** exponent


def reads_time(law: Law, effect: str) -> bool:
    """Whether a law without ports reads the time or the clock; if not, its value follows from drivers alone."""
    watched = _Watched({role: np.ones(1) for role in law.drivers})
    with np.errstate(all="ignore"):
        getattr(law.mechanism, effect)(watched, {name: np.ones(1) for name in law.parameters})
    return law.mechanism.along_time or bool(watched.read & {"time_s", "clock_h"})


@dataclass(frozen=True)
class _Watched(View):
    """A view that notes which of its fields are read."""

    read: set[str] = field(default_factory=set)

    def __init__(self, driver: Mapping[str, Numeric]) -> None:
        object.__setattr__(self, "read", set())
        super().__init__(driver=driver, clock_h=np.zeros(1), step_s=1.0)

    def __getattribute__(self, name: str) -> Any:
        if name in ("time_s", "clock_h"):
            object.__getattribute__(self, "read").add(name)
        return object.__getattribute__(self, name)


MAX_GAP_S = 900.0


@dataclass(frozen=True)
class Inputs:
    """B batches side by side, M intervals of the longest; shorter ones are padded by holding their last values.

    time_s (B, M + 1) borders from each batch's start; n_intervals (B,) the valid ones; drivers by channel (B, M), held
    in each interval; recorded surroundings by channel (B, M + 1) at the borders, linear between (a plan may also give
    one by the surrounding's own name); clock_h (B,) time of day at the start, nan if unknown; first: by channel the
    first readings (B,), nan where there is none; every: how many intervals lie between two rows of the recording, so
    that borders ``::every`` are its rows; at_rows: by driver what the K rows show (B, K), where that is not what holds
    in the interval behind them; times: by heat law what its watts are multiplied by in each batch (B,);
    offsets_K (P or 1, B, S): what is added to the surroundings of each batch, per parameter set.
    """

    batch_ids: tuple[str, ...]
    time_s: Array
    n_intervals: NDArray[np.int64]
    drivers: Mapping[str, Array]
    recorded: Mapping[str, Array]
    clock_h: Array
    first: Mapping[str, Array]
    every: int = 1
    at_rows: Mapping[str, Array] = field(default_factory=dict)
    times: Mapping[str, Array] = field(default_factory=dict)
    offsets_K: Array | None = None
    kept: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False, compare=False)  # worked out once

    def __getstate__(self) -> dict[str, Any]:
        """Without what is worked out once: its keys hold for this process alone."""
        return {**{k: v for k, v in self.__dict__.items() if k in self.__dataclass_fields__}, "kept": {}}

    @cached_property
    def dt_s(self) -> Array:
        """Interval lengths (B, M)."""
        return np.diff(self.time_s, axis=1)

    @cached_property
    def intervals(self) -> Intervals:
        """What laws see of them."""
        return Intervals(self)

    @property
    def n_batches(self) -> int:
        return len(self.batch_ids)

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Which intervals are no padding, (B, M)."""
        return np.asarray(np.arange(self.time_s.shape[1] - 1) < self.n_intervals[:, None])

    def refined(self, factor: int) -> Inputs:
        """Every interval cut into equal parts: drivers held, surroundings linear; the recording's rows stay."""
        if factor == 1:
            return self
        return replace(
            self,
            time_s=_between(self.time_s, factor),
            n_intervals=self.n_intervals * factor,
            drivers={n: np.repeat(v, factor, axis=1) for n, v in self.drivers.items()},
            recorded={n: _between(v, factor) for n, v in self.recorded.items()},
            every=self.every * factor,
        )

    def with_own(self, times: Mapping[str, Array], offsets_K: Array | None = None) -> Inputs:
        """The same with each batch's own `times` and `offsets_K`; cached results stay shared."""
        out = replace(self, times=times, offsets_K=offsets_K)
        object.__setattr__(out, "kept", self.kept)
        return out

    def batch(self, numbers: Sequence[int] | slice) -> Inputs:
        """Some of the batches."""
        at = np.arange(self.n_batches)[numbers]
        return replace(
            self,
            batch_ids=tuple(self.batch_ids[i] for i in at),
            time_s=self.time_s[at],
            n_intervals=self.n_intervals[at],
            drivers={n: v[at] for n, v in self.drivers.items()},
            recorded={n: v[at] for n, v in self.recorded.items()},
            clock_h=self.clock_h[at],
            first={n: v[at] for n, v in self.first.items()},
            at_rows={n: v[at] for n, v in self.at_rows.items()},
            times={n: v[at] for n, v in self.times.items()},
            offsets_K=None if self.offsets_K is None else self.offsets_K[:, at],
        )


def inputs_of(network: Network, batches: Sequence[Batch], substeps: int = 1, max_gap_s: float = MAX_GAP_S) -> Inputs:
    """The inputs that a network needs from recordings, masked stretches filled up to `max_gap_s`.

    A driver holds its last value; a surrounding's temperature is interpolated. `substeps` cuts each recorded interval
    into equal parts.

    Raises:
        InputError: no batches, a batch with fewer than two rows or without the needed channels, a longer gap.
    """
    if not batches:
        raise InputError(f"machine {network.machine}: no batches to simulate; name at least one")
    surroundings = [s.channel for s in network.surroundings if s.channel]
    for batch in batches:
        _check_channels(network, batch, [*network.drivers, *surroundings])
    shown = {n: [_filled(b, n, max_gap_s, hold=True) for b in batches] for n in network.drivers}
    drivers = {n: [_held(b, n, v)[:-1] for b, v in zip(batches, own, strict=True)] for n, own in shown.items()}
    recorded = {n: [_filled(b, n, max_gap_s, hold=False) for b in batches] for n in dict.fromkeys(surroundings)}
    starts = [*(r.channel for r in network.readings), *(c for s in network.surroundings for c in s.first)]
    first = {n: np.array([_first(b, n, max_gap_s) for b in batches]) for n in dict.fromkeys(starts)}
    for s in network.surroundings:
        if s.first:
            _check_first(s.name, s.first, first, batches)
    n_intervals = np.array([b.n_rows - 1 for b in batches])
    longest = int(n_intervals.max())
    inputs = Inputs(
        batch_ids=tuple(b.batch_id for b in batches),
        time_s=np.stack([b.step_s * np.arange(longest + 1) for b in batches]),
        n_intervals=n_intervals,
        drivers={n: _padded(v, longest) for n, v in drivers.items()},
        recorded={n: _padded(v, longest + 1) for n, v in recorded.items()},
        clock_h=np.array([_clock_h(b) for b in batches]),
        first=first,
        at_rows={n: _padded(v, longest + 1) for n, v in shown.items() if any(n in b.held for b in batches)},
    )
    return inputs.refined(substeps)


def acting(batches: Sequence[Batch], lead_rows: float) -> list[Batch]:
    """The batches whose drivers act so many rows (0 to 1) before the row that first shows a change.

    Between two rows the mean of what holds in either part of the interval acts.
    """
    return [replace(b, held={n: _ahead(b.masked(n), lead_rows) for n in b.names("driver") if n in b.table.columns})
            if lead_rows else b for b in batches]  # fmt: skip


def _ahead(values: Array, lead_rows: float) -> Array:
    after = np.append(values[1:], values[-1:])
    return np.where(np.isfinite(values) & np.isfinite(after), (1.0 - lead_rows) * values + lead_rows * after, values)


def _held(batch: Batch, channel: str, shown: Array) -> Array:
    """What holds from each row to the next (n,); where that is not known, what the row shows."""
    held = batch.held.get(channel, shown)
    return np.where(np.isfinite(held), held, shown)


def inputs_of_plan(network: Network, plan: RunPlan, clock_h: float = math.nan) -> Inputs:
    """The inputs that a network needs from a run plan: one batch of the plan's name.

    A surrounding is taken from the plan under its own name or its channel's; one that the network knows as a constant
    may be given by name too. Sensors start as the bodies that they sit on.

    Raises:
        InputError: the plan lacks a recorded surrounding or a driver that the network needs.
    """
    where = f"run plan {plan.source or plan.name}"
    for name in network.drivers:
        if name not in plan.drivers:
            raise InputError(f"{where}: no driver {name!r}, which the twin needs; {closest(name, plan.drivers)}")
    recorded = {}
    for s in network.surroundings:
        if s.name in plan.surroundings:
            recorded[s.channel or s.name] = plan.surroundings[s.name][None]
        elif s.channel and s.channel in plan.surroundings:
            recorded[s.channel] = plan.surroundings[s.channel][None]
        elif s.channel:
            raise InputError(
                f"{where}: no surrounding {s.name!r}; add surroundings: {{{s.name}: 20 degC}} or a column {s.channel!r}"
            )
    cells = start_of_plan(network, plan)[0, 0]
    channels = {c for s in network.surroundings for c in s.first}
    first = {c: np.full(1, plan.initial_degC) for c in channels}
    first |= {r.channel: np.array([r.cells @ cells]) for r in network.readings}
    return Inputs(
        batch_ids=(plan.name,),
        time_s=plan.time_s[None],
        n_intervals=np.array([len(plan.time_s) - 1]),
        drivers={n: plan.drivers[n][None] for n in network.drivers},
        recorded=recorded,
        clock_h=np.array([clock_h]),
        first=first,
    )


def start_of_plan(network: Network, plan: RunPlan) -> Array:
    """Start temperatures of all cells (1, 1, N), degC, as the plan gives them by body."""
    start = np.full((1, 1, network.n_cells), plan.initial_degC)
    for body, cells in network.bodies.items():
        start[..., cells] = plan.start_degC(body)
    return start


def _between(values: Array, factor: int) -> Array:
    """Borders (B, M + 1) with each interval cut into equal parts, (B, M factor + 1), linear between."""
    share = np.arange(factor) / factor
    inner = values[:, :-1, None] * (1 - share) + values[:, 1:, None] * share
    return np.concatenate([inner.reshape(len(values), -1), values[:, -1:]], axis=1)


def _padded(rows: Sequence[Array], length: int) -> Array:
    return np.stack([np.pad(v, (0, length - len(v)), mode="edge") for v in rows])


def _check_channels(network: Network, batch: Batch, needed: Sequence[str]) -> None:
    if batch.n_rows < 2:
        raise InputError(f"batch {batch.batch_id}: has {batch.n_rows} rows, a simulation needs 2 or more; leave it out")
    missing = [n for n in dict.fromkeys(needed) if n not in batch.table.columns]
    if missing and len(missing) == len(set(needed)):
        raise InputError(
            f"batch {batch.batch_id}: has none of the channels that the twin of {network.machine} needs "
            f"({', '.join(missing)}); check that it is a recording of this machine, or leave it out"
        )
    if missing:
        raise InputError(
            f"batch {batch.batch_id}: no channel {missing[0]!r}, which the twin of {network.machine} needs; "
            "record it, or leave the batch out"
        )


def _filled(batch: Batch, channel: str, max_gap_s: float, hold: bool) -> Array:
    """A channel without gaps (n,).

    Raises:
        InputError: a gap longer than `max_gap_s`, the first such: batch, channel, from when to when.
    """
    values = batch.masked(channel)
    if np.isnan(values).all():
        raise InputError(
            f"batch {batch.batch_id}: channel {channel!r} has no value at all{why_missing(batch, channel)}; leave the "
            "batch out"
        )
    for start_s, end_s in _gaps(np.isnan(values), batch.time_s):
        if end_s - start_s > max_gap_s * (1 + 1e-9):
            raise InputError(
                f"batch {batch.batch_id}: channel {channel!r} has no value from {start_s:g} s to {end_s:g} s, longer "
                f"than the {max_gap_s:g} s that may be bridged{why_missing(batch, channel)}; cut the batch there, "
                "or widen max_gap_s"
            )
    return fill_short_gaps(values, batch.time_s, math.inf, hold, "")


def _gaps(bad: NDArray[np.bool_], time_s: Array) -> Iterator[tuple[float, float]]:
    """Each gap's first empty row and the next value, s."""
    edges = np.flatnonzero(np.diff(np.r_[False, bad, False].astype(int)))
    for first, behind in zip(edges[::2], edges[1::2], strict=True):
        yield float(time_s[first]), float(time_s[min(behind, len(time_s) - 1)])


def _first(batch: Batch, channel: str, max_gap_s: float) -> float:
    """The first reading, nan where there is none within `max_gap_s` of the start."""
    if channel not in batch.table.columns:
        return math.nan
    values = batch.masked(channel)
    good = np.flatnonzero(~np.isnan(values) & (batch.time_s <= max_gap_s))
    return float(values[good[0]]) if len(good) else math.nan


def _check_first(
    surrounding: str, channels: Sequence[str], first: Mapping[str, Array], batches: Sequence[Batch]
) -> None:
    missing = np.isnan(np.stack([first[c] for c in channels])).all(axis=0)
    if missing.any():
        raise InputError(
            f"batch {batches[int(missing.argmax())].batch_id}: surrounding {surrounding!r} needs a first reading of "
            f"{' or '.join(channels)}, and there is none; leave the batch out, or give the surrounding a value"
        )


def _clock_h(batch: Batch) -> float:
    """Time of day at the start."""
    if batch.start is None:
        return math.nan
    midnight = batch.start.normalize()
    return float((batch.start - midnight).total_seconds() / 3600.0)


def intervals_at_rows(intervals: int, every: int) -> NDArray[np.int64]:
    """Numbers (K,) of the intervals that begin at the rows of the recordings, every `every`th; of the last row that
    before it.

    A row shows what holds from there on, and a shaft that moves with the speed has moved in the row that shows it.
    """
    return np.minimum(np.arange(0, intervals + 1, every), intervals - 1)
