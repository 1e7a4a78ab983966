"""Base class of the checks, and what they share: noise and step estimates, intervals of rows, driver changes.

A check is one class plus one line in the registry. `batch` examines one recording, `across` all batches of a machine;
a subclass overrides one or both. Both return findings and change nothing. A check sees the batch with the masks of the
checks before it, so that each fault is reported once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch, Finding
from data.machine import Machine

Bools = NDArray[np.bool_]

EQUAL = 1e-9  # resampling leaves rounding errors in a repeated value


class Signals:
    """Masked values (p, n) of a batch's channels, one row per channel, with cached extremes and steps."""

    def __init__(self, batch: Batch) -> None:
        self._row = {n: i for i, n in enumerate(n for n in batch.channels if n in batch.table.columns)}
        self.matrix: Array = np.empty((len(self._row), batch.n_rows))
        for name, i in self._row.items():
            self.matrix[i] = batch.masked(name)
        self._rest: dict[int, Bools] = {}
        self._excess: dict[str, Array] = {}

    def values(self, name: str) -> Array:
        """As recorded, NaN under every mask, shape (n,); the same memory for all, not to be changed."""
        return self.matrix[self._row[name]]

    def whole(self, name: str) -> bool:
        """Every row has a value."""
        return bool(self._whole[self._row[name]])

    def extremes(self, name: str) -> tuple[float, float]:
        """Least and largest finite value, NaN where there is none."""
        i = self._row[name]
        return float(self._extremes[0][i]), float(self._extremes[1][i])

    def largest_step(self, name: str) -> float:
        """Largest difference of a finite value to the finite one before it, also across holes; 0 without any."""
        return float(self._largest_step[self._row[name]])

    def rests(self, name: str, rows: int) -> bool:
        """False if the channel certainly never repeats one value over `rows` rows."""
        if rows not in self._rest:
            self._rest[rows] = _any_run(self._still, rows - 1)
        return bool(self._rest[rows][self._row[name]])

    def excess(self, name: str) -> Array:
        """`excess` of the channel, shape (n,)."""
        if name not in self._excess:
            self._excess[name] = excess(self.values(name))
        return self._excess[name]

    @cached_property
    def _extremes(self) -> tuple[Array, Array]:
        if not self.matrix.shape[1]:
            nothing = np.full(len(self.matrix), np.nan)
            return nothing, nothing
        low, high = self.matrix.min(axis=1), self.matrix.max(axis=1)
        for i in np.flatnonzero(~(np.isfinite(low) & np.isfinite(high))):
            ok = self.matrix[i][np.isfinite(self.matrix[i])]
            low[i], high[i] = (ok.min(), ok.max()) if len(ok) else (np.nan, np.nan)
        return low, high

    @cached_property
    def _whole(self) -> Bools:
        return np.asarray(np.isfinite(self.matrix).all(axis=1))

    @cached_property
    def _steps(self) -> Array:
        """Absolute differences (p, n - 1)."""
        steps = np.diff(self.matrix, axis=1)
        return np.abs(steps, out=steps)

    @cached_property
    def _largest_step(self) -> Array:
        largest = self._steps.max(axis=1, initial=0.0)
        for i in np.flatnonzero(~self._whole):
            v = self.matrix[i]
            largest[i] = np.abs(np.diff(v[np.isfinite(v)])).max(initial=0.0)
        return largest

    @cached_property
    def _still(self) -> Bools:
        """Rows that may equal the row before (p, n - 1): the bound is that of the channel's largest value."""
        low, high = self._extremes
        size = np.fmax(1.0, np.fmax(np.abs(low), np.abs(high)))
        return self._steps <= EQUAL * size[:, None]


def signals(batch: Batch) -> Signals:
    """The batch's signals under its present masks; made once, kept with the batch."""
    kept = batch.__dict__.get("_signals")
    if not isinstance(kept, Signals):
        kept = batch.__dict__["_signals"] = Signals(batch)
    return kept


def excess(values: Array) -> Array:
    """Step into each row less the median step of the rows around it, shape (n,); row 0 is 0, NaN next to holes."""
    steps = np.diff(values, prepend=values[:1])
    steps[:1] = 0.0
    return steps - rolling_median(steps, half=4)


def rolling_median(values: Array, half: int, least: int = 1) -> Array:
    """Median of the finite values in rows ± half, shape (n,); NaN where fewer than `least` are finite."""
    return pd.Series(values).rolling(2 * half + 1, center=True, min_periods=least).median().to_numpy()


def _any_run(flags: Bools, length: int) -> Bools:
    """Has each row of flags (p, m) `length` True in a row? Shape (p,)."""
    if flags.shape[1] < length:
        return np.zeros(len(flags), bool)
    width = 1
    while width < length:  # a run of a + b is a run of a and one of b, overlapping
        more = min(width, length - width)
        flags = flags[:, : flags.shape[1] - more] & flags[:, more:]
        width += more
    return np.asarray(flags.any(axis=1))


THERMAL = ("temperature", "ambient")
SIGMAS = 8.0  # a clean year has some 1e6 samples; 8 sigma leaves room for tails heavier than Gaussian
STEPS = 5.0  # resolution steps that no rounding explains
THIN_S = 10.0  # a sensor's own mass and a logger's filter spread a step over seconds


class Check:
    """One kind of fault: `key` names it in findings, `summary` describes it in a line.

    `common_cause`: the likely cause where most runs of a machine show the same `habit` ({0} is the machine).
    """

    key: ClassVar[str] = ""
    summary: ClassVar[str] = ""
    common_cause: ClassVar[str] = ""

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        """Findings in one recording."""
        return []

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        """Findings that need the machine's other batches: position in `batches` -> findings."""
        return {}

    def habit(self, batch: Batch, finding: Finding) -> str:
        """What a finding shows, where its only evidence is that the run is unusual; "" where it is a fault in any case.

        What most runs of a machine have in common is no fault. Evidence from physics, from the instrument or from other
        channels does not weaken by repetition: a sensor can be faulty in every run.
        """
        return ""

    def finding(
        self,
        channel: str | None,
        message: str,
        start_s: float | None = None,
        end_s: float | None = None,
        masks: bool = True,
    ) -> Finding:
        return Finding(self.key, channel, message, start_s, end_s, masks)

    def in_rows(
        self, batch: Batch, channel: str | None, first: int, last: int, message: str, masks: bool = True
    ) -> Finding:
        """A finding from the time of row `first` to that of row `last`."""
        return self.finding(channel, message, float(batch.time_s[first]), float(batch.time_s[last]), masks)


def overrule_line(channel: str, check: str, batch_id: str = "") -> str:
    """The entry of the machine file's `overrule` list that lifts a check's masks of a channel."""
    only = f"batch: {batch_id}, " if batch_id else ""
    return f"- {{{only}channel: {channel}, check: {check}, reason: ...}}"


def in_time(batch: Batch, *roles: str) -> tuple[str, ...]:
    """Channels of the given roles whose rows follow each other in time: none that is read here and there on an axis."""
    return tuple(n for n in batch.names(*roles) if not batch.channels[n].position)


def stretches(flags: Bools) -> list[tuple[int, int]]:
    """First and last row of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def constant_runs(values: Array, rows: int = 2) -> list[tuple[int, int]]:
    """First and last row of every run of `rows` or more equal finite values."""
    same = np.abs(np.diff(values)) <= EQUAL * np.maximum(1.0, np.abs(values[1:]))
    edges = np.flatnonzero(np.diff(same.astype(np.int8), prepend=np.int8(0), append=np.int8(0)))
    first, last = edges[::2], edges[1::2]
    long = last - first + 1 >= rows
    return list(zip(first[long].tolist(), last[long].tolist(), strict=True))


def robust_sigma(values: Array, resolution: float | None) -> float:
    """Scale of values around 0 by 1.4826 median|v| (Hampel, 1974), not below half a resolution step."""
    ok = np.abs(values[np.isfinite(values)])
    scale = 1.4826 * float(np.median(ok)) if len(ok) else 0.0
    return max(scale, 0.5 * (resolution or 0.0), 1e-9)


def step_limit(e: Array, resolution: float | None) -> float:
    """Smallest step that neither noise nor rounding explains, in the channel's unit."""
    return max(SIGMAS * robust_sigma(e, resolution), STEPS * (resolution or 0.0))


def thinned(batch: Batch) -> Batch | None:
    """Every k-th row, THIN_S apart, of a recording at least twice as fast; None where it is not.

    On a fast recording a step that the sensor or the logger spreads over seconds is no step from row to row. Values
    are picked, not averaged: an average would share a sharp step out over two rows.
    """
    every = int(THIN_S / batch.step_s + 1e-9) if batch.step_s else 1
    if every < 2:
        return None
    return replace(batch, table=batch.table.iloc[::every].reset_index(drop=True))


def widened(found: Finding, batch: Batch, thin: Batch) -> Finding:
    """A finding of `thinned` rows as one of all rows: it covers the rows between the picked ones as well."""
    more = thin.step_s - batch.step_s
    start_s, end_s = found.start_s, found.end_s
    return replace(
        found,
        start_s=None if start_s is None else max(0.0, start_s - more),
        end_s=None if end_s is None else min(float(batch.time_s[-1]), end_s + more),
    )


def row_medians(values: Array) -> Array:
    """Median of the finite values of each row (n, m), (n,); NaN where there is none."""
    return np.array([np.median(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in values])


def smallest_step(batch: Batch, name: str) -> float:
    """The stated resolution, else 0."""
    return batch.channels[name].resolution or 0.0


def standing(batch: Batch) -> Bools:
    """Rows where the spindle stands or its speed is unknown; shape (n,)."""
    spindle = [n for n in batch.names("driver") if batch.channels[n].unit == "rpm"] or list(batch.names("driver"))
    runs = np.zeros(batch.n_rows, bool)
    for name in spindle:
        v = np.abs(np.nan_to_num(batch.values(name), nan=0.0))
        runs |= v > 0.01 * max(float(v.max(initial=0.0)), 1e-9)
    return ~runs


def clock(seconds: float) -> str:
    """Time from the batch's start as text: ``5 h 29 min``."""
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


def span_text(batch: Batch, first: int, last: int) -> str:
    """``from 5 h 01 min to 6 h 00 min`` of rows first..last."""
    t = batch.time_s
    return f"from {clock(t[first])} to {clock(t[last])}"
