"""What every check shares: its interface, noise and step estimates, stretches, driver changes.

A check is one class in one file plus one line in the registry. `batch` looks at one recording, `across`
at all batches of a machine; either may stay as it is here. Both return findings and change nothing.
A check sees the batch with the masks of the checks before it, so one fault is told once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from data.batch import Batch, Finding
from data.checks.signals import EQUAL, Array, Bools
from data.machine import Machine

THERMAL = ("temperature", "ambient")
SIGMAS = 8.0  # a clean year has some 1e6 samples; 8 sigma leaves room for tails heavier than Gaussian
STEPS = 5.0  # resolution steps that no rounding explains
THIN_S = 10.0  # a sensor's own mass and a logger's filter spread a step over seconds
SETTLE_S = 600.0  # after a start, stop or speed change the machine may move as fast as it likes


class Check:
    """One kind of fault: `key` names it in findings, `words` says it in a line."""

    key: ClassVar[str] = ""
    words: ClassVar[str] = ""

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        """Findings in one recording."""
        return []

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        """Findings that need the machine's other batches: position in `batches` -> findings."""
        return {}

    def finding(
        self,
        channel: str | None,
        words: str,
        start_s: float | None = None,
        end_s: float | None = None,
        masks: bool = True,
    ) -> Finding:
        return Finding(self.key, channel, words, start_s, end_s, masks)


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


def smallest_step(batch: Batch, name: str) -> float:
    """The stated resolution, else 0."""
    return batch.channels[name].resolution or 0.0


def load_changes(batch: Batch) -> Bools:
    """Rows where a driver changes and the SETTLE_S after, and the batch's first SETTLE_S; shape (n,)."""
    settle = max(2, int(np.ceil(SETTLE_S / batch.step_s))) if batch.step_s else 2
    hit = np.zeros(batch.n_rows, bool)
    hit[:1] = True
    for name in batch.names("driver"):
        v = np.nan_to_num(batch.values(name), nan=0.0)
        span = float(np.ptp(v)) if len(v) else 0.0
        if span > 0:
            hit[1:] |= np.abs(np.diff(v)) > 0.05 * span
    near = np.zeros(batch.n_rows + 1, np.int64)  # +1 where a stretch begins, -1 behind its end
    rows = np.flatnonzero(hit)
    np.add.at(near, np.maximum(rows - 1, 0), 1)
    np.add.at(near, np.minimum(rows + settle + 1, batch.n_rows), -1)
    return np.cumsum(near[:-1]) > 0


def standing(batch: Batch) -> Bools:
    """Rows where the spindle stands or nobody says that it runs; shape (n,)."""
    spindle = [n for n in batch.names("driver") if batch.channels[n].unit == "rpm"] or list(batch.names("driver"))
    runs = np.zeros(batch.n_rows, bool)
    for name in spindle:
        v = np.abs(np.nan_to_num(batch.values(name), nan=0.0))
        runs |= v > 0.01 * max(float(v.max(initial=0.0)), 1e-9)
    return ~runs


def clock(seconds: float) -> str:
    """Time from the batch's start for people: ``5 h 29 min``."""
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"


def span_words(batch: Batch, first: int, last: int) -> str:
    """``from 5 h 01 min to 6 h 00 min`` of rows first..last."""
    t = batch.time_s
    return f"from {clock(t[first])} to {clock(t[last])}"
