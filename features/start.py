"""The zero of a batch: values relative to its start, as `features.rises.zeroed_error_um` zeroes the recorded error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from data.arrays import Array, Index, Mask
from data.sweeps import position_bins, sweep_numbers


@dataclass(frozen=True)
class Start:
    """Reference of each of n rows: (1 − share) · row `left` + share · row `right`, each (n,)."""

    left: Index
    right: Index
    share: Array

    @classmethod
    def of(cls, known: Mask, time_s: Array, position_mm: Array | None = None) -> Self | None:
        """References of one batch's rows (n,): its first known row; along an axis the first sweep at the same position.

        Positions between those of the first sweep are interpolated, beyond them the nearest is taken; a row without a
        position refers to the first row of the sweep. None where no row is known.
        """
        if not known.any():
            return None
        n = len(known)
        read = np.flatnonzero(known & np.isfinite(position_mm)) if position_mm is not None else np.empty(0, np.int64)
        if position_mm is None or not len(read):
            first = np.full(n, int(np.argmax(known)))
            return cls(first, first, np.zeros(n))
        sweep = read[sweep_numbers(time_s[read], position_mm[read]) == 0]
        _, at = np.unique(position_bins(position_mm[read])[: len(sweep)], return_index=True)
        knots = sweep[at]
        known_mm = position_mm[knots]
        place = np.clip(np.searchsorted(known_mm, position_mm, side="right") - 1, 0, max(len(knots) - 2, 0))
        right = np.minimum(place + 1, len(knots) - 1)
        width = np.where(right > place, known_mm[right] - known_mm[place], 1.0)
        share = np.clip((position_mm - known_mm[place]) / width, 0.0, 1.0)
        there = np.isfinite(position_mm)
        return cls(
            np.where(there, knots[place], sweep[0]),
            np.where(there, knots[right], sweep[0]),
            np.where(there & (right > place), share, 0.0),
        )

    def since(self, values: Array) -> Array:
        """Values (n, …) less their references: exactly 0 at the start."""
        share = self.share.reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(values - ((1.0 - share) * values[self.left] + share * values[self.right]))
