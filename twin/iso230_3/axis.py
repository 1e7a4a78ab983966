"""A linear axis that cycles between two targets: the stays there, and error, shift and span from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch

Array = NDArray[np.float64]

_NEAR, _ON_TARGET, _LEAST_SHARE, _LEAST_STAYS = 0.1, 0.02, 0.3, 2  # of the stroke; of the readings


@dataclass(frozen=True)
class Cycle:
    """Where the axis stood: `stay` (rows,) numbers the stays, -1 on the way; `at_high` (stays,) tells which end."""

    channel: str
    low_mm: float
    high_mm: float
    stay: NDArray[np.int64]
    at_high: NDArray[np.bool_]
    rows: NDArray[np.bool_]

    @property
    def n(self) -> int:
        """How many stays at the farther target."""
        return int(self.at_high.sum())


def find_cycle(batch: Batch, channel: str, rows: NDArray[np.bool_]) -> Cycle | None:
    """The cycle of a position channel over the given rows of the batch; None where it does not go to and fro.

    A reading is at a target within 2 % of the stroke. At least two stays at either target and 30 % of the readings
    there make a cycle.
    """
    position = batch.values(channel)[rows]
    finite = position[np.isfinite(position)]
    if len(finite) < 4:
        return None
    least, stroke = float(finite.min()), float(np.ptp(finite))
    if stroke <= 2 * (batch.channels[channel].resolution or 0.0) or stroke <= 1e-3:
        return None
    low = float(np.median(finite[finite <= least + _NEAR * stroke]))
    high = float(np.median(finite[finite >= least + (1 - _NEAR) * stroke]))
    side = np.zeros(len(position), int)
    side[np.abs(position - low) <= _ON_TARGET * stroke] = -1
    side[np.abs(position - high) <= _ON_TARGET * stroke] = 1
    there = np.flatnonzero(side)
    if len(there) < _LEAST_SHARE * len(position):
        return None
    new = np.r_[True, np.diff(side[there]) != 0]
    stay = np.full(len(position), -1)
    stay[there] = np.cumsum(new) - 1
    at_high = side[there][new] > 0
    if min(at_high.sum(), (~at_high).sum()) < _LEAST_STAYS:
        return None
    return Cycle(channel, low, high, stay, at_high, rows)


def stays(cycle: Cycle, time_s: Array, values: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """(times, means) of the readings of every stay at the lower target, then at the farther one; empty stays left out.

    `time_s` and `values` (batch rows,).
    """
    t, v = time_s[cycle.rows], values[cycle.rows]
    good = (cycle.stay >= 0) & np.isfinite(v)
    n = len(cycle.at_high)
    count = np.bincount(cycle.stay[good], minlength=n)
    with np.errstate(invalid="ignore"):
        when = np.bincount(cycle.stay[good], t[good], n) / count
        mean = np.bincount(cycle.stay[good], v[good], n) / count
    low, high = (count > 0) & ~cycle.at_high, (count > 0) & cycle.at_high
    return (when[low], mean[low]), (when[high], mean[high])


def span(low: tuple[Array, Array], high: tuple[Array, Array]) -> tuple[Array, Array]:
    """(times, error at the farther target minus that at the lower one), the latter taken linearly between its stays."""
    (low_s, at_low), (high_s, at_high) = low, high
    if not len(low_s) or not len(high_s):
        return np.empty(0), np.empty(0)
    inside = (high_s >= low_s[0]) & (high_s <= low_s[-1])
    return high_s[inside], at_high[inside] - np.interp(high_s[inside], low_s, at_low)
