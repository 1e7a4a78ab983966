"""The exact path against scikit-learn's, stability selection against its definition and a planted truth."""

from itertools import combinations

import numpy as np
import pytest
from sklearn.linear_model import lasso_path
from stacked_rows import LENGTHS, P, orthonormal, stack, year

from data.arrays import Array
from features.design import Design
from features.selectors.elastic_net_path import ElasticNetPath, active_inputs

TRAIN = [0, 1, 3, 4]
LEVELS = np.geomspace(1.0, 1e-3, 25)


def unit(values: Array) -> Array:
    """Columns less their mean, over their length."""
    centred = values - values.mean(axis=0)
    return centred / np.linalg.norm(centred, axis=0)


def by_descent(x: Array, y: Array, ridge: float, levels: Array) -> Array:
    """scikit-learn's coefficients (L, p): the ridge part as rows of their own."""
    p = x.shape[1]
    rows, target = np.vstack([x, np.sqrt(ridge) * np.eye(p)]), np.concatenate([y, np.zeros(p)])
    return lasso_path(rows, target, alphas=levels / len(target), tol=1e-12, max_iter=500_000)[1].T


@pytest.mark.parametrize("ridge", [0.0, 0.05])
def test_active_inputs_equal_scikit_learns_path(ridge: float) -> None:
    x, y = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        raw = rng.normal(size=(60, 3)) @ rng.normal(size=(3, 6)) + rng.uniform(0.1, 1.0) * rng.normal(size=(60, 6))
        x.append(unit(raw))
        y.append(unit((raw @ rng.normal(size=6) + rng.normal(size=60))[:, None])[:, 0])
    products = np.array([a.T @ a + ridge * np.eye(6) for a in x])
    got = active_inputs(products, np.array([a.T @ b for a, b in zip(x, y, strict=True)]), LEVELS)
    left = 0
    for s in range(12):
        beta = by_descent(x[s], y[s], ridge, LEVELS)
        clear = np.abs(beta) > 1e-6
        np.testing.assert_array_equal(got[s] & clear, clear)
        assert (got[s] & ~clear).sum() <= 1  # within descent's rounding of joining
        left += int((got[s, :-1] & ~got[s, 1:]).sum())
    assert left > 0 or ridge  # paths with inputs that leave again were among them


def test_a_problem_does_not_depend_on_those_beside_it() -> None:
    rng = np.random.default_rng(5)
    x = [unit(rng.normal(size=(30, 5)) @ rng.normal(size=(5, 5))) for _ in range(4)]
    products = np.array([a.T @ a + 0.01 * np.eye(5) for a in x])
    with_target = np.array([a.T @ unit(rng.normal(size=(30, 1)))[:, 0] for a in x])
    together = active_inputs(products, with_target, LEVELS)
    for s in range(4):
        np.testing.assert_array_equal(
            active_inputs(products[s : s + 1], with_target[s : s + 1], LEVELS)[0], together[s]
        )


def test_frequencies_are_shares_of_all_halves_of_few_batches() -> None:
    design = stack(*year(), LENGTHS)
    levels = np.geomspace(1.0, 1e-4, 41)
    active = []
    for half in combinations(TRAIN, 2):
        x, y, _ = design.stacked(half)
        active.append(np.abs(by_descent(unit(x), unit(y[:, None])[:, 0], 0.05, levels)) > 1e-7)
    got = ElasticNetPath(ridge=0.05).frequencies(design, TRAIN, np.arange(P))
    assert np.mean(np.abs(got - np.mean(active, axis=0)) < 1e-9) > 0.97  # the rest: descent's rounding at a join


def test_many_batches_are_drawn_in_complementary_pairs() -> None:
    halves = ElasticNetPath(subsamples=20)._halves(9)
    assert halves.shape == (20, 9) and (halves.sum(axis=1) == 4).all()
    assert not (halves[::2] & halves[1::2]).any()
    np.testing.assert_array_equal(halves, ElasticNetPath(subsamples=20)._halves(9))
    assert (halves != ElasticNetPath(subsamples=20, seed=1)._halves(9)).any()


def planted(odd: float) -> Design:
    """Twelve batches whose error two inputs make, t1 and t4; in one of them a third, t2, drives `odd` times as much."""
    q = orthonormal(360, 7, seed=8) * np.sqrt(360)
    y = 2.0 * q[:, 1] + q[:, 4] + 0.3 * q[:, 6]
    y[330:] += odd * q[330:, 2]
    return stack(q[:, :6], y, [30] * 12)


def test_what_drives_one_odd_batch_is_not_preferred_to_what_drives_all() -> None:
    design = planted(odd=14.0)
    with_error = np.abs(np.corrcoef(np.column_stack([design.x, design.y_um]), rowvar=False)[-1, :-1])
    assert with_error[2] > with_error[4]
    assert ElasticNetPath().select_design(design, range(12), [2])[2] == ("t1", "t4")


def test_the_frequency_at_the_cut_tells_causes_from_chance() -> None:
    design, selector = planted(odd=0.0), ElasticNetPath()
    (two,) = selector.diagnostics(design, range(12), 2)
    assert two.ok and two.value > 0.9 and two.threshold == 0.6 and "pick t4, the last chosen" in two.comment
    (odd,) = selector.diagnostics(planted(odd=14.0), range(12), 2)
    assert odd.value < two.value - 0.2
    (five,) = selector.diagnostics(design, range(12), 5)
    assert not five.ok or five.value < two.value
