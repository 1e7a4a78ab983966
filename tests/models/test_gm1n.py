"""GM(1,N) against its own generating equation, a case worked by hand, and the published response."""

from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from features.design import Design
from models.families.gm1n import GM1N, response
from tests.toys.grey import literal_run
from tests.toys.runs import stack


def make_design(x, y, sizes, step_s=60.0) -> Design:
    y = np.asarray(y, float)
    return stack(np.asarray(x, float).reshape(len(y), -1), y, sizes, step_s=step_s)


def generated(a, b, sizes, seed=0):
    rng = np.random.default_rng(seed)
    x, y = [], []
    for n in sizes:
        one = np.cumsum(rng.uniform(0, 1, (n, len(b))), axis=0)
        one -= one[0]
        x.append(one)
        y.append(literal_run(one, a, np.array(b)))
    return make_design(np.vstack(x), np.concatenate(y), sizes)


@pytest.mark.parametrize("a", [0.02, 0.3, 1.8])
def test_recovers_a_and_b_from_its_own_equation(a):
    b = [1.5, -0.7]
    design = generated(a, b, [40, 25, 30])
    model = GM1N().fit_design(design, [0, 1])
    assert model.fitted["bound"] == "none"
    assert model.fitted["a"] == pytest.approx(a, rel=1e-6)
    np.testing.assert_allclose(model.fitted["b"], b, rtol=1e-6)
    np.testing.assert_allclose(model.predict_design(design, [2])[0], design.y_um[design.rows(2)], atol=1e-6)


def test_a_case_worked_by_hand():
    # x2 = 0, 1, 1, 1 and a = 2, b = 4: (1 + a/2) x1(k) = 4 S(k) − 2 X1(k−1), so x1 = 0, 2, 2, 2.
    design = make_design([0, 1, 1, 1], [0, 2, 2, 2], [4])
    model = GM1N().fit_design(design, [0])
    # By hand: z = 1, 3, 5 and x2¹ = 1, 2, 3: normal equations [[35, -22], [-22, 14]] (a, b) = (-18, 12).
    np.testing.assert_allclose(np.linalg.solve([[35, -22], [-22, 14]], [-18, 12]), [2, 4])
    assert model.fitted["a"] == pytest.approx(2.0) and model.fitted["b"][0] == pytest.approx(4.0)
    np.testing.assert_allclose(model.predict_design(design, [0])[0], [0, 2, 2, 2], atol=1e-9)


def test_difference_response_is_the_recursion_on_sums():
    rng = np.random.default_rng(1)
    x, b = rng.normal(size=(50, 3)) + 2.0, np.array([1.0, -2.0, 0.5])  # first row not zero
    for a in (0.01, 0.4, 1.9):
        np.testing.assert_allclose(response((x @ b)[None], a)[0], literal_run(x, a, b), atol=1e-9)


def test_whitening_agrees_with_difference_for_a_constant_sum_and_small_a():
    # A pulse in the first row makes the cumulated input constant: the whitening response's one premise.
    pulse = np.zeros((1, 60))
    pulse[0, 0] = 5.0
    gaps = []
    for a in (0.2, 0.1):
        gaps.append(np.abs(response(pulse, a, "whitening") - response(pulse, a)).max())
    assert gaps[0] < 5.0 * 0.2**2 / 4
    assert gaps[0] / gaps[1] == pytest.approx(4.0, rel=0.1)  # second order in a


def test_pooled_fit_is_least_squares_over_all_batches_and_folds_share_it():
    design = generated(0.2, [1.0, 0.4], [30, 20, 25, 28])
    noisy = replace(design, y_um=design.y_um + np.random.default_rng(3).normal(0, 0.2, len(design.y_um)))
    left, right = [], []
    for k in (0, 2, 3):
        x, y = noisy.x[noisy.rows(k)], noisy.y_um[noisy.rows(k)]
        sums = np.cumsum(y)
        left.append(np.column_stack([-(sums[1:] + sums[:-1]) / 2, np.cumsum(x, axis=0)[1:]]))
        right.append(y[1:])
    want = np.linalg.lstsq(np.vstack(left), np.concatenate(right), rcond=None)[0]
    together = GM1N().fit_folds(noisy, [[0, 2, 3], [1], [0, 1, 2, 3]])
    assert together[0].fitted["a"] == pytest.approx(want[0], rel=1e-8)
    np.testing.assert_allclose(together[0].fitted["b"], want[1:], rtol=1e-8)
    for fold, model in zip([[0, 2, 3], [1], [0, 1, 2, 3]], together, strict=True):
        alone = GM1N().fit_design(noisy, fold)
        np.testing.assert_allclose(model.fitted["b"], alone.fitted["b"], rtol=1e-8)
    got = together[0].predict_folds(noisy, together, [[0], [], [1]])[2][0]
    np.testing.assert_allclose(got, together[2].predict_design(noisy, [1])[0], atol=1e-9)


def test_an_exploding_a_is_bounded_and_said():
    grows = np.exp(0.1 * np.arange(40)) - 1  # its own growth explains it: least squares wants a < 0
    design = make_design(np.linspace(0, 1, 40), grows, [40])
    model = GM1N().fit_design(design, [0])
    assert model.fitted["bound"] == "lowest" and model.fitted["a"] == pytest.approx(60 / 86400)
    long = make_design(np.linspace(0, 1, 4000), np.zeros(4000), [4000])
    assert np.abs(model.predict_design(long, [0])[0]).max() < 1e4


def test_zigzag_is_bounded_above():
    x = np.tile([0.0, 1.0], 20)
    y = literal_run(x[:, None], 30.0, np.array([16.0]))
    model = GM1N().fit_design(make_design(x, y, [40]), [0])
    assert model.fitted["bound"] == "highest" and model.fitted["a"] == 2.0


def test_another_step_is_refused_with_both_named():
    model = GM1N().fit_design(generated(0.3, [1.0], [30]), [0])
    other = make_design(np.arange(10.0), np.zeros(10), [10], step_s=300.0)
    with pytest.raises(InputError, match=r"batch b0 has a step of 300 s, the model learned from 60 s"):
        model.predict_design(other, [0])


def test_training_on_two_steps_is_refused():
    design = generated(0.3, [1.0], [30, 20])
    time_s = design.time_s.copy()
    time_s[30:] *= 5
    mixed = replace(design, time_s=time_s)
    with pytest.raises(InputError, match="batch b1 has a step of 300 s, batch b0 of 60 s"):
        GM1N().fit_design(mixed, [0, 1])


def test_holes_are_bridged_and_a_missing_input_is_nan():
    design = generated(0.3, [1.0, 0.5], [60, 60, 60])
    x, y = design.x.copy(), design.y_um.copy()
    x[70:72, 0] = np.nan
    y[20:23] = np.nan
    holed = replace(design, x=x, y_um=y)
    model = GM1N().fit_design(holed, [0, 1])
    assert model.fitted["a"] == pytest.approx(0.3, rel=0.1)
    got = model.predict_design(holed, [1])[0]
    assert np.isfinite(got).all()
    assert np.abs(got - design.y_um[60:120]).max() < 0.1 * np.ptp(design.y_um[60:120])
    x[120:, 1] = np.nan
    dead = replace(design, x=x, y_um=y)
    assert np.isnan(model.predict_design(dead, [2])[0][1:]).all()
