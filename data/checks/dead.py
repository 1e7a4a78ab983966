"""A temperature that takes no part: constant through a batch in which the others move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check, smallest_step
from data.checks.signals import signals
from data.machine import Machine

_STEPS = 30.0
_FLOOR_K = 3.0
_BATCHES = 5
_NEIGHBOURS = 3
_STEADY = 4.0


class Dead(Check):
    """Alone: wholly constant while the median of the others moves by 3 K and 30 of its resolution steps.

    Against its own history: it moves by less than a tenth of what the three others with the steadiest ratio to it
    let expect, where that ratio is steady (four times its scatter below 1).
    """

    key = "dead"
    words = "takes no part in the machine's warming"

    def batch(self, batch: Batch, machine: Machine) -> list[Finding]:
        moved = {n: self._moved_K(batch, n) for n in batch.names(*THERMAL)}
        found = []
        for name in batch.names("temperature"):
            others = [v for n, v in moved.items() if n != name and np.isfinite(v)]
            if not moved[name] <= 1e-9 or len(others) < 2 or np.isfinite(batch.masked(name)).sum() < 10:
                continue
            usual = float(np.median(others))
            if usual >= max(_FLOOR_K, _STEPS * smallest_step(batch, name)):
                level = batch.values(name)[np.isfinite(batch.values(name))][0]
                words = f"{name} stays at {level:.5g} degC all through while the others move by {usual:.1f} K"
                found.append(self.finding(name, words))
        return found

    @staticmethod
    def _moved_K(batch: Batch, name: str) -> float:
        seen = signals(batch)
        if not seen.whole(name) or batch.n_rows < 10:
            return _range_K(seen.values(name))
        low, high = seen.extremes(name)
        return high - low

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        names = batches[0].names(*THERMAL) if batches else ()
        if len(batches) < _BATCHES or len(names) < 3:
            return {}
        moved = np.array([[_range_K(b.masked(n)) if n in b.channels else np.nan for n in names] for b in batches])
        found: dict[int, list[Finding]] = {}
        for j, name in enumerate(names):
            rest = np.delete(moved, j, axis=1)
            ratio = moved[:, [j]] / np.where(rest > 0, rest, np.nan)
            enough = np.isfinite(ratio).sum(axis=0) >= _BATCHES
            if not enough.any():
                continue
            ratio, rest = ratio[:, enough], rest[:, enough]
            usual = np.nanmedian(ratio, axis=0)
            scatter = 1.4826 * np.nanmedian(np.abs(ratio / np.maximum(usual, 1e-9) - 1.0), axis=0)
            near = np.argsort(scatter, kind="stable")[:_NEIGHBOURS]
            if _STEADY * float(np.median(scatter[near])) > 1.0:
                continue
            expected = _median_of_rows(usual[near] * rest[:, near])
            least = max(_FLOOR_K, _STEPS * smallest_step(batches[0], name))
            for k, batch in enumerate(batches):
                if any(f.check == self.key and f.channel == name for f in batch.findings):
                    continue
                if expected[k] > least and moved[k, j] < 0.1 * expected[k]:
                    words = (
                        f"{name} moves by {moved[k, j]:.1f} K where its neighbours let expect {expected[k]:.1f} K from "
                        "the other batches"
                    )
                    found.setdefault(k, []).append(self.finding(name, words))
        return found


def _median_of_rows(values: Array) -> Array:
    return np.array([np.median(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in values])


def _range_K(values: Array) -> float:
    ok = values[np.isfinite(values)]
    return float(np.ptp(ok)) if len(ok) >= 10 else float("nan")
