"""Selector: medoids of the inputs by the distance 1 − |correlation|."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design
from features.selectors.base import Diagnostic, Selector
from features.selectors.statistics import DIGITS, Statistics, check_n_tsps, chosen_of_varying, training_statistics

Columns = NDArray[np.int64]
_STRUCTURE = 0.25  # a mean silhouette below this shows no structure (Kaufman and Rousseeuw)


class KMedoids(Selector):
    """Partition around medoids: n inputs of least total distance 1 − |corr| from every input to its nearest one.

    Exact up to `most_inputs` inputs, where all sets are tried; beyond, PAM: build greedily, then swap while any swap of
    a medoid against another input helps. Independent of the error except for sets of equal total distance (of a cluster
    of two either may be the medoid): there the larger sum of |corr| with the error decides, then the order of the
    inputs.

    Source: L. Kaufman and P. Rousseeuw (1990), Finding Groups in Data, ch. 2.
    """

    key = "kmedoids"
    summary = "the inputs nearest to all others by 1 − |correlation|"
    source = "L. Kaufman and P. Rousseeuw (1990), Finding Groups in Data, ch. 2"

    def __init__(self, most_inputs: int = 14) -> None:
        self.most_inputs = int(most_inputs)

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        varying, distance, relevance = _distances(training_statistics(design, train, self.key))
        if len(varying) <= self.most_inputs:
            best = medoids_of_all(distance, relevance)
            return chosen_of_varying(design, varying, n_tsps, lambda n: best[n])
        return chosen_of_varying(design, varying, n_tsps, lambda n: partition_around_medoids(distance, relevance, n))

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        varying, distance, _ = _distances(training_statistics(design, train, self.key))
        if not 1 < n_tsp < len(varying):
            return ()
        chosen = self.select_design(design, train, [n_tsp])[n_tsp]
        medoids = [int(np.searchsorted(varying, design.inputs.index(name))) for name in chosen]
        value = float(silhouettes(distance, np.argmin(distance[:, medoids], axis=1)).mean())
        comment = "the inputs fall into groups" if value >= _STRUCTURE else "the inputs do not fall into so many groups"
        return (Diagnostic("mean silhouette", value, _STRUCTURE, value >= _STRUCTURE, comment),)


def medoids_of_all(distance: Array, relevance: Array) -> list[Columns]:
    """Best set of n medoids for n = 0 to p, of all 2^p sets, from distances (p, p) and the inputs' relevance (p,).

    Ties go by relevance, then to the largest set number k; set k holds input j where bit p − 1 − j of k is 1.
    """
    p = len(distance)
    nearest, worth = np.full((1, p), np.inf), np.zeros(1)
    for j in range(p - 1, -1, -1):
        nearest = np.concatenate([nearest, np.minimum(nearest, distance[j])])
        worth = np.concatenate([worth, worth + relevance[j]])
    subset = np.arange(len(nearest))
    size = np.bitwise_count(subset)
    order = np.lexsort((-subset, -np.round(worth, DIGITS), np.round(nearest.sum(axis=1), DIGITS), size))
    first = subset[order[np.searchsorted(size[order], np.arange(p + 1))]]
    bits = 1 << np.arange(p)[::-1]
    return [np.flatnonzero(k & bits) for k in first]


def partition_around_medoids(distance: Array, relevance: Array, n: int) -> Columns:
    """PAM: n medoids built greedily, then the best swap until none helps; sorted columns (n,).

    `distance` (p, p) between inputs, their `relevance` (p,) decides ties.
    """
    nearest = np.full(len(distance), np.inf)
    medoids = np.empty(0, np.int64)
    for _ in range(n):
        total = np.minimum(nearest, distance).sum(axis=1)
        total[medoids] = np.inf
        j = np.lexsort((-relevance, np.round(total, DIGITS)))[0]
        nearest = np.minimum(nearest, distance[j])
        medoids = np.append(medoids, j)
    while True:
        medoids = np.sort(medoids)
        others = np.setdiff1d(np.arange(len(distance)), medoids)
        if not len(others):
            return medoids
        without = np.array([distance[np.delete(medoids, k)].min(axis=0, initial=np.inf) for k in range(n)])
        total = np.minimum(without[:, None], distance[others]).sum(axis=2)  # (medoid out, other in)
        worth = relevance[others] - relevance[medoids, None]
        out, into = (i.ravel() for i in np.indices(total.shape))
        best = np.lexsort((-out, into, -np.round(worth.ravel(), DIGITS), np.round(total.ravel(), DIGITS)))[0]
        k, j = out[best], into[best]
        gain = round(float(distance[medoids].min(axis=0).sum() - total[k, j]), DIGITS)
        more, earlier = round(float(worth[k, j]), DIGITS), medoids[k] - others[j]
        if not (gain, more, earlier) > (0, 0, 0):
            return medoids
        medoids[k] = others[j]


def silhouettes(distance: Array, label: Columns) -> Array:
    """(b − a) / max(a, b) of every member (p,): a mean distance within its group, b to the nearest other; alone: 0.

    Source: P. Rousseeuw (1987), J. Comput. Appl. Math. 20, 53–65.
    """
    member = label[:, None] == np.unique(label)
    total, count = distance @ member, member.sum(axis=0)
    own = (total * member).sum(axis=1) / np.maximum(count @ member.T - 1, 1)
    other = np.where(member, np.inf, total / count).min(axis=1)
    alone = (count @ member.T == 1) | ~np.isfinite(other)
    size = np.maximum(own, other)
    return np.where(alone | (size == 0), 0.0, (other - own) / np.where(size > 0, size, 1.0))


def _distances(statistics: Statistics) -> tuple[Columns, Array, Array]:
    """Of the inputs that vary: their columns, distances 1 − |corr| and |corr| with the error."""
    varying = np.flatnonzero(statistics.varying)
    distance = 1.0 - np.abs(statistics.between[np.ix_(varying, varying)])
    return varying, distance, np.abs(statistics.with_target[varying])
