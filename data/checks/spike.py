"""Single samples far off their neighbours."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import SIGMAS, STEPS, Check, clock, in_time, load_changes, robust_sigma
from data.checks.signals import rolling_median, signals
from data.machine import Machine

_FLOOR = {"temperature": 1.0, "ambient": 3.0, "error": 8.0}  # K, K, µm: below, air and slip can do it
_TYPICAL = 3.0
_ROWS = 2
_HALF = 3  # rows on either side


class Spike(Check):
    """One or two samples that leave and come back: off the median of the seven rows around by 8 sigma,
    5 resolution steps, three times the liveliest tenth of the channel and 1 K (air 3 K) or 8 µm.
    """

    key = "spike"
    words = "single samples far off their neighbours"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        seen = signals(batch)
        names = in_time(batch, "temperature", "ambient", "error")
        # who stands off the rows around by the floor got there in three steps at most
        names = tuple(n for n in names if seen.largest_step(n) * _HALF > _FLOOR[batch.channels[n].role])
        loaded = load_changes(batch) if names else np.zeros(0, bool)
        found = []
        for name in names:
            channel, v = batch.channels[name], seen.values(name)
            off = np.abs(v - rolling_median(v, _HALF, least=4))
            quiet = off[np.isfinite(off) & ~loaded]
            if len(quiet) < 12:
                continue
            limit = max(
                SIGMAS * robust_sigma(quiet, channel.resolution),
                STEPS * (channel.resolution or 0.0),
                _TYPICAL * float(np.quantile(quiet, 0.9)),
                _FLOOR[channel.role],
            )
            with np.errstate(invalid="ignore"):
                hit = [int(r) for r in np.flatnonzero((off > limit) & ~loaded)]
            rows = [r for r in hit if self._single(r, set(hit)) and self._comes_back(v, r, off[r])]
            for r in rows:
                unit = "K" if channel.unit == "degC" else channel.unit
                words = (
                    f"{name} reads {v[r]:.5g} {channel.unit} at {clock(batch.time_s[r])}, {off[r]:.1f} {unit} off the "
                    "samples around it"
                )
                found.append(self.finding(name, words, float(batch.time_s[r]), float(batch.time_s[r])))
        return found

    @staticmethod
    def _single(row: int, hits: set[int]) -> bool:
        first = last = row
        while first - 1 in hits:
            first -= 1
        while last + 1 in hits:
            last += 1
        return last - first + 1 <= _ROWS

    @staticmethod
    def _comes_back(v: np.ndarray, row: int, size: float) -> bool:
        """The rows on both sides agree with each other: a sample at the end of a slope is none."""
        before, after = v[max(0, row - 4) : max(0, row - 1)], v[row + 2 : row + 5]
        before, after = before[np.isfinite(before)], after[np.isfinite(after)]
        return bool(len(before) and len(after) and abs(np.median(after) - np.median(before)) < 0.5 * size)
