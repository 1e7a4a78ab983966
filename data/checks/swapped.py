"""Two sensors whose plugs changed places in some batches."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from data.batch import Batch, Finding
from data.checks.base import THERMAL, Array, Check, smallest_step
from data.machine import Machine

_BATCHES = 5
_AT = (0.1, 0.25, 0.5, 1.0)  # of the batch's length
_MISFIT = 4.0
_FIT = 2.5


class Swapped(Check):
    """Each sensor has a fingerprint: start level and rises at four times, against the median of all sensors.

    Two sensors are swapped in a batch where neither fits its own fingerprint of the other batches (4 robust
    sigma rms) and each fits the other's (2.5 sigma).
    """

    key = "swapped"
    words = "two sensors have changed places"

    def across(self, batches: Sequence[Batch], machine: Machine) -> dict[int, list[Finding]]:
        names = list(batches[0].names(*THERMAL)) if batches else []
        if len(batches) < _BATCHES or len(names) < 3:
            return {}
        prints = np.array([_fingerprints(b, names) for b in batches])  # (K, p, f)
        found: dict[int, list[Finding]] = {}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a channel that no batch has is all NaN
            centre = np.nanmedian(prints, axis=0)
            spread = 1.4826 * np.nanmedian(np.abs(prints - centre), axis=0)
        floor = np.array([0.3] + [0.04] * len(_AT))
        spread = np.maximum(spread, floor)
        for k in range(len(batches)):
            # fit[i, j]: how badly channel i looks like channel j
            z = (prints[k][:, None, :] - centre[None]) / spread[None]
            fit = np.sqrt(np.mean(np.minimum(np.abs(z), 30.0) ** 2, axis=2))
            bad = [i for i in range(len(names)) if np.isfinite(fit[i, i]) and fit[i, i] > _MISFIT]
            for a, i in enumerate(bad):
                for j in bad[a + 1 :]:
                    if fit[i, j] < _FIT and fit[j, i] < _FIT:
                        for this, other in ((i, j), (j, i)):
                            words = (
                                f"{names[this]} behaves as {names[other]} does in the other batches and the other way "
                                "round: their plugs or columns have changed places"
                            )
                            found.setdefault(k, []).append(self.finding(names[this], words))
        return found


def _fingerprints(batch: Batch, names: list[str]) -> Array:
    """Start level, K, and rises at the stated times as shares of the batch's typical largest rise: (p, 1 + times)."""
    out = np.full((len(names), 1 + len(_AT)), np.nan)
    rises = np.full((len(names), len(_AT)), np.nan)
    for i, name in enumerate(names):
        if name not in batch.channels:
            continue
        v = batch.masked(name)
        if not np.isfinite(v).all() or len(v) < 20 or smallest_step(batch, name) > 0.5:
            continue
        out[i, 0] = np.median(v[:3])
        for j, share in enumerate(_AT):
            row = int(share * (len(v) - 1))
            rises[i, j] = np.median(v[max(0, row - 1) : row + 2]) - out[i, 0]
    ok = np.isfinite(out[:, 0])
    if not ok.any():
        return out
    out[:, 0] -= np.median(out[ok, 0])
    typical = float(np.median(np.abs(rises[ok]).max(axis=1)))
    out[:, 1:] = rises / typical if typical > 0.5 else np.nan
    return out
