"""Selector: stepwise elimination by variance inflation factor (VIF)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.arrays import Array
from features.design import Design
from features.selectors.base import Diagnostic, Selector
from features.selectors.statistics import DIGITS, Statistics, check_n_tsps, in_order, training_statistics

_FLOOR = 1e-10  # smallest eigenvalue that counts: a VIF ends at 1e10
_USUAL_LIMIT = 10.0


class VifPruning(Selector):
    """Drop the input of largest variance inflation factor; repeat on the rest.

    VIF_j = 1/(1 − R_j²), R_j² of input j explained by the others: diagonal j of the inverse correlation matrix. It is
    taken from eigenvectors, with eigenvalues of at least 1e-10, so that where inputs depend on each other exactly the
    one with most of the dependence goes first. Of equal factors, as the last two always have, the input goes that
    is less correlated with the error, then the later one.

    Source: D. Belsley, E. Kuh and R. Welsch (1980), Regression Diagnostics, ch. 3.
    """

    key = "vif_pruning"
    summary = "drop the input that the others explain best, repeatedly"
    source = "D. Belsley, E. Kuh and R. Welsch (1980), Regression Diagnostics, ch. 3"

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        dropped = pruning_order(training_statistics(design, train, self.key))
        return {n: in_order(design, dropped[len(dropped) - n :]) for n in n_tsps}

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        statistics = training_statistics(design, train, self.key)
        kept = pruning_order(statistics)[len(design.inputs) - n_tsp :]
        factor = variance_inflation(statistics.between[np.ix_(kept, kept)])
        largest = float(factor.max())
        comment = f"{design.inputs[kept[int(np.argmax(factor))]]} is the one that the other chosen points explain best"
        return (Diagnostic("largest VIF left", largest, _USUAL_LIMIT, largest <= _USUAL_LIMIT, comment),)


def variance_inflation(correlation: Array) -> Array:
    """VIF (p,) of every input of a correlation matrix (p, p), at most about 1e10."""
    eigenvalues, vectors = np.linalg.eigh(correlation)
    factor: Array = (vectors**2 / np.maximum(eigenvalues, _FLOOR)).sum(axis=1)
    return factor


def pruning_order(statistics: Statistics) -> list[int]:
    """All columns in the order in which they are dropped; constant inputs go first, the last of them ahead."""
    dropped: list[int] = np.flatnonzero(~statistics.varying)[::-1].tolist()
    left = np.flatnonzero(statistics.varying)
    relevance = np.round(np.abs(statistics.with_target), DIGITS)
    while len(left):
        size = np.round(np.log(variance_inflation(statistics.between[np.ix_(left, left)])), DIGITS)
        goes = np.lexsort((left, -relevance[left], size))[-1]
        dropped.append(int(left[goes]))
        left = np.delete(left, goes)
    return dropped
