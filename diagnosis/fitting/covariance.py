"""The covariance of the residuals of a calibrated network: noise, structure of refined twins, known imperfections.

``Σ = blocks + D Dᵀ``: a block per batch and channel of white noise, of the specific components of refined twins and of
the times at which drivers change, and directions D (n, K), of sd 1 each, that all batches share: structure is the same
in every run. Directions are unknowns of prior N(0, 1) like parameters, so that effects are judged with all of them
integrated out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from data.arrays import Array
from diagnosis.policy import POLICY
from twin.calibration.problem import CalibrationProblem

Slices = Sequence[tuple[int, slice]]  # every channel's number and rows


def slices_of(channel: NDArray[np.int64]) -> Slices:
    """Every channel's number and rows, of the channels (n,) of rows in their order."""
    starts = np.flatnonzero(np.diff(channel, prepend=-1))
    ends = np.append(starts[1:], len(channel))
    return [(c, slice(a, b)) for c, a, b in zip(channel[starts].tolist(), starts.tolist(), ends.tolist(), strict=True)]


@dataclass(frozen=True, eq=False)
class Structure:
    """What covariances are learned from, in units of the given noise.

    Of every batch `drawn` (n_b, T), draws of refined twins, `timing` (n_b, T), what other times of their drivers'
    changes do, and `known` (n_b, K), imperfections of any machine per sd; `noise` (C,) is each channel's white noise.
    `stated` are the names of the unknowns whose values refined twins have from their priors.
    """

    drawn: Sequence[Array]
    timing: Sequence[Array]
    known: Sequence[Array]
    noise: Array
    stated: frozenset[str]

    @cached_property
    def specific(self) -> list[Array]:
        """The specific component of each draw, (n_b, T) of every batch."""
        return specific_component(self.drawn)

    @property
    def directions(self) -> tuple[Array, ...]:
        """Draws and imperfections (n_b, T + K) of every batch, each of sd 1."""
        n = np.sqrt(self.drawn[0].shape[1])
        return tuple(np.hstack([d / n, k]) for d, k in zip(self.drawn, self.known, strict=True))


@dataclass(frozen=True, eq=False)
class Covariance:
    """`roots` are, by batch and channel, inverse lower Cholesky factors (n, n) of the blocks, whose sd each channel's
    `factor` (C,) multiplies; `directions` (n_b, K) by batch, in units of the given noise; `structure` is what it was
    learned from.
    """

    channels: tuple[NDArray[np.int64], ...]
    roots: tuple[dict[int, Array], ...]
    directions: tuple[Array, ...]
    factor: Array
    drawn: int = 0  # how many of the directions, the first ones, were drawn; the others are imperfections
    structure: Structure | None = None
    share: float = 0.0  # of the variance of specific components
    timing: float = 0.0  # of the variance by times of changes

    @classmethod
    def of(cls, problem: CalibrationProblem, block: Callable[[int, int, slice], Array], **given: Any) -> Covariance:
        """`block` gives the covariance (n, n) of the n rows of a batch and channel, from both numbers and the slice."""
        channels = tuple(m.channel for m in problem.measured)
        roots = tuple({c: _inverse_root(block(b, c, at)) for c, at in slices_of(m)} for b, m in enumerate(channels))
        bare = tuple(np.zeros((len(m), 0)) for m in channels)
        ones = np.ones(len(problem.channels))
        return cls(**{"channels": channels, "roots": roots, "directions": bare, "factor": ones, **given})

    def white(self, batch: int, rows: Array) -> Array:
        """Rows (n_b, …) of a batch, uncorrelated and of unit variance but for the directions."""
        out = np.empty(rows.shape)
        for channel, at in self._slices[batch]:
            out[at] = self.roots[batch][channel] @ rows[at] / self.factor[channel]
        return out

    @property
    def count(self) -> int:
        """How many directions there are."""
        return self.directions[0].shape[1] if self.directions else 0

    @cached_property
    def _slices(self) -> list[Slices]:
        return [slices_of(c) for c in self.channels]

    @cached_property
    def log_det(self) -> Array:
        """Of every batch's blocks (B,)."""
        return np.array([
            -2.0 * sum(float(np.log(np.diag(root) / self.factor[c]).sum()) for c, root in own.items())
            for own in self.roots
        ])  # fmt: skip

    def scaled(self, factor: Array) -> Covariance:
        """The same roots with this factor (C,) in place of its own."""
        return replace(self, factor=factor)


def _inverse_root(block: Array) -> Array:
    root = np.linalg.cholesky(block)
    return np.asarray(solve_triangular(root, np.eye(len(root)), lower=True), float)


def independent(problem: CalibrationProblem, noise: Array) -> Covariance:
    """White noise of sd `noise` (C,) alone."""
    return Covariance.of(problem, lambda b, c, at: noise[c] ** 2 * np.eye(at.stop - at.start))


def learned(problem: CalibrationProblem, structure: Structure, share: float, timing: float) -> Covariance:
    """White noise, `share` of the variance of the draws' specific components and `timing` of that by times of changes,
    which are of one run alone; all directions of sd 1."""
    draws = structure.drawn[0].shape[1]

    def block(b: int, c: int, at: slice) -> Array:
        specific, late = structure.specific[b][at], structure.timing[b][at]
        white = structure.noise[c] ** 2 * np.eye(len(specific))
        return np.asarray(white + (share * specific @ specific.T + timing * late @ late.T) / draws, float)

    return Covariance.of(
        problem, block, directions=structure.directions, drawn=draws, structure=structure, share=share, timing=timing
    )


def white_noise(problem: CalibrationProblem) -> Array:
    """The sd (C,) of each channel's white noise in units of the given one, from second differences.

    A channel whose value repeats from row to row is rounded: it has at least the given noise.
    """
    out = np.ones(len(problem.channels))
    for c in range(len(out)):
        differences = []
        for m in problem.measured:
            at = m.channel == c
            even = np.diff(m.row[at], 2) == 0
            differences.append(np.diff(m.value[at], 2)[even] / (np.sqrt(6.0) * problem.noise[c]))
        second = np.abs(np.concatenate(differences)) if differences else np.zeros(0)
        if len(second) < POLICY.noise_min_rows:
            continue
        kept = np.sort(second)[: int(POLICY.noise_kept_share * len(second))]
        rms = POLICY.noise_kept_factor * float(np.sqrt(np.mean(kept**2)))
        rounded = np.mean(second < 1e-6) > POLICY.rounded_min_share
        sd = max(1.0, rms) if rounded else 1.4826 * float(np.median(second))
        out[c] = np.clip(sd, *POLICY.white_noise_bounds)
    return out


def clipped(drawn: Sequence[Array]) -> list[Array]:
    """Draws (n_b, K), none much larger than the median one."""
    size = np.sqrt(sum(np.einsum("nk,nk->k", d, d) for d in drawn))
    most = POLICY.draw_max_size * float(np.median(size))
    factor = np.minimum(1.0, most / np.maximum(size, 1e-300))
    return [d * factor for d in drawn]


def specific_component(drawn: Sequence[Array]) -> list[Array]:
    """The part of each draw (n_b, K) that no linear combination of the others has (ridge 1)."""
    gram = sum(d.T @ d for d in drawn)
    inverse = np.linalg.inv(np.asarray(gram) + np.eye(len(np.asarray(gram))))
    rest = inverse / np.diag(inverse)
    return [d @ rest for d in drawn]
