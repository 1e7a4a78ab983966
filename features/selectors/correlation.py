"""Selector: largest correlation with the error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from features.design import Design
from features.selectors.base import Diagnostic, Selector
from features.selectors.statistics import check_n_tsps, in_order, ranking, training_statistics

_NEAR_TWINS = 0.95


class Correlation(Selector):
    """The n inputs of largest |corr| with the target, over the stacked rows of the training batches.

    Neighbours of one hot spot all rank high, so the chosen points are often near twins.
    """

    key = "correlation"
    summary = "largest |correlation| with the error"
    source = "K. Pearson (1895), Proc. R. Soc. 58, 240–242"

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        statistics = training_statistics(design, train, self.key)
        order = ranking(np.abs(statistics.with_target), statistics.varying)
        return {n: in_order(design, order[:n]) for n in n_tsps}

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        if n_tsp < 2:
            return ()
        statistics = training_statistics(design, train, self.key)
        chosen = np.sort(ranking(np.abs(statistics.with_target), statistics.varying)[:n_tsp])
        between = np.triu(np.abs(statistics.between[np.ix_(chosen, chosen)]), 1)
        i, j = np.unravel_index(np.argmax(between), between.shape)
        value = float(between[i, j])
        pair = f"{design.inputs[chosen[i]]} and {design.inputs[chosen[j]]}"
        comment = f"{pair} are nearly redundant" if value > _NEAR_TWINS else f"{pair} are the closest chosen pair"
        return (Diagnostic("largest |corr| among the chosen", value, _NEAR_TWINS, value <= _NEAR_TWINS, comment),)
