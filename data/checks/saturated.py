"""A channel pinned at the end of its instrument's range."""

from __future__ import annotations

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import Check, clock, constant_runs, smallest_step, span_words, step_limit
from data.checks.signals import signals
from data.machine import Machine

_ROWS = 5


class Saturated(Check):
    """Five or more equal samples at the batch's extreme, at a full-scale value, reached by a jump.

    Full scale is 1, 2, 2.5 or 5 times a power of ten, or an end of the machine file's range. The jump
    keeps a quiet channel that happens to sit at a round value out of it.
    """

    key = "saturated"
    words = "pinned at a full-scale value"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        found = []
        seen = signals(batch)
        for name in batch.names("error", "temperature", "ambient"):
            if not seen.rests(name, _ROWS):
                continue
            channel, v = batch.channels[name], seen.values(name)
            ends = seen.extremes(name)
            rails = [_rail(e, smallest_step(batch, name), channel.low, channel.high, slack=1e-5) for e in ends]
            if all(r is None or (channel.role != "error" and abs(r) < 100.0) for r in rails):
                continue
            for a, b in constant_runs(v, _ROWS):
                if min(abs(v[a] - e) for e in ends) > 1e-6:
                    continue
                rail = _rail(float(v[a]), smallest_step(batch, name), channel.low, channel.high)
                if rail is None or (channel.role != "error" and abs(rail) < 100.0):
                    continue
                arrived = _jump(v, a)
                if arrived <= 0.05 * abs(rail):
                    continue
                if arrived > step_limit(seen.excess(name), channel.resolution):
                    found.append(
                        self.finding(
                            name,
                            f"{name} jumps by {arrived:.1f} {channel.unit} at {clock(batch.time_s[a])} to its "
                            f"full scale {rail:g} {channel.unit} and stays there {span_words(batch, a, b)}",
                            float(batch.time_s[a]),
                            float(batch.time_s[b]),
                        )
                    )
        return found


def _jump(v: np.ndarray, row: int) -> float:
    """Step up to the run from the last good rows before it; a resampled row may stand half-way."""
    before = v[max(0, row - 3) : row]
    before = before[np.isfinite(before)]
    return float(np.max(np.abs(v[row] - before))) if len(before) else 0.0


def _rail(value: float, resolution: float, low: float | None, high: float | None, slack: float = 0.0) -> float | None:
    size = abs(value)
    if size < 5.0 - slack:
        return None
    near = max(resolution, 1e-4 * size) + slack
    decade = 10.0 ** np.floor(np.log10(size * 1.0001))
    rails = [np.sign(value) * decade * k for k in (1.0, 2.0, 2.5, 5.0, 10.0)]
    for rail in [*rails, low, high]:
        if rail is not None and abs(value - rail) <= near:
            return float(rail)
    return None
