"""Support vector regression against scikit-learn's own, the conditions of its optimum, and a law it must find."""

import numpy as np
import pytest
from sklearn.svm import SVR as LibSVR

from models.families.svr import SVR
from tests.toys.runs import walks

ONE = {"sigmas": (1.0,), "costs": (2e3,), "epsilons": (0.05,)}


def test_predicts_as_scikit_learn_with_its_own_rbf_does():
    design = walks()
    model = SVR(**ONE).as_published().fit_design(design, [0, 1, 2, 3])
    rows = design.group < 4
    u, y = design.x / 10.0, design.y_um
    mean, spread = y[rows].mean(), y[rows].std()
    # |u − v|²/(2 p σ²) with p = 2 and σ = 1 is gamma = 1/4.
    other = LibSVR(kernel="rbf", gamma=0.25, C=2e3 / rows.sum(), epsilon=0.05).fit(u[rows], (y[rows] - mean) / spread)
    want = mean + spread * other.predict(u)
    np.testing.assert_allclose(np.concatenate(model.predict_design(design, range(5))), want, atol=1e-2)
    assert model.fitted["C"] == pytest.approx(2e3 / rows.sum())
    assert abs(len(model.fitted["alpha"]) - len(other.support_)) <= 2


def test_the_choice_is_the_setting_of_least_left_out_error():
    design = walks(2, sizes=(20, 18, 22, 19, 21, 20))
    sigmas, costs, epsilons = (0.3, 1.0), (30.0, 3e3), (0.05, 0.3)
    fitted = SVR(10_000, sigmas, costs, epsilons).as_published().fit_design(design, range(6)).fitted
    u, y, group = design.x / 10.0, design.y_um, design.group % 3

    def rms(sigma, cost, epsilon):
        out = []
        for g in range(3):
            rest, left = group != g, group == g
            mean, spread = y[rest].mean(), y[rest].std()
            model = LibSVR(kernel="rbf", gamma=1 / (4 * sigma**2), C=cost / rest.sum(), epsilon=epsilon)
            model.fit(u[rest], (y[rest] - mean) / spread)
            out.append(np.sqrt(np.mean((y[left] - mean - spread * model.predict(u[left])) ** 2)))
        return np.mean(out)

    score = {(s, c): rms(s, c, 0.05) for s in sigmas for c in costs}
    sigma, cost = min(score, key=score.get)
    epsilon = min(epsilons, key=lambda e: rms(sigma, cost, e))
    assert (fitted["sigma"], fitted["C"] * fitted["n_rows"], fitted["epsilon"]) == pytest.approx((sigma, cost, epsilon))
    assert fitted["inner_rms_um"] == pytest.approx(rms(sigma, cost, epsilon), rel=1e-2)


def test_decimation_is_even_and_stated():
    design = walks(3, sizes=(40, 5, 60))
    model = SVR(30, **ONE).as_published().fit_design(design, range(3))
    assert model.fitted["n_rows"] == 10 + 5 + 10 and model.fitted["n_usable_rows"] == 105
    long = design.x[design.rows(2)] / 10.0
    kept = {tuple(row) for row in long[np.round(np.linspace(0, 59, 10)).astype(int)]}
    support = {tuple(row) for row in model.fitted["support"]}
    assert support & {tuple(row) for row in long} <= kept
