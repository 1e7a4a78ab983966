"""Selector: minimal redundancy, maximal relevance (mRMR) by mutual information."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtri
from scipy.stats import rankdata

from data.arrays import Array
from features.design import Design, decimated_rows
from features.selectors.base import Selector
from features.selectors.statistics import DIGITS, check_n_tsps, chosen_of_varying, training_statistics

_MOST_SHARED = 1.0 - 1e-12  # squared correlation of redundant inputs


class MRMR(Selector):
    """One by one the input of largest I(x_j; y) − mean I(x_j; x_i) over the inputs i that are already chosen.

    Mutual information I by the Gaussian copula: values are replaced by the normal scores of their ranks, and
    I = −½ ln(1 − ρ²) in nats in closed form. It is exact where the ranks go together as those of normal variables do, a
    lower bound elsewhere, and the same for any monotone change of scale. Ranks are taken over `most_rows` rows of
    every training batch, evenly spread. Equal scores: the first in the order of the inputs.

    Source: H. Peng, F. Long and C. Ding (2005), IEEE Trans. Pattern Anal. 27, 1226–1238 (difference form, eq. 7); the
    estimate after R. Ince et al. (2017), Hum. Brain Mapp. 38, 1541–1573.
    """

    key = "mrmr"
    summary = "largest mutual information with the error less that with the points already chosen"
    source = "H. Peng, F. Long and C. Ding (2005), IEEE Trans. Pattern Anal. 27, 1226–1238"

    def __init__(self, most_rows: int = 40) -> None:
        self.most_rows = int(most_rows)

    def select_design(self, design: Design, train: Sequence[int], n_tsps: Sequence[int]) -> dict[int, tuple[str, ...]]:
        check_n_tsps(design, n_tsps, self.key)
        varying = np.flatnonzero(training_statistics(design, train, self.key).varying)
        rows = np.concatenate(decimated_rows(design, train, self.most_rows))
        shared = mutual_information(np.column_stack([design.x[np.ix_(rows, varying)], design.y_um[rows]]))
        order = incremental_order(shared[:-1, :-1], shared[:-1, -1])
        return chosen_of_varying(design, varying, n_tsps, lambda n: order[:n])


def mutual_information(values: Array) -> Array:
    """Of all pairs of columns of values (n, q), in nats, (q, q), by the Gaussian copula; a constant column shares 0."""
    scores = ndtri(rankdata(values, axis=0) / (len(values) + 1.0))
    scores -= scores.mean(axis=0)
    products = scores.T @ scores
    size = np.sqrt(products.diagonal())
    size[size <= 1e-9 * np.sqrt(len(values))] = np.inf
    shared: Array = -0.5 * np.log1p(-np.minimum((products / size / size[:, None]) ** 2, _MOST_SHARED))
    return shared


def incremental_order(between: Array, with_target: Array) -> list[int]:
    """All p inputs in the order of mRMR, from I between them (p, p) and with the target (p,)."""
    order: list[int] = []
    redundancy = np.zeros(len(with_target))
    for m in range(len(with_target)):
        score = np.round(with_target - redundancy / max(m, 1), DIGITS)
        score[order] = -np.inf
        best = int(np.argmax(score))
        order.append(best)
        redundancy = redundancy + between[best]
    return order
