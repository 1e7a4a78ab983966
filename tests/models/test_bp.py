"""The BP net and its trainer: gradient, optimum, bounds, seeds."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_limits

from features.design import Design
from features.levenberg_marquardt import jacobian, outputs, train
from features.nets import Nets
from models.families.bp import BP, TRANSFERS, BPLinear
from models.families.mlr import MLR
from tests.toys.runs import stack


def make_design(seed=0, sizes=(40, 25, 33, 30), p=2, law=None, ambient=None) -> Design:
    """Batches of rises; `ambient` scales each batch's rises (a cold machine rises more)."""
    rng = np.random.default_rng(seed)
    scale = np.ones(len(sizes)) if ambient is None else ambient
    x = np.vstack([s * np.cumsum(rng.uniform(0, 0.8, (n, p)), axis=0) for s, n in zip(scale, sizes, strict=True)])
    y = law(x) if law else 3 * x[:, 0] - 2 * x[:, -1] + rng.normal(0, 0.5, len(x))
    return stack(x, y, sizes, step_s=60.0)


def slopes_of(nets, x_t):
    theta, x = torch.from_numpy(nets.parameters), torch.from_numpy(x_t)
    out, hidden = outputs(theta, x, nets.n_hidden, nets.transfer)
    np.testing.assert_allclose(out.numpy(), nets.outputs(x_t), atol=1e-12)  # what is trained is what predicts
    return jacobian(theta, x, hidden, x.new_empty((*theta.shape, x.shape[2])), nets.transfer).numpy()


@pytest.mark.parametrize("transfer", TRANSFERS)
def test_jacobian_is_the_difference_quotient(transfer):
    nets = Nets.drawn(4, 3, 2, seed=1, transfer=transfer)
    x_t = np.random.default_rng(0).normal(size=(4, 3, 7))
    got = slopes_of(nets, x_t)
    assert got.shape == (4, 2 * 5 + 1, 7)
    for j in range(11):
        step = np.where(np.arange(11) == j, 1e-6, 0.0)
        ahead, behind = (
            replace(nets, parameters=nets.parameters + step),
            replace(nets, parameters=nets.parameters - step),
        )
        slope = (ahead.outputs(x_t) - behind.outputs(x_t)) / 2e-6
        np.testing.assert_allclose(got[:, j], slope, atol=1e-8)


def test_training_ends_where_the_penalised_gradient_vanishes():
    rng = np.random.default_rng(0)
    x_t, y = rng.normal(size=(2, 2, 50)), rng.normal(size=(2, 50))
    known = np.ones((2, 50))
    decay = 1e-2
    nets, steps = train(Nets.drawn(2, 2, 2, seed=0), x_t, y, known, decay, 500)
    assert (steps < 500).all()
    penalty = np.full(9, decay)
    penalty[-1] = 0.0
    gradient = (slopes_of(nets, x_t) @ (y - nets.outputs(x_t))[:, :, None])[..., 0] / 50
    np.testing.assert_allclose(gradient, penalty * nets.parameters, atol=2e-3)


def test_first_step_is_the_damped_gauss_newton_step():
    rng = np.random.default_rng(1)
    x_t, y, known = rng.normal(size=(3, 2, 20)), 5 * rng.normal(size=(3, 20)), np.ones((3, 20))
    known[1, 15:] = 0.0
    first, penalty = Nets.drawn(3, 2, 2, seed=0), np.array([0.1] * 8 + [0.0])
    got, steps = train(first, x_t, y, known, 0.1, 1)
    slopes, error = slopes_of(first, x_t) * known[:, None], (y - first.outputs(x_t)) * known
    for s in range(3):
        n = known[s].sum()
        left = slopes[s] @ slopes[s].T / n + np.diag(penalty + 1e-2)
        step = np.linalg.solve(left, slopes[s] @ error[s] / n - penalty * first.parameters[s])
        np.testing.assert_allclose(got.parameters[s] - first.parameters[s], step, atol=1e-9)
    assert steps.tolist() == [1, 1, 1]


def test_torch_keeps_its_thread_count():
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        BP().as_published().fit_design(make_design(), [0, 1])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_small_stacks_give_what_one_stack_gives(monkeypatch):
    design, folds = make_design(), [[0, 1, 2], [1, 2, 3], [0, 2, 3]]
    want = BP().as_published().fit_folds(design, folds)
    monkeypatch.setattr("models.families.bp._STACK_VALUES", 1)
    for a, b in zip(want, BP().as_published().fit_folds(design, folds), strict=True):
        np.testing.assert_allclose(a.predict_design(design, [3])[0], b.predict_design(design, [3])[0], atol=1e-6)


def test_same_seed_same_net_other_seed_other_net_whatever_the_threads():
    design = make_design(p=4)
    predict = [
        BP(seed=s).as_published().fit_design(design, [0, 1, 2]).predict_design(design, [3])[0] for s in (0, 0, 1)
    ]
    np.testing.assert_array_equal(predict[0], predict[1])
    assert np.abs(predict[0] - predict[2]).max() > 1e-6
    with threadpool_limits(limits=1):
        one = BP().as_published().fit_design(design, [0, 1, 2]).predict_design(design, [3])[0]
    with threadpool_limits(limits=2):
        two = BP().as_published().fit_design(design, [0, 1, 2]).predict_design(design, [3])[0]
    np.testing.assert_allclose(one, two, atol=1e-6)


@pytest.mark.parametrize("train", [[0, 1], [0], [2]])
def test_a_season_never_seen_does_not_explode(train):
    """Trained on small summer rises, asked for winter's of ten times their size, and the other way round."""
    design = make_design(sizes=(60, 60, 60, 60), ambient=(1.0, 1.2, 10.0, 12.0), p=4)
    model = BP().as_published().fit_design(design, train)
    keep = np.isin(design.group, train)
    width = np.ptp(design.y_um[keep])
    for part in model.predict_design(design, range(4)):
        assert np.abs(part - design.y_um[keep].mean()).max() < 3 * width
    f = model.fitted
    v, c = f["nets"][:, 3 * 5 : 3 * 6], f["nets"][:, -1]
    bound = f["y_spread"] * np.mean(np.abs(c) + np.abs(v).sum(axis=1))
    huge = Design(design.inputs, "z", ("far",), np.full((1, 4), 1e6), np.zeros(1), np.zeros(1), np.array([0, 1]), 60.0)
    assert abs(model.predict_design(huge, [0])[0][0] - f["y_mean"]) <= bound * (1 + 1e-12)


def test_rows_are_decimated_evenly_and_holes_left_out():
    design = make_design(sizes=(100, 30))
    x, y = design.x.copy(), design.y_um.copy()
    x[5, 0], y[110:125] = np.nan, np.nan
    holed = replace(design, x=x, y_um=y)
    model = BP(max_rows=20).as_published().fit_design(holed, [0, 1])
    assert model.fitted["n_rows"] == 20 + 15
    got = np.concatenate(model.predict_design(holed, [0, 1]))
    assert np.flatnonzero(np.isnan(got)).tolist() == [5]


def test_a_sensor_that_never_moved_and_a_flat_error_do_no_harm():
    design = make_design()
    x = design.x.copy()
    x[design.group == 0, 1] = 0.0
    still = replace(design, x=x, y_um=np.where(design.group == 0, 0.0, design.y_um))
    for part in BP().as_published().fit_design(still, [0]).predict_design(still, range(4)):
        assert np.abs(part).max() < 1.0


def test_linear_transfer_is_least_squares_with_a_penalty_on_the_length_of_the_slope():
    """min mean (y − c − x·β)² + 2 decay |β| is convex: at its one minimum mean x (y − ŷ) = decay β / |β|."""
    rng = np.random.default_rng(0)
    x_t, decay = rng.normal(size=(1, 4, 80)), 0.05
    y = np.array([[1.0, -2.0, 0.5, 0.0]]) @ x_t[0] + 3.0 + rng.normal(size=(1, 80))
    slopes = []
    for hidden, seed in ((1, 0), (3, 0), (3, 1)):
        nets, _ = train(Nets.drawn(1, 4, hidden, seed, "linear"), x_t, y, np.ones((1, 80)), decay, 2000)
        w, _, v, _ = np.split(nets.parameters[0], [4 * hidden, 5 * hidden, 6 * hidden])
        slope = v @ w.reshape(hidden, 4)
        left = y - nets.outputs(x_t)
        np.testing.assert_allclose((x_t[0] @ left[0]) / 80, decay * slope / np.linalg.norm(slope), atol=1e-4)
        assert abs(left.mean()) < 1e-4
        slopes.append(slope)
    np.testing.assert_allclose(slopes[1:], [slopes[0]] * 2, atol=1e-4)


def test_without_decay_a_linear_net_is_multiple_regression():
    design = make_design()
    net = BPLinear(decay=0.0, iterations=200, max_rows=1000).as_published().fit_design(design, [0, 1, 2])
    plain = MLR().as_published().fit_design(design, [0, 1, 2])
    np.testing.assert_allclose(net.predict_design(design, [3])[0], plain.predict_design(design, [3])[0], atol=1e-4)
    assert net.options()["transfer"] == "linear" and BP().options()["transfer"] == "tanh"


def test_linear_transfer_cannot_bend():
    design = make_design(law=lambda x: 20 * np.tanh(0.15 * x[:, 0] - 0.1 * x[:, 1]) + 5)
    left = {}
    for transfer in TRANSFERS:
        model = (
            BP(decay=1e-6, iterations=200, max_rows=100, transfer=transfer).as_published().fit_design(design, [0, 1, 2])
        )
        left[transfer] = np.std(model.predict_design(design, [3])[0] - design.y_um[design.rows(3)])
    assert left["tanh"] < 0.2 * left["linear"]
