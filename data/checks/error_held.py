"""Error channels that hold their last value while the spindle stands: not measured, only repeated."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check, constant_runs, in_time, smallest_step, span_words, standing
from data.checks.signals import EQUAL, signals
from data.machine import Machine

_ROWS = 5
_SECONDS = 600.0
_CHANCE = 1e-6
_MOVED_K = 1.0


class ErrorHeld(Check):
    """Every error channel repeats one value, all together, while temperatures move on.

    With p the share of rows where any error channel changes outside the stretch, n equal rows have the chance
    (1 − p)^n; below 1e-6, with 1 K or more of temperature change meanwhile, nothing was measured.
    """

    key = "error_held"
    words = "error channels held while the spindle stands"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        seen = signals(batch)
        names = [n for n in in_time(batch, "error") if np.isfinite(seen.values(n)).sum() > _ROWS]
        if not names or batch.n_rows < 2 * _ROWS:
            return []
        least = max(_ROWS, int(_SECONDS / batch.step_s))
        if any(seen.whole(n) and not seen.rests(n, least) for n in names):
            return []
        together = np.zeros(batch.n_rows, bool)
        together[0] = True
        for name in names:
            v = seen.values(name)
            # a channel already masked here has no say
            change = np.abs(np.diff(v))
            together[1:] |= np.isfinite(change) & ~(change <= EQUAL * np.maximum(1.0, np.abs(v[1:])))
        code = np.cumsum(together).astype(float)
        code[~np.any([np.isfinite(seen.values(name)) for name in names], axis=0)] = np.nan
        runs = constant_runs(code, _ROWS)
        still = standing(batch)
        held = [(a, b) for a, b in runs if self._is_held(batch, names, code, a, b, runs, still)]
        found = []
        for a, b in held:
            state = "while the spindle stands" if still[a + 1 : b].mean() > 0.5 else "though the spindle is said to run"
            for name in names:
                there = np.flatnonzero(np.isfinite(seen.values(name)[a : b + 1]))
                if len(there) < 2:
                    continue
                last = a + int(there[-1])
                moved = _temperature_change(batch, a, last)
                words = (
                    f"{name} repeats {batch.values(name)[a]:.1f} {batch.channels[name].unit} "
                    f"{span_words(batch, a, last)} {state}, while temperatures change by up to {moved:.1f} K"
                )
                found.append(self.finding(name, words, float(batch.time_s[a + 1]), float(batch.time_s[last])))
        return found

    def _is_held(
        self,
        batch: Batch,
        names: list[str],
        code: Array,
        a: int,
        b: int,
        runs: list[tuple[int, int]],
        still: np.ndarray,
    ) -> bool:
        n = b - a
        if n * batch.step_s < _SECONDS:
            return False
        outside = np.ones(batch.n_rows - 1, bool)
        for c, d in runs:
            if d - c >= n / 2:
                outside[c:d] = False
        changing = float(np.nanmean(np.diff(code)[outside] > 0)) if outside.sum() > 20 else 0.5
        if n * np.log(max(1.0 - changing, 1e-3)) > np.log(_CHANCE):
            return False
        coarse = max(smallest_step(batch, name) for name in names)
        if _temperature_change(batch, a, b) < max(_MOVED_K, coarse):
            return False
        if still[a + 1 : b].mean() > 0.5:
            return True
        others = [d - c for c, d in runs if d - c < n / 2]
        return len(names) > 1 and n > 3 * max(others, default=_ROWS)


def _temperature_change(batch: Batch, a: int, b: int) -> float:
    """Largest net change of a temperature over rows a..b, K."""
    changes = [0.0]
    for name in batch.names(*THERMAL):
        v = batch.masked(name)[a : b + 1]
        v = v[np.isfinite(v)]
        if len(v) > 1 and batch.channels[name].role == "temperature":
            changes.append(abs(float(v[-1] - v[0])))
    return max(changes)
