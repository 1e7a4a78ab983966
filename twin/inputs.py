"""What drives a simulation: driver channels that hold, surroundings that move linearly, on one time grid per batch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Inputs:
    """B batches side by side, M intervals of the longest; shorter ones are padded by holding their last values.

    time_s (B, M + 1) borders from each batch's start; n_intervals (B,) the valid ones; drivers by channel (B, M), held
    in each interval; recorded surroundings by channel (B, M + 1) at the borders, linear between; clock_h (B,) time of
    day at the start, nan if unknown; first: by channel the first readings (B,), nan where there is none; every: how
    many intervals lie between two rows of the recording, so that borders ``::every`` are its rows.
    """

    batch_ids: tuple[str, ...]
    time_s: Array
    n_intervals: NDArray[np.int64]
    drivers: Mapping[str, Array]
    recorded: Mapping[str, Array]
    clock_h: Array
    first: Mapping[str, Array]
    every: int = 1

    @property
    def dt_s(self) -> Array:
        """Interval lengths (B, M)."""
        return np.diff(self.time_s, axis=1)
