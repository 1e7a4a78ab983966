"""The Gaussian process against scikit-learn's, refits without the left-out rows, and planted scatter of batches."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel

from data.errors import InputError
from models.families import gaussian_process
from models.families.gaussian_process import OWN_LINES, GaussianProcess, Line, Setting, _Problem
from models.numerics.batch_process import LeftOut
from models.numerics.kernels import products
from tests.toys.runs import warm_ups

OWN_SLOPE_UM_PER_K = 0.25


def covariance(u, group, setting):
    dot = products(u, u)[1]
    return setting.shared(u, u, free=True) + (group[:, None] == group) * setting.own(dot) + np.eye(len(u))


def test_without_batches_of_their_own_it_is_scikit_learns(monkeypatch):
    monkeypatch.setattr(Setting, "own", lambda self, dot: np.zeros_like(dot))
    design, setting = warm_ups(3, 20, curve_um=4.0), Setting(100.0, 30.0, 0.7, 0.0)
    model = GaussianProcess().as_published()._made(design, np.arange(60), setting, 1.0)
    # |u|²/p in the line and 2 p length² below the exponent: scikit-learn's with scaled variances and lengths.
    kernel = (
        ConstantKernel(30.0) * RBF(0.7 * np.sqrt(2))
        + ConstantKernel(50.0) * DotProduct(0.0, "fixed")
        + ConstantKernel(1.0)
    )
    theirs = GaussianProcessRegressor(kernel + WhiteKernel(1.0), optimizer=None, alpha=0.0).fit(
        design.x / 10, design.y_um
    )
    far = replace(design, x=design.x * 1.5 + 2)
    mean, sd = theirs.predict(far.x[:20] / 10, return_std=True)
    np.testing.assert_allclose(model.predict_design(far, [0])[0], mean, rtol=1e-6)
    np.testing.assert_allclose(model.sd_um(far, [0])[0], sd, rtol=1e-6)


def test_left_out_groups_are_those_of_refits():
    design, setting = warm_ups(5, 7, curve_um=3.0), Setting(1e3, 10.0, 1.0, 0.3)
    u, y, group = design.x / 10, design.y_um, design.group
    whole = covariance(u, group, setting)
    left = LeftOut.of(np.linalg.inv(whole), y, 7)
    for f in (None, 1):
        error, variance = left.alone() if f is None else left.without(f)
        for g in (0, 3):
            train, test = (group != g) & (group != f) if f is not None else group != g, group == g
            weight = whole[np.ix_(test, train)] @ np.linalg.inv(whole[np.ix_(train, train)])
            np.testing.assert_allclose(error[g], y[test] - weight @ y[train], atol=1e-7)
            told = whole[np.ix_(test, test)] - weight @ whole[np.ix_(train, test)]
            np.testing.assert_allclose(variance[g], np.diag(told), rtol=1e-7)


def test_the_choice_is_that_of_refits_done_one_by_one(monkeypatch):
    monkeypatch.setattr(gaussian_process, "LINES", (1e2, 1e4))
    monkeypatch.setattr(gaussian_process, "CURVES", (0.0, 10.0))
    monkeypatch.setattr(gaussian_process, "LENGTHS", (1.0,))
    monkeypatch.setattr(gaussian_process, "OWN_LINES", (0.1,))
    design = warm_ups(6, 12, seed=3, curve_um=5.0)
    folds = [[j for j in range(6) if j != k] for k in range(6)]
    for fold, model in zip(folds, GaussianProcess().as_published().fit_folds(design, folds), strict=True):
        scores = {}
        for line in (1e2, 1e4):
            for curve in (0.0, 10.0):
                setting, rms = Setting(line, curve, 1.0, 0.1), []
                for g in fold:
                    train, test = np.isin(design.group, [j for j in fold if j != g]), design.group == g
                    k = covariance(design.x / 10, design.group, setting)
                    error = design.y_um[test] - k[np.ix_(test, train)] @ np.linalg.solve(
                        k[np.ix_(train, train)], design.y_um[train]
                    )
                    rms.append(np.sqrt(np.mean(error**2)))
                scores[setting] = np.mean(rms)
        # One after the other from the start: the line at curve 0, then the curve, then the line again.
        line = min((1e2, 1e4), key=lambda v: scores[Setting(v, 0.0, 1.0, 0.1)])
        curve = min((0.0, 10.0), key=lambda v: scores[Setting(line, v, 1.0, 0.1)])
        line = min((1e2, 1e4), key=lambda v: scores[Setting(v, curve, 1.0, 0.1)])
        assert (model.fitted["line"], model.fitted["curve"]) == (line, curve)


def test_a_curve_is_learned_and_far_from_all_rows_it_says_so():
    design = warm_ups(10, 30, curve_um=6.0)
    model = GaussianProcess().as_published().fit_design(design, range(9))
    assert model.fitted["curve"] > 0
    assert np.std(model.predict_design(design, [9])[0] - design.y_um[design.rows(9)]) < 1.0
    far = replace(design, x=design.x * 4)
    assert model.sd_um(far, [9])[0][-1] > 3 * model.sd_um(design, [9])[0][-1]


def test_rows_are_drawn_evenly_and_holes_stay_holes():
    design = warm_ups(6, 100)
    x = design.x.copy()
    x[5, 0] = np.nan
    holed = replace(design, x=x)
    model = GaussianProcess(max_rows=60).as_published().fit_design(holed, range(6))
    assert len(model.fitted["alpha"]) == 60 and model.fitted["factor"].shape == (60, 60)
    assert np.flatnonzero(np.isnan(model.predict_design(holed, [0])[0])).tolist() == [5]
    assert np.flatnonzero(np.isnan(model.sd_um(holed, [0])[0])).tolist() == [5]


def test_what_cannot_be_learned_from_is_told():
    design = warm_ups(3)
    with pytest.raises(InputError, match=r"inputs reach 2e\+07 times their scale, expected about 1: check their units"):
        GaussianProcess().as_published().fit_design(replace(design, x=np.full_like(design.x, 2e8)), range(3))


@pytest.mark.parametrize("own_line", OWN_LINES)
@pytest.mark.parametrize("as_published", [False, True])
def test_a_line_left_out_by_sums_is_what_the_whole_covariance_leaves_out(own_line: float, as_published: bool) -> None:
    """Groups of different sizes, so that there is padding; each alone, and with another."""
    design = warm_ups(4, own_slope=OWN_SLOPE_UM_PER_K)
    design = design if as_published else design.started
    rows = np.setdiff1d(np.arange(120), [3, 40, 41, 42, 100])
    by_sums, whole = (_Problem.of(design, rows, design.group[rows]) for _ in range(2))
    whole.__dict__["_lines"] = {}
    setting = Setting(line=1e3, curve=0.0, own_line=own_line)
    got, want = by_sums._left_out(setting), whole._left_out(setting)
    assert isinstance(got, Line) and isinstance(want, LeftOut)
    for f in (None, 0, 3):
        parts = zip(by_sums._residuals(got, f), whole._residuals(want, f), strict=True)
        for ours, theirs in parts:
            np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-7)
