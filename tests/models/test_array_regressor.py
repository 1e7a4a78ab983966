"""The scikit-learn estimator passes scikit-learn's own checks for every row-by-row family."""

import numpy as np
import pytest
from sklearn.linear_model import LinearRegression
from sklearn.model_selection import GroupKFold, cross_val_predict
from sklearn.utils.estimator_checks import parametrize_with_checks

from models import FAMILIES
from models.array_regressor import ArrayRegressor


def _row_by_row() -> list[str]:
    return [key for key in FAMILIES if FAMILIES[key].rowwise and FAMILIES[key].uses_inputs]


@parametrize_with_checks([ArrayRegressor(family) for family in _row_by_row()])
def test_scikit_learn_accepts(estimator, check):
    check(estimator)


def test_default_is_ridge_and_checked_families_include_the_linear_ones():
    assert ArrayRegressor().family == "ridge"
    assert {"mlr", "ridge", "pcr", "pcr_lbo", "pls"} <= set(_row_by_row())


def test_least_squares_is_scikit_learns_in_any_row_order_and_cross_validation():
    rng = np.random.default_rng(1)
    X, groups = rng.normal(size=(60, 3)), np.repeat(np.arange(6), 10)[rng.permutation(60)]
    y = X @ [1.0, -2.0, 0.5] + 4 + rng.normal(size=60)
    np.testing.assert_allclose(
        ArrayRegressor("mlr").fit(X, y, groups=groups).predict(X), LinearRegression().fit(X, y).predict(X), rtol=1e-9
    )
    folds = list(GroupKFold(3).split(X, y, groups))
    np.testing.assert_allclose(
        cross_val_predict(ArrayRegressor("mlr"), X, y, cv=folds),
        cross_val_predict(LinearRegression(), X, y, cv=folds),
        rtol=1e-9,
    )


def test_groups_decide_the_inner_choice():
    rng = np.random.default_rng(2)
    groups = np.tile(np.arange(5), 12)
    X = rng.normal(size=(60, 6)) + groups[:, None]
    y = X[:, 0] + 3 * rng.normal(size=5)[groups] + 0.1 * rng.normal(size=60)
    with_groups, without = ArrayRegressor().fit(X, y, groups=groups), ArrayRegressor().fit(X, y)
    assert with_groups.model_.fitted["k"] != without.model_.fitted["k"]


@pytest.mark.parametrize("family", ["gm1n", "zero", "mean_curve"])
def test_families_of_whole_batches_are_refused(family):
    with pytest.raises(ValueError, match=f"family '{family}' needs whole batches or no inputs"):
        ArrayRegressor(family).fit(np.eye(5), np.arange(5.0))


def test_unknown_family_and_wrong_groups_are_told():
    with pytest.raises(ValueError, match="unknown family 'rigde': did you mean 'ridge'"):
        ArrayRegressor("rigde").fit(np.eye(5), np.arange(5.0))
    with pytest.raises(ValueError, match="groups: 4 values for 5 rows of X"):
        ArrayRegressor().fit(np.eye(5), np.arange(5.0), groups=[0, 0, 1, 1])
