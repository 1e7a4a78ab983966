"""Selector: fuzzy clusters, from each the input of largest grey relational degree with the error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from features.design import Design
from features.grey import relational_degree
from features.selectors.base import Diagnostic, Selector
from features.selectors.clusters import best_of_clusters, chaining
from features.selectors.statistics import check_n_tsps, training_statistics


class FuzzyClusterGreyCorrelation(Selector):
    """n clusters by the transitive closure of |corr|, from each the input of largest grey relational degree.

    The closure equals single linkage, so it chains: two groups joined by one sensor between them fall into
    one cluster while a single odd sensor takes a cluster of its own.
    """

    key = "fcgc"
    summary = "fuzzy clusters, from each the largest grey relational degree with the error"
    source = "fuzzy clustering + grey correlation (FCGC) of the year-round studies; J. L. Deng (1989) for the degree"

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        statistics = training_statistics(design, train, self.key)
        x, y_um, _ = design.stacked(train)
        degree = np.zeros(len(design.inputs))
        degree[statistics.varying] = relational_degree(x[:, statistics.varying], y_um)
        return best_of_clusters(design, statistics, degree, n_tsps)

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        return chaining(design, training_statistics(design, train, self.key), n_tsp)
