"""The rows of all batches as one vector: where each batch and each channel stands in it, and linearisations of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from twin.calibration.least_squares import x_of
from twin.calibration.problem import CalibrationProblem


@dataclass(frozen=True)
class Rows:
    """n rows: batch after batch, within each channel after channel in time order.

    Attributes:
        channel: (n,) number of each row's channel, of `channels`.
        edges: (B + 1,) where every batch begins and the last ends.
    """

    channel: NDArray[np.int64]
    edges: NDArray[np.int64]
    channels: int

    @classmethod
    def of(cls, problem: CalibrationProblem) -> Rows:
        counts = [len(m.row) for m in problem.measured]
        every = np.concatenate([m.channel for m in problem.measured])
        return cls(every, np.concatenate([[0], np.cumsum(counts)]), len(problem.channels))

    @property
    def n(self) -> int:
        return len(self.channel)

    @cached_property
    def of_channel(self) -> list[NDArray[np.int64]]:
        """Numbers of each channel's rows."""
        return [np.flatnonzero(self.channel == c) for c in range(self.channels)]

    def batch(self, k: int) -> slice:
        return slice(int(self.edges[k]), int(self.edges[k + 1]))

    @property
    def batches(self) -> int:
        return len(self.edges) - 1

    def split(self, values: Array) -> list[Array]:
        """Of values (n, …) each batch's own."""
        return [values[self.batch(k)] for k in range(self.batches)]


@dataclass(frozen=True)
class Linear:
    """All rows about a point: ``residual = J (z' - z) + N (v' - v) + noise`` in units of the given noise.

    z (p,) are the shared unknowns less their prior means, in prior standard deviations; `own` (q,) those of all batches
    one after the other, of prior N(0, 1), whose columns are `nuisance` (n, q); `starts` (B + 1,) says where each
    batch's begin.
    """

    rows: Rows
    z: Array
    own: Array
    residual: Array
    jacobian: Array
    nuisance: Array
    starts: NDArray[np.int64]

    @classmethod
    def at(cls, problem: CalibrationProblem, z: Array, nuisance: Sequence[Array]) -> Linear:
        """Linearised at z (p,) and the batches' own unknowns.

        Raises:
            WorkError: the network cannot be simulated there.
        """
        rows = Rows.of(problem)
        blocks = list(problem.linearise(x_of(problem.unknowns, z), nuisance))
        spread = np.array([u.spread for u in problem.unknowns])
        starts = np.concatenate([[0], np.cumsum([b.nuisance.shape[1] for b in blocks])])
        own = np.zeros((rows.n, int(starts[-1])))
        for k, block in enumerate(blocks):
            own[rows.batch(k), starts[k] : starts[k + 1]] = block.nuisance
        return cls(
            rows,
            z,
            np.concatenate(nuisance) if len(nuisance) else np.zeros(0),
            np.concatenate([b.residual for b in blocks]),
            np.concatenate([b.jacobian for b in blocks]) * spread,
            own,
            starts,
        )

    @cached_property
    def target(self) -> Array:
        """The rows (n,) that the unknowns, counted from their prior means, have to explain."""
        return np.asarray(self.residual + self.jacobian @ self.z + self.nuisance @ self.own)

    def of_batches(self, own: Array) -> list[Array]:
        """Of all batches' own unknowns (q,) each batch's."""
        return [own[a:b] for a, b in zip(self.starts[:-1], self.starts[1:], strict=True)]
