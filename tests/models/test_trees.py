"""Forests and boosted trees: the plain walk against scikit-learn's prediction, and what a bag of batches is worth."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.tree import DecisionTreeRegressor

from features.design import Design
from models.base import Family
from models.families.trees import HistGradientBoosting, RandomForest, joined, walked
from tests.toys.runs import stack


def make_design(batches: int = 8, rows: int = 30, noise_um: float = 0.5, own_um: float = 0.0, seed: int = 0) -> Design:
    """Rises of three sensors, an error that bends with them, and a part of each batch's own."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 10, (batches * rows, 3))
    batch = np.repeat(np.arange(batches), rows)
    y = 3 * x[:, 0] + 0.4 * x[:, 1] ** 2 + rng.normal(0, noise_um, len(x)) + rng.normal(0, own_um, batches)[batch]
    return stack(x, y, [rows] * batches)


def test_the_walk_equals_scikit_learns_trees() -> None:
    design = make_design()
    x32 = design.x.astype(np.float32).astype(float)
    grown = [DecisionTreeRegressor(max_depth=d, random_state=d).fit(design.x, design.y_um) for d in (1, 4, 30)]
    parts = [(t.tree_.feature, t.tree_.threshold, t.tree_.children_left, t.tree_.children_right, t.tree_.value[:, 0, 0])
             for t in grown]  # fmt: skip
    values = walked(joined(parts), x32)
    for own, tree in zip(values, grown, strict=True):
        np.testing.assert_allclose(own, tree.predict(design.x), rtol=1e-12)


def test_a_tree_that_never_splits_is_its_value() -> None:
    trees = joined([([-2], [-2.0], [-1], [-1], [7.5]), ([-2], [-2.0], [-1], [-1], [1.0])])
    assert walked(trees, np.zeros((3, 2))).tolist() == [[7.5] * 3, [1.0] * 3]


def test_boosting_equals_scikit_learns_prediction() -> None:
    design = make_design()
    family = HistGradientBoosting(max_rows=30).as_published()
    fitted = family.fit_design(design, range(7))
    x, y, _ = design.stacked(range(7))
    theirs = HistGradientBoostingRegressor(max_iter=60, max_leaf_nodes=8, min_samples_leaf=8, early_stopping=False,
                                           random_state=0).fit(x, y)  # fmt: skip
    want = theirs.predict(design.x[design.rows(7)])
    np.testing.assert_allclose(fitted.predict_design(design, [7])[0], want, rtol=1e-9)


def test_bags_are_of_batches_so_that_a_batchs_own_part_is_seen_as_doubt() -> None:
    alike, own = make_design(own_um=0.0), make_design(own_um=12.0)
    sure, unsure = (
        RandomForest(max_rows=30).as_published().fit_design(d, range(8)).sd_um(d, [0])[0].mean() for d in (alike, own)
    )
    assert unsure > 10 > 2.5 * sure  # 12 µm that no sensor shows


@pytest.mark.parametrize("own_um", [0.0, 6.0])
def test_stated_intervals_hold_on_batches_that_were_never_seen(own_um: float) -> None:
    design = make_design(batches=40, own_um=own_um)
    fitted = RandomForest(max_rows=30).as_published().fit_design(design, range(20))
    inside = []
    for k in range(20, 40):
        error = design.y_um[design.rows(k)] - fitted.predict_design(design, [k])[0]
        inside.append(np.mean(np.abs(error) <= 1.645 * fitted.sd_um(design, [k])[0]))
    assert 0.8 < np.mean(inside) < 0.98


@pytest.mark.parametrize("cls", [RandomForest, HistGradientBoosting])
def test_a_missing_input_is_no_prediction_and_far_away_is_the_edge(cls: type[Family]) -> None:
    design = make_design()
    fitted = cls().as_published().fit_design(design, range(8))
    x = design.x.copy()
    x[3, 1] = np.nan
    x[5], x[6] = 50.0, 5000.0
    other = replace(design, x=x)
    got = fitted.predict_design(other, [0])[0]
    assert np.isnan(got[3]) and np.isfinite(np.delete(got, 3)).all()
    assert got[5] == got[6]


def test_rows_are_thinned_evenly() -> None:
    rows = RandomForest(max_rows=4).training_rows(make_design(rows=200), range(8))
    assert len(rows) == 480 and set(np.diff(rows[:60])) == {3, 4} and rows[59] == 199
    assert RandomForest(max_rows=10).as_published().fit_design(make_design(20), range(20)).fitted["n_rows"] == 480
