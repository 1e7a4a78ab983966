"""Fuzzy c-means + grey action: one input from every cluster, by its driving coefficient in a grey model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from features.grey_model import equations, least_squares
from features.selectors.base import Diagnostic, Selector
from features.selectors.fuzzy_c_means import fuzzy_c_means
from features.selectors.statistics import check_n_tsps, chosen_of_varying, ranking, training_statistics

Array = NDArray[np.float64]
Columns = NDArray[np.int64]
Clusters = dict[int, Columns]


class FcmGrey(Selector):
    """n clusters of the standardised curves by fuzzy c-means, from each the input of largest |b_i| of a GM(1,N).

    An input that runs against the error is mirrored before the clustering. The grey model is fitted with all inputs,
    all training batches together; |b_i| is taken times the root sum of squares of the input's cumulated curve, so that
    units do not matter. Where two clusters fall together, which fuzzy c-means cannot prevent, the largest |b_i| of the
    inputs left fill the number. Starts are drawn over the inputs by their |corr| with the error, so that their order
    does not matter.

    Source: grey + LS-SVM study (fuzzy c-means with m = 2, grey action quantity); J. Bezdek (1981) for the clusters,
    J. Deng (1989) for the model.
    """

    key = "fcm_grey"
    words = "fuzzy c-means clusters, from each the largest driving coefficient of a grey model"
    source = "fuzzy c-means and grey action quantity of GM(1,N); J. Bezdek (1981), J. Deng (1989)"

    def __init__(self, fuzziness: float = 2.0, starts: int = 8, seed: int = 0) -> None:
        self.fuzziness, self.starts, self.seed = float(fuzziness), int(starts), int(seed)

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        inputs, clusters = self._clusters(design, train, n_tsps)
        strongest = ranking(driving_strengths(design, train, inputs), np.ones(len(inputs), bool))

        def of_each(n: int) -> Columns:
            cluster = clusters.get(n, np.zeros(len(inputs), np.int64))
            _, first = np.unique(cluster[strongest], return_index=True)
            best = strongest[np.sort(first)]
            rest = strongest[~np.isin(strongest, best)]
            return np.asarray(np.concatenate([best, rest[: n - len(best)]]))

        varying = np.sort(inputs)
        return chosen_of_varying(design, varying, n_tsps, lambda n: np.searchsorted(varying, inputs[of_each(n)]))

    def diagnostics(self, design: Design, train: Sequence[int], n_tsp: int) -> tuple[Diagnostic, ...]:
        _, clusters = self._clusters(design, train, [n_tsp])
        if n_tsp not in clusters:
            return ()
        empty = n_tsp - len(np.unique(clusters[n_tsp]))
        filled = f"of {n_tsp} asked; their points were filled up by the largest driving coefficients"
        words = filled if empty else "each has a point of its own"
        return (Diagnostic("clusters without a member", float(empty), 0.0, empty == 0, words),)

    def _clusters(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> tuple[Columns, Clusters]:
        """The inputs that vary, by |corr| with the error, and for n = 2 to all but one of them the cluster of each."""
        statistics = training_statistics(design, train, self.key)
        inputs = ranking(np.abs(statistics.with_target), statistics.varying)[: np.count_nonzero(statistics.varying)]
        side = np.where(statistics.with_target[inputs] < 0, -1.0, 1.0)
        curves = statistics.between[np.ix_(inputs, inputs)] * side * side[:, None]
        numbers = [n for n in n_tsps if 1 < n < len(inputs)]
        memberships = fuzzy_c_means(curves, numbers, self.starts, self.seed, self.fuzziness)
        return inputs, {n: np.argmax(u, axis=0) for n, u in memberships.items()}


def driving_strengths(design: Design, train: Sequence[int], columns: Columns) -> Array:
    """|b_i| · size of the cumulated input of a GM(1,N) with the given columns as inputs, the largest 1; (p,)."""
    used = np.concatenate([[0], columns + 1, [len(design.inputs) + 1]])
    fit = least_squares(np.concatenate([equations(design, k)[:, used] for k in sorted(train)]))
    strength: Array = np.abs(fit.b) * fit.size
    return strength / (strength.max(initial=0.0) or 1.0)
