"""LS-SVM against its bordered system, kernel ridge, and brute-force refits."""

from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from features.design import Design
from models.families.lssvm import LSSVM
from models.numerics import kernels as bordered
from models.numerics.kernels import Bordered, Kernel, kernel
from tests.toys.runs import walks

SIZES = (14, 9, 12, 11, 13)
SMALL = {"sigmas": (0.5, 2.0), "gammas": (1.0, 100.0)}


def solved(omega, y, gamma):
    """α and b by a plain solve of the bordered system."""
    n = len(y)
    matrix = np.zeros((n + 1, n + 1))
    matrix[0, 1:] = matrix[1:, 0] = 1.0
    matrix[1:, 1:] = omega + np.eye(n) / gamma
    solution = np.linalg.solve(matrix, np.concatenate([[0.0], y]))
    return solution[1:], solution[0]


@pytest.mark.parametrize("linear", [True, False])
def test_is_the_bordered_system(linear):
    design = walks()
    model = LSSVM(linear=linear, sigmas=(1.0,), gammas=(50.0,)).as_published().fit_design(design, [0, 1, 2])
    u, y = design.x[:35] / 10.0, design.y_um[:35]
    square = ((u[:, None] - u[None]) ** 2).sum(axis=2)
    omega = np.exp(-square / (2 * 2 * 1.0**2)) + linear * 10.0 * (u @ u.T) / 2
    alpha, bias = solved(omega, y, 50.0)
    np.testing.assert_allclose(model.fitted["alpha"], alpha, atol=1e-8)
    assert model.fitted["bias"] == pytest.approx(bias, abs=1e-8)
    assert model.fitted["alpha"].sum() == pytest.approx(0.0, abs=1e-8)


def padded(seed=2, sigma=0.7, sizes=SIZES):
    """Five groups of unlike size in one frame of equal ones: kernel, y, known, group of every place, rows per group."""
    design, m = walks(seed, sizes), max(sizes)
    u, y, known = np.zeros((5 * m, 2)), np.zeros(5 * m), np.zeros(5 * m)
    for k in range(5):
        places = slice(k * m, k * m + sizes[k])
        u[places], y[places], known[places] = design.x[design.rows(k)] / 10.0, design.y_um[design.rows(k)], 1.0
    return kernel(u, u, sigma, True) * np.outer(known, known), y, known, np.repeat(np.arange(5), m), m


def system_of(omega, y, known, gamma):
    return Bordered.of([Kernel(omega)], known[None], y[None], gamma)


@pytest.mark.parametrize("sizes", [SIZES, (60, 40, 50, 55, 60)])
def test_left_out_residuals_are_those_of_refits(sizes):
    omega, y, known, group, m = padded(sizes=sizes)
    system = system_of(omega, y, known, 30.0)
    one, two = system.left_out(m)[0], system.others_left_out(m, np.arange(5)[:, None])
    alpha, bias = system.solutions(m, np.arange(5)[:, None])
    for f in range(5):
        for g in range(5):
            train = np.flatnonzero((known > 0) & (group != f) & (group != g))
            a, b = solved(omega[np.ix_(train, train)], y[train], 30.0)
            test = np.flatnonzero((known > 0) & (group == g))
            got = (one[g] if f == g else two[f, g])[: len(test)]
            np.testing.assert_allclose(got, y[test] - omega[np.ix_(test, train)] @ a - b, atol=1e-7)
            if f == g:
                np.testing.assert_allclose(alpha[f, train], a, atol=1e-7)
                assert bias[f] == pytest.approx(b, abs=1e-7)
                assert not alpha[f, np.setdiff1d(np.arange(len(y)), train)].any()


@pytest.mark.parametrize("gaps", [[[1], [0, 3]], [[0, 1, 2]]])
def test_residuals_without_several_groups_are_those_of_refits(gaps):
    omega, y, known, group, m = padded()
    system = system_of(omega, y, known, 30.0)
    found = system.others_left_out(m, [np.array(gap) for gap in gaps])
    for gap, residual in zip(gaps, found, strict=True):
        assert np.isnan(residual[gap]).all()
        alpha, bias = system.solutions(m, np.array([gap]))
        for g in np.setdiff1d(np.arange(5), gap):
            train = np.flatnonzero((known > 0) & ~np.isin(group, [*gap, g]))
            a, b = solved(omega[np.ix_(train, train)], y[train], 30.0)
            test = np.flatnonzero((known > 0) & (group == g))
            np.testing.assert_allclose(
                residual[g][: len(test)], y[test] - omega[np.ix_(test, train)] @ a - b, atol=1e-7
            )
        kept = np.flatnonzero((known > 0) & ~np.isin(group, gap))
        a, b = solved(omega[np.ix_(kept, kept)], y[kept], 30.0)
        np.testing.assert_allclose(alpha[0, kept], a, atol=1e-7)
        assert bias[0] == pytest.approx(b, abs=1e-7)


def test_a_kernel_of_low_rank_takes_the_short_way_to_the_same_inverse(monkeypatch):
    omega, y, known, _, m = padded(sizes=(60, 40, 50, 55, 60), sigma=3.0)
    thin = Kernel(omega)
    assert thin.thin is not None and thin.thin.shape[1] < 100
    np.testing.assert_allclose(thin.thin @ thin.thin.T, omega, atol=1e-11)
    monkeypatch.setattr(bordered, "_THIN_FROM_ROWS", 10**9)
    full = Kernel(omega)
    assert full.thin is None
    np.testing.assert_allclose(thin.inverse(100.0), full.inverse(100.0), atol=1e-7)
    short, long = (Bordered.of([k], known[None], y[None], 1e4) for k in (thin, full))
    each = np.arange(5)[:, None]
    np.testing.assert_allclose(short.others_left_out(m, each), long.others_left_out(m, each), atol=1e-6)
    np.testing.assert_allclose(short.solutions(m)[0] @ omega, long.solutions(m)[0] @ omega, atol=1e-7)


def test_a_system_beyond_floating_point_is_nan_and_its_neighbours_are_not():
    omega, y, known, _, m = padded()
    bad = -np.eye(len(y))
    with np.errstate(all="ignore"):
        system = Bordered.of([Kernel(bad), Kernel(omega)], np.stack([known] * 2), np.stack([y] * 2), 30.0)
    assert np.isnan(system.left_out(m)[0]).all()
    np.testing.assert_array_equal(system.left_out(m)[1], system_of(omega, y, known, 30.0).left_out(m)[0])


def brute_force(design, train, sigmas, gammas):
    """γ, σ by refitting once per inner batch, then the model on the whole training part."""
    batch = design.group
    best = (np.inf, 0.0, 0.0)
    for sigma in sigmas:
        omega = kernel(design.x / 10.0, design.x / 10.0, sigma, True)
        for gamma in gammas:
            rms = []
            for k in train:
                rest, test = np.isin(batch, [j for j in train if j != k]), batch == k
                a, b = solved(omega[np.ix_(rest, rest)], design.y_um[rest], gamma)
                rms.append(np.sqrt(np.mean((design.y_um[test] - omega[np.ix_(test, rest)] @ a - b) ** 2)))
            best = min(best, (float(np.mean(rms)), sigma, gamma))
    return best


def test_nested_choice_is_the_brute_force_choice():
    design = walks(3)
    folds = [[j for j in range(5) if j != k] for k in range(5)]
    sigmas, gammas = (0.3, 1.0, 3.0), (1.0, 30.0, 1000.0)
    models = LSSVM(sigmas=sigmas, gammas=gammas).as_published().fit_folds(design, folds)
    for fold, model in zip(folds, models, strict=True):
        score, sigma, gamma = brute_force(design, fold, sigmas, gammas)
        assert (model.fitted["sigma"], model.fitted["gamma"]) == (sigma, gamma)
        assert model.fitted["inner_rms_um"] == pytest.approx(score, rel=1e-6)


@pytest.mark.parametrize("fold", [[0, 1, 2, 3], [4]])
def test_the_swarm_finds_at_least_what_the_grid_finds_and_its_score_is_that_of_refits(fold):
    design = walks(10)
    options = {"sigmas": (0.3, 1.0, 3.0), "gammas": (1.0, 30.0, 1000.0)}
    grid = LSSVM(**options).as_published().fit_design(design, fold).fitted
    swarm = LSSVM(**options, tuning="particle_swarm").as_published().fit_design(design, fold)
    assert swarm.fitted["inner_rms_um"] < grid["inner_rms_um"] * 1.001
    assert 0.3 <= swarm.fitted["sigma"] <= 3.0 and 1.0 <= swarm.fitted["gamma"] <= 1000.0
    if len(fold) > 1:
        score, _, _ = brute_force(design, fold, [swarm.fitted["sigma"]], [swarm.fitted["gamma"]])
        assert swarm.fitted["inner_rms_um"] == pytest.approx(score, rel=1e-6)
    again = LSSVM(**options, tuning="particle_swarm").as_published().fit_folds(design, [fold, [0, 1]])[0]
    np.testing.assert_array_equal(again.fitted["alpha"], swarm.fitted["alpha"])


def test_the_linear_part_goes_on_where_the_rbf_falls_back_to_its_bias():
    x = np.linspace(0, 10, 60)[:, None]
    far = np.linspace(60, 70, 5)[:, None]
    rows, y = np.vstack([x, far]), np.concatenate([4 * x[:, 0], 4 * far[:, 0]])
    design = Design(("t",), "z", ("near", "far"), rows, y, np.arange(65.0), np.array([0, 60, 65]), 1.0)
    options = {"sigmas": (0.3,), "gammas": (1e4,)}
    with_line = LSSVM(linear=True, **options).as_published().fit_design(design, [0])
    without = LSSVM(linear=False, **options).as_published().fit_design(design, [0])
    np.testing.assert_allclose(with_line.predict_design(design, [1])[0], y[60:], rtol=0.1)
    np.testing.assert_allclose(without.predict_design(design, [1])[0], without.fitted["bias"], atol=1e-3)


def test_units_have_their_own_scale():
    design = walks(6, units=("rpm", "K"))
    np.testing.assert_array_equal(
        LSSVM(**SMALL).as_published().fit_design(design, [0, 1]).fitted["scale"], [1000.0, 10.0]
    )


def test_missing_rows_train_nothing_and_predict_nan():
    design = walks(7)
    x, y = design.x.copy(), design.y_um.copy()
    x[3, 0] = np.nan
    y[20] = np.nan
    holed = replace(design, x=x, y_um=y)
    model = LSSVM(**SMALL).as_published().fit_design(holed, range(5))
    assert len(model.fitted["alpha"]) == sum(SIZES) - 2
    assert np.isfinite(model.fitted["alpha"]).all()
    assert np.flatnonzero(np.isnan(np.concatenate(model.predict_design(holed, range(5))))).tolist() == [3]


def test_inputs_beyond_any_scale_are_refused_in_words():
    design = walks(9)
    huge = replace(design, x=design.x * 1e12)
    with pytest.raises(InputError, match=r"no gamma of .* check their units"):
        LSSVM().as_published().fit_design(huge, range(5))


@pytest.mark.parametrize("linear", [True, False])
def test_from_the_start_it_is_kernel_ridge_without_a_bias(linear):
    design = walks()
    f = LSSVM(linear=linear, sigmas=(1.0,), gammas=(50.0,)).fit_design(design, [0, 1, 2]).fitted
    u, y = design.started.x[:35] / 10.0, design.y_um[:35]
    origin = np.zeros((1, 2))
    omega = kernel(u, u, 1.0, linear) - kernel(u, origin, 1.0, linear) - kernel(origin, u, 1.0, linear) + 1.0
    alpha = np.linalg.solve(omega + np.eye(35) / 50.0, y)
    np.testing.assert_allclose(f["alpha"], [*alpha, -alpha.sum()], atol=1e-6)
    np.testing.assert_array_equal(f["support"][-1], 0.0)
    assert f["bias"] == 0.0
