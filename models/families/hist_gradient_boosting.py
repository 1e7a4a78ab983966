"""Family: gradient boosting of small trees on binned inputs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from data.arrays import Array
from features.design import Design
from models.base import Family
from models.numerics.trees import Trees, training_rows
from models.program import Builder

_ROWS = 720  # that few batches may give together


class HistGradientBoosting(Family):
    """A constant and `n_trees` trees of at most `leaves` leaves, each grown on the residual of those before it.

    Every tree counts with `rate`; leaves hold at least `leaf` rows, or a twentieth of few; batches give at most
    `max_rows` rows each, or 720 together. No early stopping, which would need spare batches. Beyond the trained
    temperatures it stays constant.

    Source: J. Friedman, Greedy function approximation, Annals of Statistics 29 (2001); binned after G. Ke et al.,
    LightGBM (2017); grown by scikit-learn.
    """

    key = "hist_gradient_boosting"
    summary = "gradient boosting of small trees on binned inputs"
    source = "Friedman 2001; Ke et al. 2017"
    closed_form = False
    rank = 76

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

        rows = training_rows(self.key, design, train, self.max_rows, _ROWS)
        leaf = max(1, min(self.leaf, len(rows) // 20))
        boosted = HistGradientBoostingRegressor(
            max_iter=self.n_trees, learning_rate=self.rate, max_leaf_nodes=self.leaves, min_samples_leaf=leaf,
            early_stopping=False, random_state=self.seed,
        )  # fmt: skip
        with config_context(assume_finite=True, skip_parameter_validation=True):
            boosted.fit(design.x[rows], design.y_um[rows])
        # scikit-learn keeps the grown trees private; a test holds the walk below to its own prediction.
        nodes = [grown.nodes for (grown,) in boosted._predictors]
        parts = []
        for n in nodes:
            left, right = (np.where(n["is_leaf"], -1, n[side].astype(np.int64)) for side in ("left", "right"))
            parts.append((n["feature_idx"], n["num_threshold"], left, right, n["value"]))
        base_um = float(np.ravel(boosted._baseline_prediction)[0])
        return self._learned(design, {**Trees.joined(parts).as_plain(), "base_um": base_um, "n_rows": len(rows)})

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row where an input is missing."""
        trees, out = Trees.from_plain(self.fitted), []
        for k in batches:
            x = design.x[design.rows(k)]
            values = self.fitted["base_um"] + trees.values(x).sum(axis=0)
            out.append(np.where(np.isfinite(x).all(axis=1), values, np.nan))
        return out

    def operations(self, b: Builder) -> Sequence[int]:
        trees = Trees.from_plain(self.fitted)
        total = trees.operation(b, b.features(self.inputs), 1.0, single=False)
        return [b.affine(total, np.ones((1, 1)), self.fitted["base_um"])]

    def n_parameters(self) -> int:
        """A threshold per split and a value per leaf."""
        return int(np.size(self.fitted["feature"])) if self.fitted else 0
