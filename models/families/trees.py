"""Families: ensembles of scikit-learn's regression trees, kept and evaluated as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from data.arrays import Array
from features.design import Design
from models.base import Family, Plain, inner_groups
from models.numerics.batches import too_few_rows
from models.numerics.kernels import Rows, evenly
from models.program import Builder

_FEWEST = 4
_VALUES_AT_ONCE = 2_000_000  # tree × row places walked together
_PARTS_OF_ONE = 12  # of one or two batches: a tree that lacks a quarter of its only run knows too little


def joined(parts: Sequence[tuple[Any, Any, Any, Any, Any]]) -> Plain:
    """T trees as arrays, their nodes one after the other: node i goes left if x[feature] ≤ threshold, else right.

    feature, left, right (N,): whole numbers, children counted over all nodes; a leaf is its own child on both sides.
    threshold, value (N,); roots (T,).

    Args:
        parts: (feature, threshold, left, right, value) of each tree, children counted within it. A node is a leaf
            where left equals right, as it does in scikit-learn's trees.
    """
    sizes = np.array([len(part[0]) for part in parts])
    roots = np.cumsum(sizes) - sizes
    feature, threshold, left, right, value = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    leaf, own, first = left == right, np.arange(len(left)), np.repeat(roots, sizes)
    return {
        "roots": roots.astype(np.int64),
        "feature": np.where(leaf, 0, feature).astype(np.int64),
        "threshold": np.where(leaf, 0.0, threshold),
        "left": np.where(leaf, own, left + first).astype(np.int64),
        "right": np.where(leaf, own, right + first).astype(np.int64),
        "value": value.astype(float),
    }


def walked(trees: Plain, x: Array) -> Array:
    """Each tree's value (T, n) at rows x (n, p); undefined for NaN rows."""
    roots, feature, threshold, left, right = (trees[k] for k in ("roots", "feature", "threshold", "left", "right"))
    out = np.empty((len(roots), len(x)))
    step = max(1, _VALUES_AT_ONCE // max(1, len(roots)))
    for start in range(0, len(x), step):
        some = x[start : start + step]
        row = np.arange(len(some))
        node = np.tile(roots[:, None], (1, len(some)))
        while True:
            child = np.where(some[row, feature[node]] <= threshold[node], left[node], right[node])
            if np.array_equal(child, node):
                break
            node = child
        out[:, start : start + step] = trees["value"][node]
    return out


class TreeEnsemble(Family):
    """Trees that scikit-learn grows on some rows of each batch; `fitted` has the arrays of `joined`.

    A trained model predicts without scikit-learn. Trees do not extrapolate: beyond the trained temperatures the
    prediction stays constant.
    """

    closed_form = False
    most_of_few: ClassVar[int]  # rows that few batches may give together
    averaged: ClassVar[bool]  # the mean of the trees, grown in single precision; False: base_um and their sum
    max_rows: int

    def training_rows(self, design: Design, train: Sequence[int]) -> Rows:
        """Usable rows of the batches `train`, evenly at most `max_rows` of each, more where the batches are few.

        Raises:
            InputError: fewer than 4 usable rows.
        """
        each = max(self.max_rows, self.most_of_few // max(1, len(train)))
        out = evenly(design, sorted(train), each)
        if len(out) < _FEWEST:
            raise too_few_rows(self.key, design, train, len(out), _FEWEST)
        return out

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row where an input is missing."""
        share, base_um = self._share_and_base()
        return [base_um + share * self._values(design, k).sum(axis=0) for k in batches]

    def operations(self, b: Builder) -> Sequence[int]:
        f, (share, base_um) = self.fitted, self._share_and_base()
        walk = {name: f[name] for name in ("roots", "feature", "threshold", "left", "right")}
        value = share * f["value"] + base_um / len(f["roots"])
        return [b.add("trees", [b.features(self.inputs)], 1, **walk, value=value, single=float(self.averaged))]

    def n_parameters(self) -> int:
        """A threshold per split and a value per leaf."""
        return int(np.size(self.fitted["feature"])) if self.fitted else 0

    def _share_and_base(self) -> tuple[float, float]:
        return (1.0 / len(self.fitted["roots"]), 0.0) if self.averaged else (1.0, self.fitted["base_um"])

    def _values(self, design: Design, k: int) -> Array:
        """Each tree's value (T, n_k) on the rows of batch k, NaN where an input is missing."""
        x = design.x[design.rows(k)]
        values = walked(self.fitted, _single(x) if self.averaged else x)
        values[:, ~np.isfinite(x).all(axis=1)] = np.nan
        return values


class RandomForest(TreeEnsemble):
    """The mean of `n_trees` regression trees, each grown on a bootstrap of the training batches.

    Rows of one batch are near copies of each other: a bootstrap of rows would hold nearly every batch, and what is out
    of the bag would be known all the same. Fewer than 3 batches are cut into twelfths. A split considers a third of the
    inputs; leaves hold at least `leaf` rows; batches give at most `max_rows` rows each, or 480 together. `sd_um`:
    variance = a + b · (variance over the trees), a and b ≥ 0 fitted to the squared out-of-bag residuals; each tree
    counts from its value at the batch's start.

    Source: L. Breiman, Random forests, Machine Learning 45 (2001); its trees are scikit-learn's.
    """

    key = "random_forest"
    summary = "random forest on bootstraps of whole batches"
    source = "Breiman 2001"
    has_sd = True
    rank = 75
    most_of_few, averaged = 480, True

    def __init__(self, n_trees: int = 24, leaf: int = 3, max_rows: int = 16, seed: int = 0) -> None:
        super().__init__()
        self.n_trees, self.leaf, self.max_rows, self.seed = int(n_trees), int(leaf), int(max_rows), int(seed)

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        """Raises InputError: fewer than 4 usable rows."""
        from sklearn import config_context
        from sklearn.tree import DecisionTreeRegressor

        rows = self.training_rows(design, train)
        x, y = design.x[rows], design.y_um[rows]
        _, block = np.unique(inner_groups(design.group[rows], _PARTS_OF_ONE), return_inverse=True)
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
        trees = joined(parts)
        constant, factor = _spread(walked(trees, _single(x)), y, drawn[:, block] == 0)
        return self._learned(design, {**trees, "variance_um2": constant, "factor": factor, "n_rows": len(rows)})

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value."""
        out = []
        for k in batches:
            values = self._values(design, k)
            if self.zero_start:
                values = np.stack([design.since_start(tree, k, self.target) for tree in values])
            out.append(np.sqrt(self.fitted["variance_um2"] + self.fitted["factor"] * values.var(axis=0)))
        return out


class HistGradientBoosting(TreeEnsemble):
    """A constant and `n_trees` trees of at most `leaves` leaves, each grown on the residual of those before it.

    Every tree counts with `rate`; leaves hold at least `leaf` rows, or a twentieth of few; batches give at most
    `max_rows` rows each, or 720 together. No early stopping, which would need spare batches.

    Source: J. Friedman, Greedy function approximation, Annals of Statistics 29 (2001); binned after G. Ke et al.,
    LightGBM (2017); grown by scikit-learn.
    """

    key = "hist_gradient_boosting"
    summary = "gradient boosting of small trees on binned inputs"
    source = "Friedman 2001; Ke et al. 2017"
    rank = 76
    most_of_few, averaged = 720, False

    def __init__(
        self, n_trees: int = 60, rate: float = 0.1, leaves: int = 8, leaf: int = 8, max_rows: int = 36, seed: int = 0
    ) -> None:
        super().__init__()
        self.n_trees, self.rate, self.leaves = int(n_trees), float(rate), int(leaves)
        self.leaf, self.max_rows, self.seed = int(leaf), int(max_rows), int(seed)

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        """Raises InputError: fewer than 4 usable rows."""
        from sklearn import config_context
        from sklearn.ensemble import HistGradientBoostingRegressor

        rows = self.training_rows(design, train)
        boosted = HistGradientBoostingRegressor(
            max_iter=self.n_trees, learning_rate=self.rate, max_leaf_nodes=self.leaves,
            min_samples_leaf=max(1, min(self.leaf, len(rows) // 20)), early_stopping=False, random_state=self.seed,
        )  # fmt: skip
        with config_context(assume_finite=True, skip_parameter_validation=True):
            boosted.fit(design.x[rows], design.y_um[rows])
        # scikit-learn keeps the grown trees private; a test holds `walked` to its own prediction.
        parts = []
        for nodes in (grown.nodes for (grown,) in boosted._predictors):
            left, right = (np.where(nodes["is_leaf"], -1, nodes[side].astype(np.int64)) for side in ("left", "right"))
            parts.append((nodes["feature_idx"], nodes["num_threshold"], left, right, nodes["value"]))
        base_um = float(np.ravel(boosted._baseline_prediction)[0])
        return self._learned(design, {**joined(parts), "base_um": base_um, "n_rows": len(rows)})


def _single(x: Array) -> Array:
    """Inputs in the precision that a forest's trees are grown in: a split is where single precision puts it."""
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
