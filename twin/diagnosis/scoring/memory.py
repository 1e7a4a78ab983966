"""What the rows of a channel remember of each other: a part of the misfit decays slowly, the rest is white.

A lumped network leaves a smooth misfit. As independent rows it would pass for thousands of samples; thinned by its
correlation time it would take the sharp traces with it: a shift at a step of the speed, a gate that opens. So the rows
are filtered: ``C = s² [(1 - w) I + w φ^|i-j|]``, white noise and a first-order memory, whose innovations are an
ARMA(1, 1) filter's (Box and Jenkins 1970, §3.4). A slow trace counts as before, a sharp one counts in full.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
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
SHORT = 110  # rows up to which a filter's matrix is quicker than its recursion; at 73 rows of 150 columns twice

Slices = Sequence[tuple[int, slice]]  # every channel's number and rows


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

    def filtered(self, slices: Slices, rows: Array) -> Array:
        """The innovations of rows (n,) or (n, p), of variance 1 where the rows have it: what is left of each less what
        those before it in its channel foretell."""
        out = np.empty(rows.shape)
        for channel, at in slices:
            phi, theta, sd = self._filter[channel]
            if phi == 0.0:
                out[at] = rows[at]
            elif (n := at.stop - at.start) <= SHORT:
                np.matmul(_matrix(phi, theta, sd)[:n, :n], rows[at], out=out[at])
            else:
                out[at] = _innovations(phi, theta, sd, rows[at])
        return out

    def restored(self, slices: Slices, rows: Array) -> Array:
        """The rows whose innovations these are: the inverse of `filtered`."""
        out = np.array(rows, float)
        for channel, at in slices:
            phi, theta, sd = self._filter[channel]
            if phi != 0.0:
                out[at] = _passed([sd, -theta * sd], [1.0, -phi], rows[at])
        return out

    @cached_property
    def _filter(self) -> list[tuple[float, float, float]]:
        """φ, θ and the innovations' standard deviation of each channel; φ is 0 where its rows are independent."""
        theta, variance = _moving_average(self.share, self.keep)
        phi = np.where(self.share > 0.0, self.keep, 0.0)
        return list(zip(phi.tolist(), theta.tolist(), np.sqrt(variance).tolist(), strict=True))


def slices_of(channel: NDArray[np.int64]) -> Slices:
    """Every channel's number and rows, of the channels (n,) of rows in their order."""
    starts = np.flatnonzero(np.diff(channel, prepend=-1))
    ends = np.append(starts[1:], len(channel))
    return [(c, slice(a, b)) for c, a, b in zip(channel[starts].tolist(), starts.tolist(), ends.tolist(), strict=True)]


def whiter(one: Memory, other: Memory) -> Memory:
    """Per channel the memory of the shorter reach."""
    first = one.inflation <= other.inflation
    return Memory(np.where(first, one.share, other.share), np.where(first, one.keep, other.keep))


def memory_of(residuals: Sequence[Array], channels: Sequence[NDArray[np.int64]], n_channels: int) -> Memory:
    """The likeliest memory of what a fit leaves over, of all shares and reaches on the grid.

    Args:
        residuals: (n_b,) of every batch in units of the given noise, in time order within each channel.
        channels: (n_b,) the channel of each row.
    """
    lengths = np.array([np.bincount(at, minlength=n_channels) for at in channels]).T
    rows = np.zeros((lengths.max(initial=0), n_channels, len(lengths.T)))
    there = np.arange(len(rows))[:, None, None] < lengths
    for b, (left, at) in enumerate(zip(residuals, channels, strict=True)):
        rows[:, :, b].T[there[:, :, b].T] = left[np.argsort(at, kind="stable")]
    w, rows_to_1_e = np.array([(0.0, 1.0), *product(SHARES, ROWS)]).T
    keep = np.where(w > 0.0, np.exp(-1.0 / rows_to_1_e), 0.0)
    likely = _likelihoods(rows, there, w, keep)
    best = 1 + np.argmax(likely[1:], axis=0)
    found = (lengths.sum(axis=1) >= FEWEST) & (likely[best, np.arange(n_channels)] > likely[0] + WORTH)
    return Memory(np.where(found, w[best], 0.0), np.where(found, keep[best], 0.0))


def _likelihoods(rows: Array, there: NDArray[np.bool_], w: Array, keep: Array) -> Array:
    """Log likelihood (G, K) of series (n, K, B) with each of G memories, the variance at its best.

    Each series ends with the last row that is `there`.
    """
    theta, variance = _moving_average(w, keep)
    squares, n = np.zeros((len(w), rows.shape[1])), there.sum(axis=(0, 2))
    now = np.zeros((len(w), *rows.shape[1:]))
    phi, back, sd = (v[:, None, None] for v in (keep, theta, np.sqrt(variance)))
    for t, (row, known) in enumerate(zip(rows, there, strict=True)):
        if t == 0:
            now += row
        else:
            now *= back
            now += (row - phi * rows[t - 1]) / sd
        squares += np.einsum("gkb,gkb,kb->gk", now, now, known)
    mean = squares / np.maximum(n, 1)
    scale = np.maximum(mean, (QUIET / (1.0 - w))[:, None])
    return np.asarray(-0.5 * n * (np.log(scale) + np.log(variance)[:, None] + mean / scale))


@lru_cache(maxsize=len(SHARES) * len(ROWS))  # of every memory that `memory_of` may find
def _matrix(phi: float, theta: float, sd: float) -> Array:
    """The filter of SHORT rows; what it does to the first n of them is its corner of n rows."""
    return _innovations(phi, theta, sd, np.eye(SHORT))


def _innovations(phi: float, theta: float, sd: float, rows: Array) -> Array:
    return _passed([1.0 / sd, -phi / sd], [1.0, -theta], rows)


def _passed(ahead: list[float], back: list[float], rows: Array) -> Array:
    """Rows (n, …) through a filter that passes the first, which has no past and is of full variance, as it is."""
    return np.asarray(lfilter(ahead, back, rows, axis=0, zi=rows[:1] * (1.0 - ahead[0]))[0])


def _moving_average(share: Array, keep: Array) -> tuple[Array, Array]:
    """θ and the innovations' variance of ``y_t = φ y_(t-1) + e_t - θ e_(t-1)`` for an AR(1) share and white noise."""
    a = 1.0 + keep**2 - 2.0 * keep**2 * share
    b = keep * (1.0 - share)
    theta = 2.0 * b / (a + np.sqrt(np.maximum(a**2 - 4.0 * b**2, 0.0)))
    return theta, np.asarray(np.where(theta > 0, b / np.where(theta > 0, theta, 1.0), a))
