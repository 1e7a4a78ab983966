"""Temperatures that move alike: which sensors one body can stand for, and what that body does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import squareform

from twin.diagnosis.drafting.rows import Rows

Array = NDArray[np.float64]

SMALL = 0.1  # of the median channel's rise: what is smaller is not told apart by shape
AT_START = 3  # batches from which on first readings tell a sensor's offset


@dataclass(frozen=True)
class Rises:
    """Temperatures of S sensors over the rows of all parts, one below the other: `degC` (n, S), holes filled.

    `part` (n,) numbers the parts; `rise_K` is counted from each part's first reading. NaN: a sensor without a value
    in that part. `offset_K` (S,) is by how much a sensor starts above the mean of all, the same in every part.
    """

    names: tuple[str, ...]
    part: NDArray[np.int64]
    time_s: Array
    degC: Array
    noise_K: Array

    @classmethod
    def of(cls, rows: Rows) -> Rises:
        columns = [np.column_stack([_filled(b.values(n)) for n in rows.temperatures]) for b in rows.batches]
        return cls(
            rows.temperatures,
            np.repeat(np.arange(len(columns)), [len(c) for c in columns]),
            np.concatenate([b.time_s for b in rows.batches]),
            np.concatenate(columns),
            np.array([rows.noise[n] for n in rows.temperatures]),
        )

    @cached_property
    def parts(self) -> list[NDArray[np.int64]]:
        return [np.flatnonzero(self.part == b) for b in range(int(self.part[-1]) + 1)]

    @cached_property
    def first_degC(self) -> Array:
        """First readings (B, S)."""
        return np.array([self.degC[at[0]] for at in self.parts])

    @cached_property
    def rise_K(self) -> Array:
        """(n, S)."""
        return self.degC - self.first_degC[self.part]

    @cached_property
    def size_K(self) -> Array:
        """Rms of each sensor's rise, (S,)."""
        return np.sqrt(np.nanmean(self.rise_K**2, axis=0))

    @cached_property
    def distance(self) -> Array:
        """How far two sensors are from reading one body, (S, S): rms difference of their rises over their size."""
        small = SMALL * float(np.median(self.size_K))
        scale = np.sqrt(np.outer(self.size_K, self.size_K) + small**2 + np.outer(self.noise_K, self.noise_K))
        apart = np.sqrt(_mean((self.rise_K[:, :, None] - self.rise_K[:, None, :]) ** 2)) / scale
        never_together = 2.0 * float(np.nanmax(apart, initial=1.0))
        return np.where(np.isfinite(apart), apart, never_together)

    def clusters(self, count: int) -> list[list[int]]:
        """At most `count` groups of sensors, each a part of one group of the next smaller count; by sensors' order."""
        if len(self.names) == 1:
            return [[0]]
        tree = linkage(squareform(self.distance, checks=False), "average")
        label = fcluster(tree, count, "maxclust")
        groups = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
        return sorted(groups)

    def centre(self, group: Sequence[int]) -> int:
        """The sensor that is nearest to all others of its group and gives the body its name."""
        return int(group[int(np.argmin(self.distance[np.ix_(group, group)].sum(axis=1)))])

    def offsets_K(self, group: Sequence[int]) -> Array:
        """By how much each sensor of a group starts above the group's mean, median over parts; 0 of too few."""
        first = self.first_degC[:, group]
        apart = first - _mean(first, axis=1)[:, None]
        if len(first) < AT_START:
            return np.zeros(len(group))
        return np.nan_to_num(_median(apart))

    def body_degC(self, group: Sequence[int]) -> Array:
        """The group's mean temperature (n,), sensors without a value left out; NaN where none has one."""
        return _mean(self.degC[:, group] - self.offsets_K(group), axis=1)


def tree_of(distance: Array) -> list[tuple[int, int]]:
    """The pairs of a minimum spanning tree over K groups at distances (K, K)."""
    tree = minimum_spanning_tree(distance + 1e-9 * (1 - np.eye(len(distance)))).tocoo()
    return sorted((int(min(i, j)), int(max(i, j))) for i, j in zip(tree.row, tree.col, strict=True))


def between(distance: Array, groups: Sequence[Sequence[int]]) -> Array:
    """Mean distance of the sensors of two groups, (K, K), 0 on the diagonal."""
    out = np.array([[distance[np.ix_(a, b)].mean() for b in groups] for a in groups])
    np.fill_diagonal(out, 0.0)
    return out


def _filled(values: Array) -> Array:
    """Holes interpolated, ends held; all NaN stays."""
    good = np.isfinite(values)
    return np.interp(np.arange(len(values)), np.flatnonzero(good), values[good]) if good.any() else values


def _mean(values: Array, axis: int = 0) -> Array:
    """Mean of what is finite, NaN where nothing is, without a warning."""
    good = np.isfinite(values)
    count = good.sum(axis=axis)
    total = np.where(good, values, 0.0).sum(axis=axis)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _median(values: Array) -> Array:
    """Median along the first axis of what is finite; NaN where nothing is."""
    return np.array([np.median(v[np.isfinite(v)]) if np.isfinite(v).any() else np.nan for v in values.T])
