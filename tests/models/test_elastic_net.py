"""Elastic net against scikit-learn's coordinate descent, the conditions of a minimum, and brute-force choices."""

import warnings

import numpy as np
import pytest
from sklearn.exceptions import ConvergenceWarning
from sklearn.linear_model import ElasticNet as SkElasticNet

from features.design import Design
from models.families.elastic_net import ElasticNet, sparse_coefficients
from models.families.linear import Blocks
from tests.toys.runs import stack

K, N, P = 6, 40, 6
FOLDS = [[j for j in range(K) if j != k] for k in range(K)] + [[2], [0, 3], [1, 2, 5]]


def make_design(seed=0, x=None) -> Design:
    """Warm-ups of sensors that follow three modes; only sensors 0, 2 and 5 drive the error."""
    rng = np.random.default_rng(seed)
    hours = np.arange(N)[:, None] * 300 / 3600
    parts, errors = [], []
    gains = rng.uniform(0.2, 1, (3, P))
    for k in range(K):
        modes = rng.uniform(6, 20, 3) * (1 - np.exp(-hours / [0.4, 1.5, 5.0]))
        rises = modes @ gains + rng.normal(0, 0.3, (N, P))
        parts.append(rises if x is None else x[k * N : (k + 1) * N])
        errors.append(parts[-1][:, [0, 2, 5]] @ [2.0, -1.5, 0.8] + rng.normal(0, 1) + rng.normal(0, 1, N))
    return stack(np.vstack(parts), np.concatenate(errors), [N] * K)


def scikit(x, y, alpha, mixing) -> np.ndarray:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return SkElasticNet(alpha=alpha, l1_ratio=mixing, tol=1e-14, max_iter=100_000).fit(x, y)


def test_every_fold_is_scikit_learns_model_at_the_chosen_setting():
    design = make_design()
    for fold, model in zip(FOLDS, ElasticNet().as_published().fit_folds(design, FOLDS), strict=True):
        x, y, _ = design.stacked(fold)
        other = scikit(x, y, model.fitted["alpha"], model.fitted["mixing"])
        np.testing.assert_allclose(model.fitted["coef_um_per_K"], other.coef_, rtol=0, atol=1e-6)
        assert model.fitted["intercept_um"] == pytest.approx(other.intercept_, abs=1e-6)
        assert model.fitted["n_active"] == np.count_nonzero(model.fitted["coef_um_per_K"])


@pytest.mark.parametrize("mixing", [1.0, 0.3])
@pytest.mark.parametrize("k", [0.3, 0.01, 1e-4])
def test_the_path_is_scikit_learns_and_begins_where_the_last_coefficient_has_left(mixing, k):
    design = make_design(1)
    x, y, _ = design.stacked(range(K))
    highest = np.abs((x - x.mean(0)).T @ (y - y.mean())).max() / len(y)
    path = ElasticNet((mixing,), k, 2)._path(_pool(design))[0]
    np.testing.assert_array_equal(path[:, 0], 0.0)
    np.testing.assert_allclose(path[:, 1], scikit(x, y, k * highest / mixing, mixing).coef_, rtol=0, atol=1e-6)
    assert np.any(path[:, 1] != 0)


def _pool(design):
    return Blocks.of(design.moments).pool(np.ones((1, K), bool), False)


@pytest.mark.parametrize("case", ["well", "collinear", "twins", "dependent", "more inputs than rows"])
def test_the_active_sets_end_at_the_minimum(case):
    rng = np.random.default_rng(3)
    sets, n, p = 40, 30, 8
    x = rng.normal(size=(sets, n, p))
    if case == "collinear":
        x = x[:, :, :2] @ rng.normal(size=(sets, 2, p)) + 1e-3 * x
    elif case == "twins":
        x[:, :, 5] = x[:, :, 1]
    elif case == "dependent":
        x[:, :, 7] = x[:, :, 0] + x[:, :, 1] - x[:, :, 2]
    elif case == "more inputs than rows":
        x = rng.normal(size=(sets, 5, p))
    y = np.einsum("snp,p->sn", x, rng.normal(size=p)) + rng.normal(size=x.shape[:2])
    xx, xy = x.transpose(0, 2, 1) @ x, np.einsum("snp,sn->sp", x, y)
    for k in (0.5, 0.03, 1e-3):
        highest = np.abs(xy).max(axis=1)
        for square in (np.zeros(sets), 0.1 * highest):
            beta = sparse_coefficients(xx, xy, k * highest, square, np.zeros((sets, p)))
            # Karush–Kuhn–Tucker: gradient = penalty · sign where β ≠ 0, and within the penalty where β = 0.
            gradient = (xy - np.einsum("sij,sj->si", xx, beta) - square[:, None] * beta) / (k * highest)[:, None]
            zero = beta == 0
            np.testing.assert_allclose(gradient[~zero], np.sign(beta[~zero]), rtol=0, atol=1e-6)
            assert np.abs(gradient[zero]).max(initial=0.0) < 1 + 1e-6


def test_a_warm_start_ends_at_the_same_minimum():
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=(20, 50, 7)), rng.normal(size=(20, 50))
    xx, xy = x.transpose(0, 2, 1) @ x, np.einsum("snp,sn->sp", x, y)
    weight, none = 0.1 * np.abs(xy).max(axis=1), np.zeros(20)
    cold = sparse_coefficients(xx, xy, weight, none, np.zeros((20, 7)))
    np.testing.assert_allclose(sparse_coefficients(xx, xy, weight, none, rng.normal(size=(20, 7))), cold, atol=1e-12)
