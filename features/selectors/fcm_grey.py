"""Selector: clusters by fuzzy c-means, from each the input of largest driving coefficient in a grey model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from features.design import Design
from features.grey import equations, least_squares
from features.selectors.base import Diagnostic, Selector
from features.selectors.statistics import check_n_tsps, chosen_of_varying, ranking, training_statistics

_NUMBERS_AT_ONCE = 1_000_000  # in a stack of memberships
_MAX_ITERATIONS = 300
_SMALLEST_SQUARE = 1e-12  # of a distance, for curves of unit size: nearer is the centre itself


def fuzzy_c_means(
    products: Array, numbers: Sequence[int], starts: int, seed: int, fuzziness: float = 2.0, tolerance: float = 1e-6
) -> dict[int, Array]:
    """Memberships u (c, p) of p curves in c clusters for every c of `numbers`: of all starts the least Σ u^m d².

    A centre is a weighted mean of the curves, `v_c = Σ_i u_ci^m x_i / Σ_i u_ci^m`, so its distances follow from the
    curves' inner products (p, p) whatever their length. Then `u_ci = d_ci^(−2/(m−1)) / Σ_c d_ci^(−2/(m−1))`, in turn
    until no membership moves by more than `tolerance`. A start takes c curves, drawn by the seed, as centres; all
    starts of all c run as one stack, and each stops by itself.

    Source: J. Bezdek (1981), Pattern Recognition with Fuzzy Objective Function Algorithms, ch. 3.
    """
    p = len(products)
    rng = np.random.default_rng(seed)
    drawn = np.array([rng.permutation(p) for _ in range(starts)])
    out: dict[int, Array] = {}
    left = sorted(numbers)
    while left:
        at_once = max(1, _NUMBERS_AT_ONCE // (starts * p * left[-1]))
        left, now = left[:-at_once], left[-at_once:]
        membership, cost = _converged(products, np.repeat(now, starts), np.tile(drawn, (len(now), 1)),
                                      fuzziness, tolerance)  # fmt: skip
        best = np.argmin(cost.reshape(len(now), starts), axis=1) + starts * np.arange(len(now))
        out |= {c: membership[t, :c] for c, t in zip(now, best, strict=True)}
    return out


def _converged(
    products: Array, number: NDArray[np.int64], drawn: NDArray[np.int64], fuzziness: float, tolerance: float
) -> tuple[Array, Array]:
    """Memberships (T, c, p) of T runs of `number` clusters each, zero beyond them, and their objectives (T,)."""
    p, most = len(products), int(number.max())
    present = np.arange(most) < number[:, None]
    weight = np.eye(p)[drawn[:, :most]] * present[:, :, None]
    membership, cost = np.zeros_like(weight), np.zeros(len(number))
    running = np.arange(len(number))
    for _ in range(_MAX_ITERATIONS):
        if not len(running):
            break
        there = present[running, :, None]
        square = _squares(weight[running], products)
        closeness = there * square ** (-1.0 / (fuzziness - 1.0))
        u = closeness / closeness.sum(axis=1, keepdims=True)
        raised = u**fuzziness
        moved = np.abs(u - membership[running]).max(axis=(1, 2))
        membership[running] = u
        cost[running] = (raised * square).sum(axis=(1, 2))
        weight[running] = raised / np.where(there, raised.sum(axis=2, keepdims=True), 1.0)
        running = running[moved > tolerance]
    return membership, cost


def _squares(weight: Array, products: Array) -> Array:
    """Squared distances (T, c, p) of centres Σ_i w_i x_i, weight (T, c, p), from all curves."""
    across = weight @ products
    own = np.einsum("tcp,tcp->tc", across, weight)
    square: Array = np.maximum(products.diagonal() - 2.0 * across + own[..., None], _SMALLEST_SQUARE)
    return square


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
    summary = "fuzzy c-means clusters, from each the largest driving coefficient of a grey model"
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
        filled = f"of {n_tsp} requested; their points were filled up by the largest driving coefficients"
        comment = filled if empty else "each has a point of its own"
        return (Diagnostic("clusters without a member", float(empty), 0.0, empty == 0, comment),)

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
