"""Linear families from moments, held against direct fits on the rows by numpy and scikit-learn."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.cross_decomposition import PLSRegression
from sklearn.linear_model import LinearRegression
from sklearn.linear_model import Ridge as SkRidge
from sklearn.model_selection import LeaveOneGroupOut
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from features.design import Design
from models.base import inner_groups
from models.families.elastic_net import ElasticNet
from models.families.huber import Huber
from models.families.mlr import MLR
from models.families.pcr import PCR, PCRByLeaveBatchOut
from models.families.pls import PLS
from models.families.ridge import Ridge
from tests.toys.runs import stack

LINEAR = [MLR, Ridge, PCR, PCRByLeaveBatchOut, PLS]
EVERY = [*LINEAR, ElasticNet, Huber]
K, N, P = 8, 60, 6
FOLDS = [[j for j in range(K) if j != k] for k in range(K)] + [[k] for k in range(K)] + [[0, 3], [1, 2, 5]]


def make_design(seed=0, quantum_K=0.1, x=None, y_um=None, units=()) -> Design:
    """Collinear rises of a warming machine: four modes, rounded like the instruments', VIF 10³–10⁴."""
    rng = np.random.default_rng(seed)
    tau_s = np.array([0.5, 1.5, 4.0, 10.0]) * 3600
    gains, weights = rng.uniform(0.3, 1, (4, P)), np.array([1.5, 2.0, -1.0, 3.0])
    parts, errors = [], []
    for _ in range(K):
        load = rng.uniform(6, 20) * (1 - np.exp(-np.arange(N)[:, None] * 300.0 / tau_s)) * [1, 0.6, 0.4, 0.3]
        room = rng.normal(0, 3) * (1 - np.exp(-np.arange(N) * 300.0 / 8e3))
        rises = load @ gains + room[:, None] * rng.uniform(0.9, 1, P)
        parts.append(np.round(rises / quantum_K) * quantum_K)
        errors.append(np.round(load @ weights + 2 * room + rng.normal(0, 1, N)))
        errors[-1] -= errors[-1][0]
    x = np.vstack(parts) if x is None else x
    return replace(stack(x, np.concatenate(errors) if y_um is None else y_um, [N] * K), input_units=units)


def predicted(model, design) -> np.ndarray:
    return np.concatenate(model.predict_design(design, range(design.n_batches)))


def published(cls, design, fold) -> np.ndarray:
    return predicted(cls().as_published().fit_design(design, fold), design)


def near(got, want, rtol=1e-8) -> None:
    np.testing.assert_allclose(got, want, rtol=0, atol=rtol * np.abs(want).max())


def least_squares(design, fold) -> np.ndarray:
    X, y, _ = design.stacked(fold)
    return np.linalg.lstsq(X - X.mean(0), y - y.mean(), rcond=None)[0]


def direct(design, fold) -> np.ndarray:
    X, y, _ = design.stacked(fold)
    return (design.x - X.mean(0)) @ least_squares(design, fold) + y.mean()


def brute_choice(design, fold, makers) -> int:
    """The estimator of least mean S by leaving out each inner group in a plain loop."""
    X, y, batch = design.stacked(fold)
    groups = inner_groups(batch)
    S_um = np.zeros(len(makers))
    for train, test in LeaveOneGroupOut().split(X, y, groups):
        for m, make in enumerate(makers):
            e = y[test] - np.ravel(make(X[train], y[train]).predict(X[test]))
            S_um[m] += np.sqrt(e @ e / (len(test) - 1))
    return int(np.argmin(S_um))


def test_mlr_is_least_squares_on_the_rows_in_every_fold():
    design = make_design()
    for fold, model in zip(FOLDS, MLR().as_published().fit_folds(design, FOLDS), strict=True):
        near(predicted(model, design), direct(design, fold))
        X, _, _ = design.stacked(fold)
        Z = (X - X.mean(0)) / X.std(0)
        assert model.fitted["condition"] == pytest.approx(np.linalg.cond(Z), rel=1e-6)
        assert model.fitted["n_rows"] == len(fold) * N


@pytest.mark.parametrize("case", ["twin", "nearly a twin", "constant", "far from the mean"])
def test_mlr_on_deficient_inputs_is_the_minimum_norm_solution(case):
    x = make_design().x.copy()
    if case == "twin":
        x[:, 3] = x[:, 2]
    elif case == "nearly a twin":
        x[:, 3] = x[:, 2] + 1e-6 * np.random.default_rng(3).normal(size=len(x))
    elif case == "constant":
        x[:, 3] = 21.7
    else:
        x = x + 1e5 * np.arange(1, P + 1)
    design = make_design(x=x)
    for fold, model in zip(FOLDS, MLR().as_published().fit_folds(design, FOLDS), strict=True):
        near(predicted(model, design), direct(design, fold), rtol=1e-7)
        near(model.fitted["coef_um_per_K"], least_squares(design, fold), rtol=1e-4 if case == "nearly a twin" else 1e-6)
        if case != "far from the mean":
            assert np.isfinite(model.fitted["condition"])
        if "twin" in case:
            assert model.fitted["condition"] > 1e5
    if case == "constant":
        assert model.fitted["coef_um_per_K"][3] == 0 and model.fitted["condition"] < 1e4


def test_more_inputs_than_rows_still_fits():
    rng = np.random.default_rng(5)
    design = make_design(x=rng.normal(size=(K * N, 2 * N)))
    y = design.stacked([4])[1]
    near(published(MLR, design, [4])[4 * N : 5 * N], y)
    for cls in (Ridge, PCR, PCRByLeaveBatchOut, PLS):
        assert np.isfinite(published(cls, design, [4])).all()


@pytest.mark.parametrize("doubled", [False, True])
def test_pcr_with_all_components_is_the_least_squares_of_minimum_norm(doubled):
    x = make_design().x.copy()
    if doubled:
        x[:, 3] = x[:, 2]
    design = make_design(x=x)
    for fold, model in zip(FOLDS, PCR(contribution=1.0).as_published().fit_folds(design, FOLDS), strict=True):
        near(predicted(model, design), direct(design, fold))
        near(model.fitted["coef_um_per_K"], least_squares(design, fold), rtol=1e-8 if doubled else 1e-6)
        assert model.fitted["n_components"] == P - doubled


def test_pcr_by_hand():
    # Two uncorrelated inputs of variance 8 and 2: contributions 0.8 and 0.2; y = 3 x1 + 5 x2 + 7.
    x = np.array([[4, 2], [4, -2], [-4, 2], [-4, -2]]) * np.sqrt([0.5, 0.5]) + [10.0, 20.0]
    design = stack(x, x @ [3.0, 5.0] + 7, [4])
    one, two = (PCR(share).as_published().fit_design(design, [0]).fitted for share in (0.79, 0.81))
    np.testing.assert_allclose(one["coef_um_per_K"], [3, 0], atol=1e-12)
    assert one["intercept_um"] == pytest.approx(5 * 20 + 7)  # the dropped input rests at its mean
    assert (one["n_components"], one["contribution"]) == (1, pytest.approx(0.8))
    np.testing.assert_allclose(two["coef_um_per_K"], [3, 5], atol=1e-12)
    assert (two["n_components"], two["intercept_um"]) == (2, pytest.approx(7))


def test_pcr_keeps_the_components_of_the_raw_covariance_to_95_percent():
    design = make_design(seed=1)
    for fold, model in zip(FOLDS, PCR(0.999).as_published().fit_folds(design, FOLDS), strict=True):
        X, y, _ = design.stacked(fold)
        values, vectors = np.linalg.eigh(np.cov(X.T))
        values, vectors = values[::-1], vectors[:, ::-1]
        n = int(np.argmax(np.cumsum(values) / values.sum() >= 0.999)) + 1
        scores = LinearRegression().fit((X - X.mean(0)) @ vectors[:, :n], y)
        assert model.fitted["n_components"] == n
        near(predicted(model, design), scores.predict((design.x - X.mean(0)) @ vectors[:, :n]))
    assert PCR().as_published().fit_design(design, FOLDS[0]).fitted["contribution"] >= 0.95


class Components:
    """Least squares on the first n principal components."""

    def __init__(self, n):
        self.n = n

    def fit(self, X, y):
        self.mean = X.mean(0)
        self.v = np.linalg.svd(X - self.mean, full_matrices=False)[2][: self.n].T
        self.regression = LinearRegression().fit((X - self.mean) @ self.v, y)
        return self

    def predict(self, X):
        return self.regression.predict((X - self.mean) @ self.v)


def ridge_of(k):
    return lambda X, y: SkRidge(alpha=k * ((X - X.mean(0)) ** 2).sum() / P, solver="svd").fit(X, y)


def pls_of(n):
    return lambda X, y: PLSRegression(n, scale=False).fit(X, y)


@pytest.mark.parametrize("fold", [FOLDS[0], FOLDS[3], [2], [0, 3], [1, 2, 5]])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(("cls", "setting", "values", "maker"), [
    (Ridge, "k", np.geomspace(1e2, 1e-6, 25), ridge_of),
    (PLS, "n_components", range(1, P + 1), pls_of),
    (PCRByLeaveBatchOut, "n_components", range(1, P + 1), lambda n: Components(n).fit),
])  # fmt: skip
def test_a_tuned_family_is_the_library_at_the_setting_of_a_plain_loop(cls, setting, values, maker, seed, fold):
    design = make_design(seed)
    best = values[brute_choice(design, fold, [maker(v) for v in values])]
    model = cls().as_published().fit_design(design, fold)
    assert model.fitted[setting] == pytest.approx(best)
    near(predicted(model, design), np.ravel(maker(best)(*design.stacked(fold)[:2]).predict(design.x)))


def test_a_driver_in_rpm_among_the_inputs_makes_ridge_scale_by_the_training_std():
    x = make_design().x.copy()
    x[:, 5] = np.repeat(np.random.default_rng(7).choice([2000.0, 4000.0, 6000.0], K * 2), N // 2)
    design = make_design(x=x, units=("K",) * 5 + ("rpm",))
    for fold in (FOLDS[0], [2], [0, 3]):
        model = Ridge().as_published().fit_design(design, fold)
        X, y, _ = design.stacked(fold)
        same = make_pipeline(StandardScaler(), SkRidge(alpha=model.fitted["alpha"], solver="svd")).fit(X, y)
        near(predicted(model, design), same.predict(design.x))
    for cls in EVERY:  # rev/s instead of rpm is the same machine
        other = make_design(x=x / [1, 1, 1, 1, 1, 60], units=("K",) * 5 + ("Hz",))
        near(published(cls, other, FOLDS[0]), published(cls, design, FOLDS[0]))


@pytest.mark.parametrize("cls", LINEAR)
def test_a_shifted_or_stretched_error_gives_a_shifted_or_stretched_prediction(cls):
    design = make_design(1)
    base = published(cls, design, FOLDS[2])
    near(published(cls, make_design(1, y_um=design.y_um + 50), FOLDS[2]), base + 50)
    near(published(cls, make_design(1, y_um=design.y_um * -3), FOLDS[2]), base * -3)


@pytest.mark.parametrize("cls", EVERY)
def test_a_subset_of_the_design_is_a_design_of_its_own(cls):
    design = make_design(4)
    sub, own = design.subset(("t4", "t1")), make_design(4, x=design.x[:, [4, 1]])
    for fold in (FOLDS[1], [6]):
        near(published(cls, sub, fold), published(cls, own, fold))


@pytest.mark.parametrize("cls", EVERY)
def test_rows_with_a_hole_are_left_out_of_the_fit_and_stay_holes_in_the_prediction(cls):
    design = make_design(5)
    x, y_um = design.x.copy(), design.y_um.copy()
    x[5:9, 2], y_um[70:80] = np.nan, np.nan
    holed = make_design(5, x=x, y_um=y_um)
    keep = holed.usable
    cut = stack(x[keep], y_um[keep], [keep[design.rows(k)].sum() for k in range(K)])
    for fold in ([0, 1, 2, 3], [0]):
        p = published(cls, holed, fold)
        near(p[keep], published(cls, cut, fold))
        assert np.flatnonzero(np.isnan(p)).tolist() == [5, 6, 7, 8]


@pytest.mark.parametrize("cls", LINEAR)
def test_an_error_that_never_moves_or_inputs_that_never_move_give_the_mean(cls):
    flat = make_design(y_um=np.full(K * N, 3.5))
    near(published(cls, flat, FOLDS[0]), np.full(K * N, 3.5))
    still = make_design(x=np.full((K * N, P), 21.7))
    near(published(cls, still, FOLDS[0]), np.full(K * N, still.stacked(FOLDS[0])[1].mean()))


def test_chunked_and_whole_choice_agree(monkeypatch):
    design = make_design(6)
    whole = PLS().as_published().fit_folds(design, FOLDS)
    monkeypatch.setattr("models.numerics.pooled_sums.AT_ONCE", 5 * P * P)
    for one, other in zip(whole, PLS().as_published().fit_folds(design, FOLDS), strict=True):
        assert one.fitted["n_components"] == other.fitted["n_components"]
        near(one.fitted["coef_um_per_K"], other.fitted["coef_um_per_K"])


@pytest.mark.parametrize("cls", EVERY)
def test_by_default_the_fit_has_no_intercept_and_its_inputs_begin_at_zero(cls):
    """Absolute temperatures: what counts is the rise since the start, in the fit and in the prediction."""
    design = make_design(5)
    rises = design.x - np.repeat(design.x[design.offsets[:-1]], N, axis=0)
    other = make_design(5, x=rises + np.repeat(np.arange(K) * 3.0, N)[:, None], y_um=design.y_um)
    for fold in (FOLDS[0], FOLDS[-1], [4]):
        model = cls().fit_design(other, fold)
        assert model.fitted["intercept_um"] == 0.0
        got = predicted(model, other)
        assert (got[other.offsets[:-1]] == 0.0).all()
        near(got, rises @ model.fitted["coef_um_per_K"])
    if cls is MLR:
        rows = np.concatenate([np.arange(N) + N * k for k in fold])
        near(got, rises @ np.linalg.lstsq(rises[rows], design.y_um[rows], rcond=None)[0], rtol=1e-5)


def test_pcr_counts_components_by_the_covariance_about_the_mean():
    """A common rise dominates sums about the start, not the covariance that the 95 % refer to."""
    design = make_design(6)
    free, zero = PCR().as_published().fit_design(design, FOLDS[0]), PCR().fit_design(design, FOLDS[0])
    assert zero.fitted["n_components"] == free.fitted["n_components"]
    assert zero.fitted["contribution"] == pytest.approx(free.fitted["contribution"], rel=0.05)
