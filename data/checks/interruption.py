"""All temperatures jump together between two rows: the recording stood still, the machine did not."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Check, clock, step_limit, thinned, widened
from data.checks.signals import signals
from data.machine import Machine

_SHARE = 0.6
_CHANNELS = 4
_FLOOR_K = 1.0  # an air-conditioning swing or a speed step moves some sensors, not most, by this within a row


class Interruption(Check):
    """Most temperatures step in one row. What the error channels show afterwards hangs on an unknown zero."""

    key = "interruption"
    words = "recording interrupted: all temperatures jump together"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = self._at(batch)
        if not found and (thin := thinned(batch)):
            found = [widened(f, batch, thin) for f in self._at(thin)]
        return found

    def _at(self, batch: Batch) -> list[Finding]:
        seen = signals(batch)
        names = [
            n
            for n in batch.names(*THERMAL)
            if (batch.n_rows if seen.whole(n) else np.isfinite(seen.values(n)).sum()) > 10
        ]
        # below, two steps less twice the trend must exceed the floor: no more than four times the largest step
        able = sum(seen.largest_step(n) > _FLOOR_K / 4.0 for n in names)
        if len(names) < _CHANNELS or able < _SHARE * len(names):
            return []
        jumped = np.zeros((len(names), batch.n_rows), bool)
        size = np.zeros((len(names), batch.n_rows))
        for i, name in enumerate(names):
            v = seen.values(name)
            # two rows together: resampling can spread one jump over two
            two = np.concatenate([np.zeros(2), v[2:] - v[:-2]])[: batch.n_rows] if batch.n_rows > 2 else 0 * v
            trend = seen.excess(name)
            limit = max(step_limit(trend, batch.channels[name].resolution), _FLOOR_K)
            with np.errstate(invalid="ignore"):
                size[i] = np.nan_to_num(two - 2.0 * (np.diff(v, prepend=v[:1]) - trend))
                jumped[i] = np.abs(size[i]) > limit
        share = jumped.mean(axis=0)
        rows = np.flatnonzero(share >= _SHARE)
        rows = rows[rows > 2]
        if not len(rows):
            return []
        row = int(rows[0])
        if (np.abs(np.diff([seen.values(n)[row - 1 : row + 1] for n in names])) > _FLOOR_K).mean() < _SHARE / 2:
            row = min(row + 1, batch.n_rows - 1)
        moved = size[:, rows[0]][jumped[:, rows[0]]]
        start = float(batch.time_s[max(row - 1, 0)])
        low, high = np.min(np.abs(moved)), np.max(np.abs(moved))
        words = (
            f"{len(moved)} of {len(names)} temperatures jump together at {clock(start)}, by {low:.1f} to {high:.1f} K "
            f"within {2 * batch.step_s:.0f} s: the recording was interrupted"
        )
        return [
            self.finding(name, f"{words}; {name} after it cannot be tied to the zero at the start", start)
            for name in batch.names("error")
        ]
