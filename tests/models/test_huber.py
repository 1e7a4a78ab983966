"""Huber regression against scikit-learn's, its own stationary conditions, and rows spoiled on purpose."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from sklearn.linear_model import HuberRegressor

from features.design import Design
from models.families.huber import Huber, minimise
from models.families.mlr import MLR
from tests.toys.runs import stack

K, N, P = 6, 50, 4
COEF = np.array([2.0, -1.5, 0.8, 3.0])
FOLDS = [[j for j in range(K) if j != k] for k in range(K)] + [[2], [0, 3]]


def make_design(seed=0, spoiled=0.0) -> Design:
    """Warm-ups; of the rows a share `spoiled` has a wrong reading: chips on the probe, always one way."""
    rng = np.random.default_rng(seed)
    hours = np.arange(N)[:, None] * 300 / 3600
    gains = rng.uniform(0.2, 1, (3, P))
    modes = np.vstack([rng.uniform(6, 20, 3) * (1 - np.exp(-hours / [0.4, 1.5, 5.0])) for _ in range(K)])
    x = modes @ gains + rng.normal(0, 0.5, (K * N, P))
    y = x @ COEF + 4 + rng.normal(0, 1, K * N)
    y[rng.random(K * N) < spoiled] += 60.0
    return stack(x, y, [N] * K)


def criterion(x, y, beta, sigma, epsilon) -> float:
    z = np.abs(y - x @ beta) / sigma
    return float(len(y) * sigma + sigma * np.where(z <= epsilon, z**2, 2 * epsilon * z - epsilon**2).sum())


@pytest.mark.parametrize("epsilon", [1.1, 1.35, 2.5])
def test_every_fold_is_scikit_learns_or_nearer_to_the_minimum(epsilon):
    design = make_design(spoiled=0.1)
    for fold, model in zip(FOLDS, Huber((epsilon,), 1e-12).as_published().fit_folds(design, FOLDS), strict=True):
        x, y, _ = design.stacked(fold)
        z, f = (x - x.mean(0)) / x.std(0), model.fitted
        other = HuberRegressor(epsilon=epsilon, alpha=0.0, tol=1e-8, max_iter=5000).fit(z, y)
        predicted = x @ f["coef_um_per_K"] + f["intercept_um"]
        np.testing.assert_allclose(predicted, other.predict(z), rtol=0, atol=2e-3)
        assert f["scale_um"] == pytest.approx(other.scale_, rel=1e-3)
        assert f["far_share"] == pytest.approx(other.outliers_.mean(), abs=1.1 / len(y))
        beta = np.append(f["coef_um_per_K"], f["intercept_um"])
        ours = criterion(np.column_stack([x, np.ones(len(x))]), y, beta, f["scale_um"], epsilon)
        theirs = criterion(z, y - other.intercept_, other.coef_, other.scale_, epsilon)
        assert ours <= theirs * (1 + 1e-10)


def test_the_criterion_has_its_minimum_there_ridge_included():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(80, 3)), rng.standard_t(2, 80)
    y += x @ [1.0, 2.0, -1.0]
    penalty, epsilon = np.array([5.0, 0.0, 20.0]), 1.5

    def penalised(theta):
        beta, sigma = theta[:3], np.exp(theta[3])
        return criterion(x, y, beta, sigma, epsilon) + (penalty * beta**2).sum() / sigma

    found = minimise(x, y, np.ones((1, 80), bool), np.array([epsilon]), penalty[None], np.ones((1, 3), bool))
    best = minimize(penalised, np.zeros(4), method="BFGS", options={"gtol": 1e-9})
    np.testing.assert_allclose(np.append(found.beta[0], np.log(found.scale[0])), best.x, rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_few_rows_with_errors_of_any_size_end_at_the_minimum(seed):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(20, 3)), rng.standard_cauchy(20)
    epsilon, none, all_move = np.array([1.001]), np.zeros((1, 3)), np.ones((1, 3), bool)
    found = minimise(x, y, np.ones((1, 20), bool), epsilon, none, all_move)
    size = np.full(4, 0.1 * found.scale[0])
    at = np.append(found.beta[0], found.scale[0])
    here = criterion(x, y, at[:3], at[3], 1.001)
    assert found.steps[0] < 500
    for change in (*np.diag(size), *-np.diag(size)):  # convex: no neighbour along an axis is lower at a minimum
        assert criterion(x, y, (at + change)[:3], (at + change)[3], 1.001) >= here * (1 - 1e-8)


def test_spoiled_rows_move_least_squares_but_not_this():
    clean, spoiled = make_design(3), make_design(3, spoiled=0.15)
    true = clean.x[clean.rows(5)] @ COEF + 4
    worst = {}
    for family in (MLR, Huber):
        model = family().as_published().fit_design(spoiled, range(5))
        worst[family] = np.abs(model.predict_design(clean, [5])[0] - true).max()
    assert worst[Huber] < 3.0 < 7.0 < worst[MLR]


def test_the_choice_of_epsilon_is_the_brute_force_choice():
    design = make_design(4, spoiled=0.05)
    epsilons = (1.05, 1.35, 3.0, 10.0)
    for fold in ([0, 1, 2, 3, 4], [1, 3, 5], [0, 4], [2]):
        S_um = np.zeros(4)
        parts = [design.rows(k) for k in fold]
        if len(fold) < 3:
            parts = [slice(r.start + q * N // 4 + (q * N % 4 > 0), r.start + (q + 1) * N // 4 + ((q + 1) * N % 4 > 0))
                     for r in parts for q in range(4)]  # fmt: skip
        rows = np.concatenate([np.arange(r.start, r.stop) for r in parts])
        for left in parts:
            rest = rows[(rows < left.start) | (rows >= left.stop)]
            for e, epsilon in enumerate(epsilons):
                alone = stack(design.x[rest], design.y_um[rest], [len(rest)])
                f = Huber((epsilon,)).as_published().fit_design(alone, [0]).fitted
                residual = design.y_um[left] - design.x[left] @ f["coef_um_per_K"] - f["intercept_um"]
                S_um[e] += np.sqrt(residual @ residual / (len(residual) - 1))
        chosen = Huber(epsilons).as_published().fit_design(design, fold).fitted["epsilon"]
        assert chosen == epsilons[int(np.argmin(S_um))]


def test_an_exact_law_is_found_exactly_and_the_scale_is_nothing():
    design = make_design(5)
    exact = replace(design, y_um=design.x @ COEF - 7)
    fitted = Huber((1.35,), 1e-12).as_published().fit_design(exact, range(K)).fitted
    np.testing.assert_allclose(fitted["coef_um_per_K"], COEF, atol=1e-6)
    assert fitted["scale_um"] < 1e-4


def test_sensors_that_tell_nothing_take_no_part():
    design = make_design(6, spoiled=0.05)
    x = np.column_stack([design.x, np.full(len(design.x), 21.3), design.x[:, 1]])
    wide = stack(x, design.y_um, [N] * K)
    model, narrow = (Huber().as_published().fit_design(d, range(K)) for d in (wide, design))
    assert model.fitted["coef_um_per_K"][4] == 0
    assert model.fitted["coef_um_per_K"][5] == pytest.approx(model.fitted["coef_um_per_K"][1], rel=1e-3)
    np.testing.assert_allclose(model.predict_design(wide, [0])[0], narrow.predict_design(design, [0])[0], atol=1e-3)
