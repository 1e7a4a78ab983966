"""What every check shares: its interface, noise and step estimates, stretches, driver changes.

A check is one class in one file plus one line in the registry. `batch` looks at one recording, `across`
at all batches of a machine; either may stay as it is here. Both return findings and change nothing.
A check sees the batch with the masks of the checks before it, so one fault is told once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.batch import Batch, Finding
from data.machine import Machine

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

THERMAL = ("temperature", "ambient")
SIGMAS = 8.0  # a clean year has some 1e6 samples; 8 sigma leaves room for tails heavier than Gaussian
STEPS = 5.0  # resolution steps that no rounding explains
_EQUAL = 1e-9  # resampling leaves rounding errors in a repeated value
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


def stretches(flags: Bools) -> list[tuple[int, int]]:
    """First and last row of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def constant_runs(values: Array) -> list[tuple[int, int]]:
    """First and last row of every run of two or more equal finite values."""
    same = np.abs(np.diff(values)) <= _EQUAL * np.maximum(1.0, np.abs(values[1:]))
    return [(a, b + 1) for a, b in stretches(same)]


def excess(values: Array, half: int = 4) -> Array:
    """Step into each row less the median step of the rows around it, shape (n,); row 0 is 0, NaN beside holes."""
    steps = np.concatenate([[0.0], np.diff(values)])
    trend = pd.Series(steps).rolling(2 * half + 1, center=True, min_periods=1).median().to_numpy()
    return steps - trend


def robust_sigma(values: Array, resolution: float | None) -> float:
    """Scale of values around 0 by 1.4826 median|v| (Hampel, 1974), not below half a resolution step."""
    ok = np.abs(values[np.isfinite(values)])
    scale = 1.4826 * float(np.median(ok)) if len(ok) else 0.0
    return max(scale, 0.5 * (resolution or 0.0), 1e-9)


def step_limit(e: Array, resolution: float | None) -> float:
    """Smallest step that neither noise nor rounding explains, in the channel's unit."""
    return max(SIGMAS * robust_sigma(e, resolution), STEPS * (resolution or 0.0))


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
    out = hit.copy()
    for row in np.flatnonzero(hit):
        out[max(0, row - 1) : row + settle + 1] = True
    return out


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
