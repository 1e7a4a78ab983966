"""How large and how correlated the noise of each channel really is, from the residuals of a fit."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.calibration.fit_problem import Array
from twin.calibration.whiteness import correlated_rows


@dataclass(frozen=True)
class Noise:
    """Per channel (c,): `factor` on the given standard deviation, at least 1, and `inflation`, the rows that count as
    one. A row's information is divided by ``factor² inflation``, so a smooth misfit does not pass for thousands of
    independent samples. Misfit that several channels share is not seen: each channel is judged alone.
    """

    factor: Array
    inflation: Array

    @classmethod
    def as_given(cls, channels: int) -> Noise:
        return cls(np.ones(channels), np.ones(channels))

    @property
    def weight(self) -> Array:
        """What a row's squared whitened residual counts, (c,)."""
        return np.asarray(1.0 / (self.factor**2 * self.inflation))

    def change(self, other: Noise) -> float:
        """The largest relative change of a channel's weight against another."""
        return float(np.max(np.abs(self.weight / other.weight - 1.0), initial=0.0))


def estimate(
    residuals: Iterable[Array], channels: Sequence[NDArray[np.int64]], n_channels: int, parameters: float
) -> Noise:
    """The noise of each channel from whitened residuals and their channels, one (n_b,) array of each per batch.

    `parameters` is the effective number that the fit has taken from the rows; it is spread over the channels by rows.
    """
    series: list[list[Array]] = [[] for _ in range(n_channels)]
    for residual, channel in zip(residuals, channels, strict=True):
        for c in np.unique(channel):
            series[c].append(residual[channel == c])
    rows = sum(len(c) for c in channels)
    left = max(1.0 - parameters / max(1, rows), 0.1)  # a fit that uses nearly every row says little about noise
    factor, inflation = np.ones(n_channels), np.ones(n_channels)
    for c, parts in enumerate(series):
        n = sum(map(len, parts))
        if n:
            factor[c] = max(1.0, np.sqrt(sum(float(r @ r) for r in parts) / (n * left)))
            inflation[c] = correlated_rows(parts)
    return Noise(factor, inflation)
