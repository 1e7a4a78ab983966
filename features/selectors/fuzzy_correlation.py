"""Selector: fuzzy clusters, from each the input of largest correlation with the error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from features.design import Design
from features.selectors.base import Diagnostic, Selector
from features.selectors.clusters import best_of_clusters, chaining
from features.selectors.statistics import check_n_tsps, training_statistics


class FuzzyCorrelation(Selector):
    """n clusters by the transitive closure of |corr|, from each the input of largest |corr| with the target.

    Chosen anew for every error channel; subject to chaining, as every single linkage.
    """

    key = "fuzzy_correlation"
    summary = "fuzzy clusters, from each the largest |correlation| with the error"
    source = "coupled-lathe study: fuzzy clustering and correlation analysis; L. A. Zadeh (1971) for the closure"

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        statistics = training_statistics(design, train, self.key)
        return best_of_clusters(design, statistics, np.abs(statistics.with_target), n_tsps)

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        return chaining(design, training_statistics(design, train, self.key), n_tsp)
