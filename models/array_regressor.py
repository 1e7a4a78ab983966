"""scikit-learn estimator that wraps a row-wise family, for plain arrays."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, column_or_1d, validate_data

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models import FAMILIES
from models.base import Family


class ArrayRegressor(RegressorMixin, BaseEstimator):
    """`family` with its constructor's `options` on X (n, p) and y (n,): pipelines, cross-validation, comparisons.

    `groups` (n,) in `fit` names the batch of every row, for families that choose by leave-batch-out; without it all
    rows are one batch. Inputs carry no unit, so nothing is scaled. After `fit`, `model_` is the fitted family.
    """

    def __init__(self, family: str = "ridge", options: dict[str, Any] | None = None) -> None:
        self.family = family
        self.options = options

    def fit(self, X: ArrayLike, y: ArrayLike, groups: ArrayLike | None = None) -> Self:
        """Raises ValueError, as scikit-learn's estimators do, for arrays or options that cannot be used."""
        x, target = validate_data(self, X, y, dtype=np.float64, y_numeric=True, ensure_min_samples=2)
        batch = np.zeros(len(target), np.int64) if groups is None else column_or_1d(groups)
        if len(batch) != len(target):
            raise ValueError(f"groups: {len(batch)} values for {len(target)} rows of X; give one group per row")
        ids, compact = np.unique(batch, return_inverse=True)
        order = np.argsort(compact, kind="stable")
        offsets = np.searchsorted(compact[order], np.arange(len(ids) + 1)).astype(np.int64)
        try:
            member: type[Family] = FAMILIES[self.family]
            if not (member.rowwise and member.uses_inputs):
                raise InputError(
                    f"ArrayRegressor: family {self.family!r} needs whole batches or no inputs; expected a family that "
                    "predicts each row from its inputs alone"
                )
            model = member(**(self.options or {})).as_published()  # rows of an array have no start
            design = self._design(x[order], np.asarray(target, float)[order], [str(i) for i in ids], offsets)
            self.model_: Family = model.fit_design(design, range(len(ids)))
        except InputError as error:
            raise ValueError(str(error)) from error
        return self

    def predict(self, X: ArrayLike) -> Array:
        """Predictions (n,)."""
        check_is_fitted(self)
        x = validate_data(self, X, dtype=np.float64, reset=False)
        offsets = np.array([0, len(x)], np.int64)
        return self.model_.predict_design(self._design(x, np.full(len(x), np.nan), ["X"], offsets), [0])[0]

    def _design(self, x: Array, y: Array, ids: list[str], offsets: NDArray[np.int64]) -> Design:
        names = getattr(self, "feature_names_in_", [f"x{j}" for j in range(x.shape[1])])
        within = np.arange(len(x)) - np.repeat(offsets[:-1], np.diff(offsets))
        return Design(tuple(map(str, names)), "y", tuple(ids), x, y, within.astype(float), offsets, 1.0)
