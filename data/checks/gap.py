"""Stretches where nothing was recorded, and channels that a recording lacks. Nothing to mask: they are empty."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import Check, in_time, span_words, stretches
from data.checks.signals import signals
from data.machine import Machine


class Gap(Check):
    key = "gap"
    words = "nothing recorded"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        names = [n for n in in_time(batch, "temperature", "ambient", "error") if n in batch.table.columns]
        if not names or not batch.n_rows:
            return []
        if all(signals(batch).whole(n) for n in names):
            return []
        empty = {n: ~np.isfinite(batch.values(n)) for n in names}
        everywhere = np.logical_and.reduce(list(empty.values()))
        found = [self._told(batch, None, a, b) for a, b in stretches(everywhere)]
        for name in names:
            if empty[name].all() and not everywhere.all():
                found.append(self.finding(name, f"{name} was not recorded", masks=False))
                continue
            found += [self._told(batch, name, a, b) for a, b in stretches(empty[name] & ~everywhere)]
        return found

    def _told(self, batch: Batch, name: str | None, a: int, b: int) -> Finding:
        minutes = (b - a + 1) * batch.step_s / 60.0
        who = f"{name} has no values" if name else "no channel has values"
        words = f"{who} {span_words(batch, a, b)} ({minutes:.3g} min)"
        return self.finding(name, words, float(batch.time_s[a]), float(batch.time_s[b]), masks=False)
