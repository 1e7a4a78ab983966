"""What the rows of a channel remember of each other: a part of the misfit decays slowly, the rest is white.

A lumped network leaves a smooth misfit. As independent rows it would pass for thousands of samples; thinned by its
correlation time it would take the sharp traces with it: a shift at a step of the speed, a gate that opens. So the rows
are filtered: ``C = s² [(1 - w) I + w φ^|i-j|]``, white noise and a first-order memory, whose innovations are an
ARMA(1, 1) filter's (Box and Jenkins 1970, §3.4). A slow trace counts as before, a sharp one counts in full.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from twin.calibration.fit_problem import Array

ROWS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # after which the memory has decayed to 1/e
SHARES = (0.1, 0.25, 0.4, 0.6, 0.75, 0.87, 0.94, 0.97, 0.985)
FEWEST = 20  # rows of a channel that say anything about it
QUIET = 0.25  # of the given noise's variance: no channel has less; files state noise on the safe side
WORTH = 4.0  # nats of likelihood below which rows are taken as independent


@dataclass(frozen=True)
class Memory:
    """Per channel (K,): the `share` w of the variance that remembers, and what it `keep`s from row to row, φ."""

    share: Array
    keep: Array

    @classmethod
    def none(cls, channels: int) -> Memory:
        return cls(np.zeros(channels), np.zeros(channels))

    @property
    def inflation(self) -> Array:
        """Rows (K,) that count as one for a trace that does not change: 1 + 2 Σ ρ."""
        return np.asarray(1.0 + 2.0 * self.share * self.keep / (1.0 - self.keep))

    @property
    def white(self) -> Array:
        """The variance (K,) that white noise of variance 1 has when it is filtered."""
        theta, variance = _moving_average(self.share, self.keep)
        return np.asarray((1.0 + (theta - self.keep) ** 2 / (1.0 - theta**2)) / variance)

    def filtered(self, channel: int, rows: Array) -> Array:
        """The innovations of rows (n, …) of one channel, of variance 1 where the rows have it."""
        phi, theta, sd = _filter(float(self.share[channel]), float(self.keep[channel]))
        if phi == 0.0:
            return rows
        out = lfilter([1.0, -phi], [1.0, -theta], rows, axis=0) / sd
        return np.asarray(out - _beginning(rows, theta, sd))

    def restored(self, channel: int, rows: Array) -> Array:
        """The rows whose innovations these are: the inverse of `filtered`."""
        phi, theta, sd = _filter(float(self.share[channel]), float(self.keep[channel]))
        if phi == 0.0:
            return rows
        out = (rows + _beginning(rows, theta, sd)) * sd
        return np.asarray(lfilter([1.0, -theta], [1.0, -phi], out, axis=0))


@lru_cache(maxsize=256)
def _filter(share: float, keep: float) -> tuple[float, float, float]:
    """φ, θ and the innovations' standard deviation of a channel; φ is 0 where its rows are independent."""
    if share == 0.0 or keep == 0.0:
        return 0.0, 0.0, 1.0
    theta, variance = _moving_average(np.asarray(share), np.asarray(keep))
    return keep, float(theta), float(np.sqrt(variance))


def whiter(one: Memory, other: Memory) -> Memory:
    """Per channel the memory of the shorter reach."""
    first = one.inflation <= other.inflation
    return Memory(np.where(first, one.share, other.share), np.where(first, one.keep, other.keep))


def memory_of(residuals: Sequence[Array], channels: Sequence[NDArray[np.int64]], n_channels: int) -> Memory:
    """The likeliest memory of what a fit leaves over.

    Args:
        residuals: (n_b,) of every batch in units of the given noise, in time order within each channel.
        channels: (n_b,) the channel of each row.
    """
    share, keep = np.zeros(n_channels), np.zeros(n_channels)
    for c in range(n_channels):
        series = [r[at == c] for r, at in zip(residuals, channels, strict=True)]
        lengths = np.array([len(s) for s in series])
        if lengths.sum() < FEWEST:
            continue
        rows = np.zeros((lengths.max(), len(series)))
        for k, s in enumerate(series):
            rows[: len(s), k] = s
        there = np.arange(len(rows))[:, None] < lengths
        likely, w, phi = _likeliest(rows, there)
        if likely > _likelihood(rows, there, 0.0, 0.0) + WORTH:
            share[c], keep[c] = w, phi
    return Memory(share, keep)


def _likeliest(rows: Array, there: NDArray[np.bool_]) -> tuple[float, float, float]:
    """The highest log likelihood on the grid of shares and reaches, and where: a coarse look, then uphill."""
    keeps = np.exp(-1.0 / np.array(ROWS)).tolist()
    seen: dict[tuple[int, int], float] = {}

    def at(point: tuple[int, int]) -> float:
        if point not in seen:
            seen[point] = _likelihood(rows, there, SHARES[point[0]], keeps[point[1]])
        return seen[point]

    best = max(product(range(1, len(SHARES), 3), range(1, len(ROWS), 2)), key=at)
    while True:
        i, j = best
        near = product(range(max(i - 1, 0), min(i + 2, len(SHARES))), range(max(j - 1, 0), min(j + 2, len(ROWS))))
        if (up := max(near, key=at)) == best:
            return at(best), SHARES[i], keeps[j]
        best = up


def _likelihood(rows: Array, there: NDArray[np.bool_], w: float, phi: float) -> float:
    """Log likelihood of series of one channel (n, B), ended by rows that are not `there`, the variance at its best."""
    n = int(there.sum())
    square = float(np.sum(Memory(np.array([w]), np.array([phi])).filtered(0, rows)[there] ** 2)) / n
    scale = max(square, QUIET / (1.0 - w))
    return -0.5 * n * (float(np.log(scale)) + 2.0 * float(np.log(_filter(w, phi)[2])) + square / scale)


def _beginning(rows: Array, theta: float, sd: float) -> Array:
    """What the filter gives too much (n, …): the first row has no past, is of full variance, and echoes with θ.

    The same for rows (n, …) and for their innovations, which share the first.
    """
    decay = theta ** np.arange(len(rows), dtype=float)
    return np.asarray(rows[:1] * (1.0 / sd - 1.0) * decay.reshape(-1, *(1,) * (rows.ndim - 1)))


def _moving_average(share: Array, keep: Array) -> tuple[Array, Array]:
    """θ and the innovations' variance of ``y_t = φ y_(t-1) + e_t - θ e_(t-1)`` for an AR(1) share and white noise."""
    a = 1.0 + keep**2 - 2.0 * keep**2 * share
    b = keep * (1.0 - share)
    theta = 2.0 * b / (a + np.sqrt(np.maximum(a**2 - 4.0 * b**2, 0.0)))
    return theta, np.asarray(np.where(theta > 0, b / np.where(theta > 0, theta, 1.0), a))
