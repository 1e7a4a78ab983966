"""Checks of the time axis: repaired clock, gaps, interrupted recordings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Check, clock, in_time, signals, span_text, step_limit, stretches, thinned, widened
from data.guess import sustained_rate, unit_doubt
from data.machine import Machine

_REPAIRS = {
    "unparsable_time": "rows without a readable time were dropped",
    "time_outliers": "rows with a time far off both neighbours were dropped",
    "backward_steps": "steps back in time were put in order",
    "clock_restarts": "restarts of the clock, carried on without a pause; how long the pause was is not known",
    "duplicates": "rows with the time of another row were averaged with it",
}


_FIRST = pd.Timestamp("1990-01-01")  # before, a clock without a battery counts from its zero: 1970, 1980
_AHEAD = pd.Timedelta(days=2)  # of this computer: time zones and a late clock


class Clock(Check):
    key = "clock"
    summary = "the recording's clock was repaired, or its date cannot be right"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = [
            self.finding(None, f"clock: {batch.repairs[kind]} {repair}", masks=False)
            for kind, repair in _REPAIRS.items()
            if batch.repairs.get(kind)
        ]
        unit = machine.recording.time.unit
        if unit != "timestamp" and machine.recording.time.step is None and batch.n_rows > 1:
            warm = [batch.values(n) for n in batch.names(*THERMAL) if n in batch.table.columns]
            rate = max((sustained_rate(batch.time_s, v) for v in warm), default=0.0)
            if doubt := unit_doubt(unit, batch.step_s, float(batch.time_s[-1]), rate):
                message = f"clock: recording.time.unit: {doubt}; correct it, step_s and max_gap_s if so"
                found.append(self.finding(None, message, masks=False))
        start = batch.start
        if start is not None and not _FIRST <= start <= pd.Timestamp.now() + _AHEAD:
            when = "before any logger of this kind" if start < _FIRST else "in the future"
            message = (
                f"clock: the recording starts on {start:%Y-%m-%d}, {when}. Seasons and the order of runs follow from "
                "it: set the logger's clock and correct the time column, or recording.start_from_name"
            )
            found.append(self.finding(None, message, masks=False))
        return found


class Truncated(Check):
    """Found while a file is read. Where it was cut, rows are missing: nobody knows how many."""

    key = "truncated"
    summary = "the file ends within a row"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        if not batch.repairs.get("truncated"):
            return []
        end = float(batch.time_s[-1]) if batch.n_rows else 0.0
        message = (
            f"the file ends within a row, {clock(end)} after the start: it was cut, and what follows is missing; copy "
            "the whole file and ingest it again, or withdraw the run (thermodrift lake withdraw)"
        )
        return [self.finding(None, message, end, masks=False)]


_SHORT_BATCHES = 5
_SHORT_SHARE = 1.0 / 3.0


class Short(Check):
    """A run of less than a third of the median length has not gone through the machine's warming."""

    key = "short"
    summary = "much shorter than the machine's other runs"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        if len(batches) < _SHORT_BATCHES:
            return {}
        length_s = np.array([float(b.time_s[-1]) if b.n_rows else 0.0 for b in batches])
        usual_s = float(np.median(length_s))
        found = {}
        for k in np.flatnonzero(length_s < _SHORT_SHARE * usual_s):
            message = (
                f"the run lasts {clock(length_s[k])}, the median run {clock(usual_s)}: if it was broken off, withdraw "
                "it (thermodrift lake withdraw)"
            )
            found[int(k)] = [self.finding(None, message, masks=False)]
        return found


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
            # a hole that the grid would have bridged stems from cells without a value, which have a finding
            least = machine.recording.max_gap_s if any(f.channel == name for f in batch.findings) else 0.0
            holes = stretches(empty[name] & ~everywhere)
            found += [self._gap(batch, name, a, b) for a, b in holes if (b - a + 1) * batch.step_s > least]
        return found

    def _gap(self, batch: Batch, name: str | None, a: int, b: int) -> Finding:
        minutes = (b - a + 1) * batch.step_s / 60.0
        who = f"{name} has no values" if name else "no channel has values"
        message = f"{who} {span_text(batch, a, b)} ({minutes:.3g} min)"
        return self.in_rows(batch, name, a, b, message, masks=False)


_SHARE = 0.6
_CHANNELS = 4
_FLOOR_K = 1.0  # an air-conditioning swing or a speed step moves some sensors, not most, by this within a row


class Interruption(Check):
    """Most temperatures step in one row. What the error channels show afterwards hangs on an unknown zero."""

    key = "interruption"
    summary = "recording interrupted: all temperatures jump together"
    common_cause = "the time unit (recording.time.unit: {0.recording.time.unit}) or a normal event of this machine"

    def habit(self, batch: Batch, finding: Finding) -> str:
        return self.key

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
