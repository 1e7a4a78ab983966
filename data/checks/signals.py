"""A batch's channels as one matrix, and what every check asks of them, worked out once for all checks.

Most channels of most batches are sound, so each check first asks what its fault cannot do without (a large step, a
run of equal samples, a value out of range) and looks closer only where the answer is yes.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.batch import Batch

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

EQUAL = 1e-9  # resampling leaves rounding errors in a repeated value
# exchanges that leave the median in the middle (Devillard 1998, after Paeth 1990): 4 times faster than sorting
_MEDIAN_7 = ((0, 5), (0, 3), (1, 6), (2, 4), (0, 1), (3, 5), (2, 6), (2, 3), (3, 6), (4, 5), (1, 4), (1, 3), (3, 4))
_MEDIAN_9 = (
    (1, 2), (4, 5), (7, 8), (0, 1), (3, 4), (6, 7), (1, 2), (4, 5), (7, 8), (0, 3), (5, 8), (4, 7), (3, 6), (1, 4),
    (2, 5), (4, 7), (4, 2), (6, 4), (4, 2),
)  # fmt: skip
_EXCHANGES = {3: _MEDIAN_7, 4: _MEDIAN_9}


class Signals:
    """Masked values (p, n) of a batch's channels, one row a channel, with their extremes, steps and rests."""

    def __init__(self, batch: Batch) -> None:
        self._row = {n: i for i, n in enumerate(n for n in batch.channels if n in batch.table.columns)}
        self.matrix: Array = np.empty((len(self._row), batch.n_rows))
        for name, i in self._row.items():
            self.matrix[i] = batch.masked(name)
        self._rest: dict[int, Bools] = {}
        self._excess: dict[str, Array] = {}

    def values(self, name: str) -> Array:
        """As recorded, NaN under every mask, shape (n,); the same memory for all, not to be changed."""
        return self.matrix[self._row[name]]

    def whole(self, name: str) -> bool:
        """Every row has a value."""
        return bool(self._whole[self._row[name]])

    def extremes(self, name: str) -> tuple[float, float]:
        """Least and largest finite value, NaN where there is none."""
        i = self._row[name]
        return float(self._extremes[0][i]), float(self._extremes[1][i])

    def largest_step(self, name: str) -> float:
        """Largest difference of a finite value to the finite one before it, also across holes; 0 without any."""
        return float(self._largest_step[self._row[name]])

    def rests(self, name: str, rows: int) -> bool:
        """False if the channel surely never holds one value for `rows` rows."""
        if rows not in self._rest:
            self._rest[rows] = _any_run(self._still, rows - 1)
        return bool(self._rest[rows][self._row[name]])

    def excess(self, name: str) -> Array:
        """`excess` of the channel, shape (n,)."""
        if name not in self._excess:
            self._excess[name] = excess(self.values(name))
        return self._excess[name]

    @cached_property
    def _extremes(self) -> tuple[Array, Array]:
        if not self.matrix.shape[1]:
            nothing = np.full(len(self.matrix), np.nan)
            return nothing, nothing
        low, high = self.matrix.min(axis=1), self.matrix.max(axis=1)
        for i in np.flatnonzero(~(np.isfinite(low) & np.isfinite(high))):
            ok = self.matrix[i][np.isfinite(self.matrix[i])]
            low[i], high[i] = (ok.min(), ok.max()) if len(ok) else (np.nan, np.nan)
        return low, high

    @cached_property
    def _whole(self) -> Bools:
        return np.asarray(np.isfinite(self.matrix).all(axis=1))

    @cached_property
    def _steps(self) -> Array:
        """Absolute differences (p, n - 1)."""
        steps = np.diff(self.matrix, axis=1)
        return np.abs(steps, out=steps)

    @cached_property
    def _largest_step(self) -> Array:
        largest = self._steps.max(axis=1, initial=0.0)
        for i in np.flatnonzero(~self._whole):
            v = self.matrix[i]
            largest[i] = np.abs(np.diff(v[np.isfinite(v)])).max(initial=0.0)
        return largest

    @cached_property
    def _still(self) -> Bools:
        """Rows that may equal the row before (p, n - 1): the bound is that of the channel's largest value."""
        low, high = self._extremes
        size = np.fmax(1.0, np.fmax(np.abs(low), np.abs(high)))
        return self._steps <= EQUAL * size[:, None]


def signals(batch: Batch) -> Signals:
    """The batch's signals under its present masks; made once, kept with the batch."""
    kept = batch.__dict__.get("_signals")
    if not isinstance(kept, Signals):
        kept = batch.__dict__["_signals"] = Signals(batch)
    return kept


def excess(values: Array, half: int = 4) -> Array:
    """Step into each row less the median step of the rows around it, shape (n,); row 0 is 0, NaN beside holes."""
    steps = np.diff(values, prepend=values[:1])
    steps[:1] = 0.0
    return steps - rolling_median(steps, half)


def rolling_median(values: Array, half: int, least: int = 1) -> Array:
    """Median of the finite values in rows ± half, shape (n,); NaN where fewer than `least` are finite."""
    n, size = len(values), 2 * half + 1
    if n < 2 * size or half not in _EXCHANGES or not np.isfinite(values).all():
        return pd.Series(values).rolling(size, center=True, min_periods=least).median().to_numpy()
    rows = [values[k : n - 2 * half + k].copy() for k in range(size)]
    spare = np.empty_like(rows[0])
    for a, b in _EXCHANGES[half]:
        low, high = rows[a], rows[b]
        np.minimum(low, high, out=spare)
        np.maximum(low, high, out=high)
        rows[a], spare = spare, low
    out = np.full(n, np.nan)
    out[half : n - half] = rows[half]
    for k in range(max(0, least - half - 1), half):
        out[k] = np.median(values[: k + half + 1])
        out[n - 1 - k] = np.median(values[n - 1 - k - half :])
    return out


def _any_run(flags: Bools, length: int) -> Bools:
    """Has each row of flags (p, m) `length` True in a row? Shape (p,)."""
    if flags.shape[1] < length:
        return np.zeros(len(flags), bool)
    width = 1
    while width < length:  # a run of a + b is a run of a and one of b, overlapping
        more = min(width, length - width)
        flags = flags[:, : flags.shape[1] - more] & flags[:, more:]
        width += more
    return np.asarray(flags.any(axis=1))
