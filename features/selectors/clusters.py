"""Fuzzy clusters of inputs: transitive closure of the similarity |corr|, cut into every number of classes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design
from features.selectors.base import Diagnostic
from features.selectors.statistics import DIGITS, Statistics, chosen_of_varying, ranking

_CHAINED, _ONE_CLUSTER = 0.1, 0.6  # a weaker pair than its cluster's level by this; a share of all in one cluster


def transitive_closure(similarity: Array) -> Array:
    """Smallest max–min transitive relation above a symmetric similarity (p, p) with ones on its diagonal.

    The fixed point of R ← R∘R, (R∘R)_ij = max_k min(r_ik, r_kj), reached in one pass over k
    (L. A. Zadeh 1971, Similarity relations and fuzzy orderings, Inf. Sci. 3; S. Warshall 1962, J. ACM 9).
    """
    closure = similarity.copy()
    for k in range(len(closure)):
        np.maximum(closure, np.minimum(closure[:, k, None], closure[k]), out=closure)
    return closure


def partitions(closure: Array) -> NDArray[np.int64]:
    """Class of every member for every number of classes, (p, p): row n−1 holds n classes, named by their first member.

    Lowering λ from 1 merges classes; where several merge at one λ, no cut gives the numbers between. Then
    they merge one after the other in the order of their first members, as single linkage does, so every n exists.
    """
    p = len(closure)
    current = np.arange(p)
    classes = np.tile(current, (p, 1))
    i, j = np.triu_indices(p, 1)
    order = np.argsort(-np.round(closure[i, j], DIGITS), kind="stable")
    n = p
    for a, b in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if n == 1:
            break
        first, second = sorted((int(current[a]), int(current[b])))
        if first != second:
            current[current == second] = first
            n -= 1
            classes[n - 1] = current
    return classes


def best_of_clusters(
    design: Design, statistics: Statistics, score: Array, n_tsps: Sequence[int]
) -> dict[int, tuple[str, ...]]:
    """From each of n clusters the input of the largest score (p,), for every requested n.

    Constant inputs have no similarity; they join, in the design's order, only when n exceeds the number of the others.
    """
    varying = np.flatnonzero(statistics.varying)
    classes = partitions(transitive_closure(np.abs(statistics.between[np.ix_(varying, varying)])))
    best_first = ranking(score[varying], np.ones(len(varying), bool))

    def best_of_each(n: int) -> NDArray[np.int64]:
        _, best = np.unique(classes[n - 1, best_first], return_index=True)
        return best_first[best]

    return chosen_of_varying(design, varying, n_tsps, best_of_each)


def chaining(design: Design, statistics: Statistics, n_tsp: int) -> tuple[Diagnostic, ...]:
    """Chaining of single linkage in the largest of n clusters: members joined through others, and its size."""
    varying = np.flatnonzero(statistics.varying)
    if not 1 < n_tsp < len(varying):
        return ()
    similarity = np.abs(statistics.between[np.ix_(varying, varying)])
    closure = transitive_closure(similarity)
    label = partitions(closure)[n_tsp - 1]
    largest = np.flatnonzero(label == np.argmax(np.bincount(label)))
    direct = similarity[np.ix_(largest, largest)]
    i, j = np.unravel_index(np.argmin(direct), direct.shape)
    level = float(closure[np.ix_(largest, largest)].min())
    gap, share = level - float(direct[i, j]), len(largest) / len(varying)
    one, other = (design.inputs[varying[largest[k]]] for k in sorted((i, j)))
    return (
        Diagnostic("chaining in the largest cluster", gap, _CHAINED, gap <= _CHAINED,
                   f"{one} and {other} share a cluster of level {level:.2f}; their own |corr| is {direct[i, j]:.2f}"),
        Diagnostic("share of inputs in the largest cluster", share, _ONE_CLUSTER, share <= _ONE_CLUSTER,
                   f"{len(largest)} of {len(varying)} inputs; {n_tsp} clusters in all"),
    )  # fmt: skip
