"""Family: random forest on bootstraps of whole batches, so that out-of-bag samples are batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from data.arrays import Array
from features.design import Design
from models.base import Family, inner_groups
from models.numerics.trees import Trees, training_rows
from models.program import Builder

_ROWS = 480  # that few batches may give together
_PARTS_OF_ONE = 12  # of one or two batches: a tree that lacks a quarter of its only run knows too little


class RandomForest(Family):
    """The mean of `n_trees` regression trees, each grown on a bootstrap of the training batches.

    Rows of one batch are near copies of each other: a bootstrap of rows would hold nearly every batch, and what is out
    of the bag would be known all the same. Fewer than 3 batches are cut into twelfths. A split considers a third of the
    inputs; leaves hold at least `leaf` rows; batches give at most `max_rows` rows each, or 480 together. `sd_um`:
    variance = a + b · (variance over the trees), a and b ≥ 0 fitted to the squared out-of-bag residuals.

    A forest does not extrapolate: beyond the trained temperatures it stays constant. Each tree counts from its value at
    the batch's start.

    Source: L. Breiman, Random forests, Machine Learning 45 (2001); its trees are scikit-learn's.
    """

    key = "random_forest"
    summary = "random forest on bootstraps of whole batches"
    source = "Breiman 2001"
    closed_form = False
    has_sd = True
    rank = 75

    def __init__(self, n_trees: int = 24, leaf: int = 3, max_rows: int = 16, seed: int = 0) -> None:
        super().__init__()
        self.n_trees, self.leaf, self.max_rows, self.seed = int(n_trees), int(leaf), int(max_rows), int(seed)

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        """Raises InputError: fewer than 4 usable rows."""
        from sklearn import config_context
        from sklearn.tree import DecisionTreeRegressor

        rows = training_rows(self.key, design, train, self.max_rows, _ROWS)
        x, y, group = design.x[rows], design.y_um[rows], design.group[rows]
        _, block = np.unique(inner_groups(group, _PARTS_OF_ONE), return_inverse=True)
        rng = np.random.default_rng(self.seed)
        n_blocks = int(block.max()) + 1
        drawn = np.stack([np.bincount(rng.integers(n_blocks, size=n_blocks), minlength=n_blocks)
                          for _ in range(self.n_trees)])  # fmt: skip
        share = max(1, -(-x.shape[1] // 3))
        parts, single = [], x.astype(np.float32)
        for t, weight in enumerate(drawn[:, block]):
            tree = DecisionTreeRegressor(min_samples_leaf=self.leaf, max_features=share, random_state=self.seed + t)
            held = np.repeat(np.arange(len(y)), weight)
            with config_context(assume_finite=True, skip_parameter_validation=True):
                grown = tree.fit(single[held], y[held], check_input=False).tree_
            value = grown.value[:, 0, 0]
            parts.append((grown.feature, grown.threshold, grown.children_left, grown.children_right, value))
        trees = Trees.joined(parts)
        constant, factor = _spread(trees.values(_as_grown(x)), y, drawn[:, block] == 0)
        return self._learned(design, {**trees.as_plain(), "variance_um2": constant, "factor": factor,
                                      "n_rows": len(rows)})  # fmt: skip

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row where an input is missing."""
        return [mean for mean, _ in self._moments(design, batches)]

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value."""
        constant, factor = self.fitted["variance_um2"], self.fitted["factor"]
        return [np.sqrt(constant + factor * variance) for _, variance in self._moments(design, batches)]

    def operations(self, b: Builder) -> Sequence[int]:
        trees = Trees.from_plain(self.fitted)
        return [trees.operation(b, b.features(self.inputs), 1.0 / len(trees.roots), single=True)]

    def n_parameters(self) -> int:
        """A threshold per split and a value per leaf."""
        return int(np.size(self.fitted["feature"])) if self.fitted else 0

    def _moments(self, design: Design, batches: Sequence[int]) -> list[tuple[Array, Array]]:
        """Mean and variance over the trees on the rows of each batch."""
        trees, out = Trees.from_plain(self.fitted), []
        for k in batches:
            x = design.x[design.rows(k)]
            values = trees.values(_as_grown(x))
            missing = ~np.isfinite(x).all(axis=1)
            values[:, missing] = np.nan
            if self.zero_start:
                values = np.stack([design.since_start(tree, k, self.target) for tree in values])
            out.append((values.mean(axis=0), values.var(axis=0)))
        return out


def _as_grown(x: Array) -> Array:
    """Inputs in the precision that the trees were grown in: a split is where single precision puts it."""
    return x.astype(np.float32).astype(float)


def _spread(values: Array, y: Array, out_of_bag: NDArray[np.bool_]) -> tuple[float, float]:
    """(a, b) of variance = a + b · variance over the trees, from the out-of-bag residuals; values (T, n)."""
    count = out_of_bag.sum(axis=0)
    judged = count >= 2
    if not judged.any():
        return float(y.var()), 0.0
    held = np.where(out_of_bag, values, 0.0)[:, judged]
    mean = held.sum(axis=0) / count[judged]
    variance = np.where(out_of_bag[:, judged], (values[:, judged] - mean) ** 2, 0.0).sum(axis=0) / count[judged]
    found, _ = nnls(np.column_stack([np.ones(judged.sum()), variance]), (y[judged] - mean) ** 2)
    return float(found[0]), float(found[1])
