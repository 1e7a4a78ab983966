"""A sensor whose start level stands far off its neighbours in some batches and not in the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Check
from data.machine import Machine

_BATCHES = 5
_NEIGHBOURS = 3
_FLOOR_K = 3.0  # thermocouples of class 2 agree within ±2.5 K; more is a fault, less leaves the rises right
_SIGMAS = 8.0


class Offset(Check):
    """At the start a machine is nearly in equilibrium, so differences between neighbouring sensors repeat.

    For each sensor the three others with the steadiest start difference are its neighbours; a batch stands
    out when the median difference to them is off its median over the batches by 3 K and 8 robust sigma.
    """

    key = "offset"
    words = "start level far off the neighbours, unlike in other batches"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        names = batches[0].names(*THERMAL) if batches else ()
        if len(batches) < _BATCHES or len(names) < 2:
            return {}
        start = np.array([[_start(b, n) for n in names] for b in batches])
        found: dict[int, list[Finding]] = {}
        for j, name in enumerate(names):
            difference = start[:, [j]] - np.delete(start, j, axis=1)
            enough = np.isfinite(difference).sum(axis=0) >= _BATCHES
            if not enough.any():
                continue
            difference = difference[:, enough]
            centred = difference - np.nanmedian(difference, axis=0)
            spread = 1.4826 * np.nanmedian(np.abs(centred), axis=0)
            near = np.argsort(spread, kind="stable")[:_NEIGHBOURS]
            limit = max(_FLOOR_K, _SIGMAS * float(np.median(spread[near])))
            off = np.array([np.median(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in centred[:, near]])
            for k in np.flatnonzero(np.abs(np.nan_to_num(off)) > limit):
                words = (
                    f"{name} starts {off[k]:+.1f} K off where it stands beside its neighbours in the other batches "
                    f"(they repeat within {float(np.median(spread[near])):.2f} K)"
                )
                found.setdefault(int(k), []).append(self.finding(name, words))
        return found


def _start(batch: Batch, name: str) -> float:
    if name not in batch.channels:
        return float("nan")
    rows = max(3, int(600.0 / batch.step_s)) if batch.step_s else 3
    v = batch.masked(name)[:rows]
    v = v[np.isfinite(v)]
    return float(np.median(v[:3])) if len(v) else float("nan")
