"""Selector: stepwise elimination by the smallest principal component of the correlation matrix."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from features.selectors.base import Diagnostic, Selector
from features.selectors.statistics import DIGITS, Statistics, check_n_tsps, in_order, training_statistics

_SAME_EIGENVALUE = 1e-10
_CLOSE_EIGENVALUES = 0.05


class PcaElimination(Selector):
    """Drop the input of largest |loading| in the eigenvector of the smallest eigenvalue; repeat on the rest.

    That component is the tightest linear relation among the inputs, so its largest member is the one the
    others replace best. Independent of the error. Where the smallest eigenvalue is shared (a sensor with two twins),
    the eigenvector is arbitrary and the length of the loadings in the shared space decides. Of equal loadings
    the later input goes, so the last two inputs are always decided by their order.
    """

    key = "pca_elimination"
    summary = "drop the largest loading of the smallest principal component, repeatedly"
    source = "year-round PCR study; after I. T. Jolliffe (1972), Appl. Statist. 21, 160–173, one variable at a time"

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        dropped = elimination_order(training_statistics(design, train, self.key))
        return {n: in_order(design, dropped[len(dropped) - n :]) for n in n_tsps}

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        statistics = training_statistics(design, train, self.key)
        dropped = elimination_order(statistics)
        first = int(np.count_nonzero(~statistics.varying))
        gaps = []
        for step in range(first, len(dropped) - max(n_tsp, 1)):
            left = np.sort(dropped[step:])
            least, next_one = np.linalg.eigvalsh(statistics.between[np.ix_(left, left)])[:2]
            gaps.append(
                (float(1.0 - max(least, 0.0) / next_one) if next_one > _SAME_EIGENVALUE else 0.0, dropped[step])
            )
        if not gaps:
            return ()
        gap, column = min(gaps)
        return (
            Diagnostic("gap of the smallest eigenvalues", gap, _CLOSE_EIGENVALUES, gap >= _CLOSE_EIGENVALUES,
                       f"least of all steps, when {design.inputs[column]} was dropped; without a gap it is chance"),
        )  # fmt: skip


def elimination_order(statistics: Statistics) -> list[int]:
    """All columns in the order in which they are dropped; constant inputs go first, the last of them ahead."""
    dropped = np.flatnonzero(~statistics.varying)[::-1].tolist()
    left = np.flatnonzero(statistics.varying)
    while len(left) > 1:
        goes = _largest_loading(statistics.between[np.ix_(left, left)])
        dropped.append(int(left[goes]))
        left = np.delete(left, goes)
    return [*dropped, *left.tolist()]


def _largest_loading(correlation: NDArray[np.float64]) -> int:
    eigenvalues, vectors = np.linalg.eigh(correlation)
    shared = int(np.count_nonzero(eigenvalues <= eigenvalues[0] + _SAME_EIGENVALUE))
    loading = np.round((vectors[:, :shared] ** 2).sum(axis=1), DIGITS)
    return len(loading) - 1 - int(np.argmax(loading[::-1]))
