"""Checks of the time axis: repaired clock, gaps, interrupted recordings."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Check, clock, in_time, signals, span_text, step_limit, stretches, thinned, widened
from data.machine import Machine

_REPAIRS = {
    "unparsable_time": "rows without a readable time were dropped",
    "time_outliers": "rows with a time far off both neighbours were dropped",
    "backward_steps": "steps back in time were put in order",
    "clock_restarts": "restarts of the clock, carried on without a pause; how long the pause was is not known",
    "duplicates": "rows with the time of another row were averaged with it",
}


class Clock(Check):
    key = "clock"
    summary = "the recording's clock was repaired"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        return [
            self.finding(None, f"clock: {batch.repairs[kind]} {repair}", masks=False)
            for kind, repair in _REPAIRS.items()
            if batch.repairs.get(kind)
        ]


class Gap(Check):
    key = "gap"
    summary = "nothing recorded"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        names = [n for n in in_time(batch, "temperature", "ambient", "error") if n in batch.table.columns]
        if not names or not batch.n_rows:
            return []
        if all(signals(batch).whole(n) for n in names):
            return []
        empty = {n: ~np.isfinite(batch.values(n)) for n in names}
        everywhere = np.logical_and.reduce(list(empty.values()))
        found = [self._gap(batch, None, a, b) for a, b in stretches(everywhere)]
        for name in names:
            if empty[name].all() and not everywhere.all():
                found.append(self.finding(name, f"{name} was not recorded", masks=False))
                continue
            found += [self._gap(batch, name, a, b) for a, b in stretches(empty[name] & ~everywhere)]
        return found

    def _gap(self, batch: Batch, name: str | None, a: int, b: int) -> Finding:
        minutes = (b - a + 1) * batch.step_s / 60.0
        who = f"{name} has no values" if name else "no channel has values"
        message = f"{who} {span_text(batch, a, b)} ({minutes:.3g} min)"
        return self.finding(name, message, float(batch.time_s[a]), float(batch.time_s[b]), masks=False)


_SHARE = 0.6
_CHANNELS = 4
_FLOOR_K = 1.0  # an air-conditioning swing or a speed step moves some sensors, not most, by this within a row


class Interruption(Check):
    """Most temperatures step in one row. What the error channels show afterwards hangs on an unknown zero."""

    key = "interruption"
    summary = "recording interrupted: all temperatures jump together"

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
        message = (
            f"{len(moved)} of {len(names)} temperatures jump together at {clock(start)}, by {low:.1f} to {high:.1f} K "
            f"within {2 * batch.step_s:.0f} s: the recording was interrupted"
        )
        return [
            self.finding(name, f"{message}; {name} after it cannot be tied to the zero at the start", start)
            for name in batch.names("error")
        ]
