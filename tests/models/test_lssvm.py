"""LS-SVM against its bordered system, kernel ridge, and brute-force refits."""

import numpy as np
import pytest
from sklearn.kernel_ridge import KernelRidge

from data.errors import InputError
from features.design import Design
from models.bordered import bordered_inverse, left_out
from models.lssvm import LSSVM, kernel

SIZES = (14, 9, 12, 11, 13)
SMALL = {"sigmas": (0.5, 2.0), "gammas": (1.0, 100.0)}


def make_design(seed=0, sizes=SIZES, p=2, units=()) -> Design:
    rng = np.random.default_rng(seed)
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    x = np.vstack([np.cumsum(rng.uniform(0, 2, (n, p)), axis=0) for n in sizes])
    y = 3 * x[:, 0] - 2 * x[:, -1] + 8 * np.sin(x[:, 0] / 8) + rng.normal(0, 0.5, len(x))
    time_s = np.concatenate([np.arange(n) * 60.0 for n in sizes])
    names = tuple(f"t{j}" for j in range(p))
    return Design(names, "z", tuple(f"K{k + 1}" for k in range(len(sizes))), x, y, time_s, offsets, 60.0,
                  input_units=units)  # fmt: skip


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
    design = make_design()
    model = LSSVM(linear=linear, sigmas=(1.0,), gammas=(50.0,)).fit_design(design, [0, 1, 2])
    u, y = design.x[:35] / 10.0, design.y_um[:35]
    square = ((u[:, None] - u[None]) ** 2).sum(axis=2)
    omega = np.exp(-square / (2 * 2 * 1.0**2)) + linear * 10.0 * (u @ u.T) / 2
    alpha, bias = solved(omega, y, 50.0)
    np.testing.assert_allclose(model.fitted["alpha"], alpha, atol=1e-8)
    assert model.fitted["bias"] == pytest.approx(bias, abs=1e-8)
    assert model.fitted["alpha"].sum() == pytest.approx(0.0, abs=1e-8)


def test_is_kernel_ridge_with_a_free_bias():
    design = make_design(1)
    model = LSSVM(sigmas=(1.0,), gammas=(20.0,)).fit_design(design, range(5))
    u, y, n = design.x / 10.0, design.y_um, len(design.y_um)
    omega = kernel(u, u, 1.0, True)
    centre = np.eye(n) - 1.0 / n
    # A free bias is the same as centring features and target: both leave α = γ e.
    ridge = KernelRidge(alpha=1 / 20.0, kernel="precomputed").fit(centre @ omega @ centre, y - y.mean())
    np.testing.assert_allclose(model.fitted["alpha"], ridge.dual_coef_, atol=1e-7)
    fit = ridge.predict(centre @ omega @ centre) + y.mean()
    np.testing.assert_allclose(np.concatenate(model.predict_design(design, range(5))), fit, atol=1e-7)


def test_left_out_residuals_are_those_of_refits():
    design = make_design(2)
    u, y, batch = design.x / 10.0, design.y_um, design.group
    omega = kernel(u, u, 0.7, True)
    inverse, ones = bordered_inverse(omega, 30.0)
    groups = np.full((5, max(SIZES)), -1)
    for k in range(5):
        groups[k, : SIZES[k]] = np.flatnonzero(batch == k)
    outs = np.full((2, 25), -1)
    outs[0, : SIZES[3]] = np.flatnonzero(batch == 3)
    both = np.flatnonzero((batch == 1) | (batch == 4))
    outs[1, : len(both)] = both
    member = np.array([[True, True, True, False, True], [True, False, True, True, False]])
    score, alpha, bias, inside = left_out(inverse, ones, y, groups, member, outs)
    for f in range(2):
        train = np.flatnonzero(member[f][batch])
        np.testing.assert_array_equal(inside[f], member[f][batch])
        want, b = solved(omega[np.ix_(train, train)], y[train], 30.0)
        np.testing.assert_allclose(alpha[f, train], want, atol=1e-7)
        assert bias[f] == pytest.approx(b, abs=1e-7)
        rms = []
        for k in np.flatnonzero(member[f]):
            rest, test = train[batch[train] != k], train[batch[train] == k]
            a, b = solved(omega[np.ix_(rest, rest)], y[rest], 30.0)
            rms.append(np.sqrt(np.mean((y[test] - omega[np.ix_(test, rest)] @ a - b) ** 2)))
        assert score[f] == pytest.approx(np.mean(rms), rel=1e-7)


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
    design = make_design(3)
    folds = [[j for j in range(5) if j != k] for k in range(5)]
    sigmas, gammas = (0.3, 1.0, 3.0), (1.0, 30.0, 1000.0)
    models = LSSVM(sigmas=sigmas, gammas=gammas).fit_folds(design, folds)
    for fold, model in zip(folds, models, strict=True):
        score, sigma, gamma = brute_force(design, fold, sigmas, gammas)
        assert (model.fitted["sigma"], model.fitted["gamma"]) == (sigma, gamma)
        assert model.fitted["inner_rms_um"] == pytest.approx(score, rel=1e-6)


@pytest.mark.parametrize("max_rows", [480, 45])
def test_folds_at_once_are_the_folds_alone(max_rows):
    design = make_design(4, sizes=(14, 9, 12, 11, 13, 10))
    folds = [[1, 2, 3, 4, 5], [0, 1, 2, 4, 5], [0, 2, 3, 5], [4], [1, 2], [0, 1, 2, 3, 4, 5]]
    family = LSSVM(max_rows=max_rows, **SMALL)
    together = family.fit_folds(design, folds)
    everything = range(6)
    columns = family.predict_folds(design, together)
    for f, (fold, model) in enumerate(zip(folds, together, strict=True)):
        alone = family.fit_design(design, fold)
        assert alone.fitted["gamma"] == model.fitted["gamma"] and alone.fitted["sigma"] == model.fitted["sigma"]
        want = np.concatenate(alone.predict_design(design, everything))
        np.testing.assert_allclose(np.concatenate(model.predict_design(design, everything)), want, atol=1e-8)
        np.testing.assert_allclose(columns[:, f], want, atol=1e-8)
        assert len(model.fitted["alpha"]) <= max(max_rows, 8 * len(fold))


def test_left_out_batch_changes_nothing():
    design = make_design(5)
    other = Design(design.inputs, "z", design.batch_ids, design.x, np.where(design.group == 2, 99.0, design.y_um),
                   design.time_s, design.offsets, 60.0)  # fmt: skip
    folds = [[0, 1, 3, 4], [0, 1, 2, 3]]
    a, b = (LSSVM(**SMALL).fit_folds(d, folds)[0] for d in (design, other))
    np.testing.assert_allclose(a.predict_design(design, [2])[0], b.predict_design(design, [2])[0], atol=1e-7)


def test_the_linear_part_goes_on_where_the_rbf_falls_back_to_its_bias():
    x = np.linspace(0, 10, 60)[:, None]
    far = np.linspace(60, 70, 5)[:, None]
    rows, y = np.vstack([x, far]), np.concatenate([4 * x[:, 0], 4 * far[:, 0]])
    design = Design(("t",), "z", ("near", "far"), rows, y, np.arange(65.0), np.array([0, 60, 65]), 1.0)
    options = {"sigmas": (0.3,), "gammas": (1e4,)}
    with_line = LSSVM(linear=True, **options).fit_design(design, [0])
    without = LSSVM(linear=False, **options).fit_design(design, [0])
    np.testing.assert_allclose(with_line.predict_design(design, [1])[0], y[60:], rtol=0.1)
    np.testing.assert_allclose(without.predict_design(design, [1])[0], without.fitted["bias"], atol=1e-3)


def test_units_have_their_own_scale():
    design = make_design(6, units=("rpm", "K"))
    np.testing.assert_array_equal(LSSVM(**SMALL).fit_design(design, [0, 1]).fitted["scale"], [1000.0, 10.0])


def test_missing_rows_train_nothing_and_predict_nan():
    design = make_design(7)
    x, y = design.x.copy(), design.y_um.copy()
    x[3, 0] = np.nan
    y[20] = np.nan
    holed = Design(design.inputs, "z", design.batch_ids, x, y, design.time_s, design.offsets, 60.0)
    model = LSSVM(**SMALL).fit_design(holed, range(5))
    assert len(model.fitted["alpha"]) == sum(SIZES) - 2
    assert np.isfinite(model.fitted["alpha"]).all()
    assert np.flatnonzero(np.isnan(np.concatenate(model.predict_design(holed, range(5))))).tolist() == [3]


def test_too_few_rows_in_words():
    design = make_design(8)
    empty = Design(design.inputs, "z", design.batch_ids, design.x, np.full(len(design.x), np.nan), design.time_s,
                   design.offsets, 60.0)  # fmt: skip
    with pytest.raises(InputError, match="family lssvm: got 0 usable rows of z in K2, K3, need at least 2"):
        LSSVM().fit_design(empty, [1, 2])


def test_inputs_beyond_any_scale_are_refused_in_words():
    design = make_design(9)
    huge = Design(design.inputs, "z", design.batch_ids, design.x * 1e12, design.y_um, design.time_s, design.offsets,
                  60.0)  # fmt: skip
    with pytest.raises(InputError, match=r"no gamma of .* check their units"):
        LSSVM().fit_design(huge, range(5))
