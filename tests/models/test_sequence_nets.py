"""Nets along whole batches: slopes, stacks, rest, causality, planted laws."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from data.errors import InputError
from features.design import Design
from features.rises import first_order_lag
from models.families.mlr import MLR
from models.families.sequence_cells import GRU, LAYERS, LSTM, TCN
from models.numerics.sequences import Stack
from models.numerics.torch_training import Rows, losses, train

NETS = {"lstm": LSTM, "gru": GRU, "tcn": TCN}
STEP_S = 300.0


@pytest.fixture(params=list(NETS))
def Net(request):
    return NETS[request.param]


def lag(values, tau_s):
    return first_order_lag(np.concatenate([[0.0], values]), tau_s, STEP_S)[1:]


def plant(law, batches=8, n=76, seed=0, noise_um=0.3) -> Design:
    """Runs with a stop: `a` follows the load fast, `b` slowly, beside a room that drifts. error = law(load, a, b)."""
    rng = np.random.default_rng(seed)
    x, y, speed = [], [], []
    for _ in range(batches):
        load = rng.uniform(0.3, 1.5) * (np.arange(n) < rng.uniform(0.5, 1.0) * n)
        load[0] = 0.0
        a, b = 15 * lag(load, 1800.0), 6 * lag(load, 7200.0) + rng.normal(0, 1.5) * lag(np.ones(n), 5400.0)
        error = law(load, a, b) + noise_um * rng.normal(size=n)
        x.append(np.column_stack([a, b]) + 0.03 * rng.normal(size=(n, 2)))
        y.append(error - error[0])
        speed.append(1000.0 * load)
    ids = tuple(f"K{k + 1}" for k in range(batches))
    time_s, offsets = np.tile(np.arange(n) * STEP_S, batches), np.arange(batches + 1) * n
    return Design(("a", "b"), "z", ids, np.vstack(x), np.concatenate(y), time_s, offsets, STEP_S,
                  drivers=np.concatenate(speed)[:, None], driver_names=("spindle",), driver_units=("rpm",))  # fmt: skip


def lagged_law(load, a, b):
    return 3.0 * lag(a, 3600.0)


def bent_law(load, a, b):
    return 30.0 * np.tanh(lag(a, 3600.0) / 6.0)


def left_out_um(model, design) -> float:
    """Mean rms of every second batch, each predicted by a model of all others."""
    tests = range(0, design.n_batches, 2)
    folds = [[j for j in range(design.n_batches) if j != k] for k in tests]
    told = model.predict_folds(design, model.fit_folds(design, folds), [[k] for k in tests])
    return float(np.mean([np.std(t[0] - design.y_um[design.rows(k)]) for k, t in zip(tests, told, strict=True)]))


def small_problem(net, n_nets=2, p=2, steps=7, batches=4, seed=0):
    rng = np.random.default_rng(seed)
    x, rest = rng.normal(size=(1, n_nets, p, steps, batches)), rng.normal(size=(1, n_nets, steps, batches))
    known = (rng.uniform(size=rest.shape) > 0.2).astype(float)
    stack = Stack(x, rest * known, known, np.full(n_nets, batches), np.ones((n_nets, p)), np.ones(n_nets))
    weights = net.start(stack.unit_directions(rng.normal(size=(net.hidden, p))))
    moved = {name: w + 0.3 * rng.normal(size=w.shape) for name, w in weights.items()}
    return stack, moved


def losses_of(net, stack, weights):
    rows = Rows(*(torch.tensor(v) for v in (stack.x, stack.rest, stack.known, 1.0 / stack.n_batches)))
    return losses(net, rows, 0, weights)


def test_the_slope_at_the_best_readout_is_that_of_the_whole_loss(Net):
    net, rng = Net(hidden=3, readout_decay=0.1), np.random.default_rng(2)
    stack, weights = small_problem(net)
    along = {name: rng.normal(size=w.shape) for name, w in weights.items()}
    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    moved = {name: torch.tensor(w) + step * torch.tensor(along[name]) for name, w in weights.items()}
    (got,) = torch.autograd.grad(losses_of(net, stack, moved).sum(), step)
    ends = [{n: torch.tensor(w + h * along[n]) for n, w in weights.items()} for h in (1e-6, -1e-6)]
    high, low = (float(losses_of(net, stack, end).sum()) for end in ends)
    np.testing.assert_allclose(float(got), (high - low) / 2e-6, rtol=1e-6)


def test_what_is_trained_is_what_predicts(Net):
    net = Net(hidden=4)
    stack, weights = small_problem(net, steps=20)
    ours = net.states(np, weights, stack.x[0])
    with torch.inference_mode():
        theirs = net.states(torch, {n: torch.tensor(w) for n, w in weights.items()}, torch.tensor(stack.x[0]))
    assert ours.shape == (2, net.n_states(), 20, 4)
    np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-14)


def test_a_net_in_a_stack_is_the_net_alone(Net):
    net = Net(hidden=3)
    stack, _ = small_problem(net, n_nets=3, steps=12)
    start = net.start(stack.unit_directions(np.random.default_rng(1).normal(size=(3, 2))))
    together, readouts = train(net, stack, start)
    for s in range(3):
        one = Stack(stack.x[:, [s]], stack.rest[:, [s]], stack.known[:, [s]], *(
            v[[s]] for v in (stack.n_batches, stack.spread, stack.sigma_um)))  # fmt: skip
        weights, readout = train(net, one, {n: w[[s]] for n, w in start.items()})
        np.testing.assert_allclose(readout[0], readouts[s], atol=1e-9)
        for name, w in weights.items():
            np.testing.assert_allclose(w[0], together[name][s], atol=1e-9)


@pytest.mark.parametrize(("key", "gain"), [("gru", 1.0), ("lstm", 1.0 / (1.0 + np.exp(-1.0)))])
def test_a_recurrent_net_starts_as_first_order_lags(key, gain):
    net = NETS[key](hidden=5)
    weights = net.start(np.ones((1, 5, 1)))
    u = 1e-4 * np.random.default_rng(0).normal(size=30).cumsum()
    states = net.states(np, weights, u.reshape(1, 1, 30, 1))
    for j, tau_steps in enumerate(np.geomspace(1.0, 16.0, 5)):
        np.testing.assert_allclose(states[0, j, :, 0], gain * lag(u, tau_steps * STEP_S), atol=1e-10)


def test_tcn_starts_as_moving_means_and_sees_five_hours():
    net = TCN(hidden=2)
    weights = net.start(np.ones((1, 2, 1)))
    weights["bias"] = 0.0 * weights["bias"]
    u = 1e-4 * np.random.default_rng(0).normal(size=40).cumsum()
    states = net.states(np, weights, u.reshape(1, 1, 40, 1))
    for layer in range(LAYERS):
        window = 2 ** (layer + 1)
        mean = np.convolve(u, np.ones(window) / window)[:40]
        np.testing.assert_allclose(states[0, 2 * layer, :, 0], mean, atol=1e-10)
    late = u.copy()
    late[3] += 1e-4
    moved = np.abs(net.states(np, weights, late.reshape(1, 1, 40, 1)) - states)[0].max(axis=(0, 2)) > 1e-12
    assert np.flatnonzero(moved).tolist() == list(range(3, 3 + 2**LAYERS))
    assert 2**LAYERS * net.spacing_s >= 4 * 3600.0


def test_a_planted_lag_is_learned(Net):
    design = plant(lagged_law)
    assert left_out_um(Net(), design) < 0.25 * left_out_um(MLR(), design)


def test_a_law_that_bends_needs_the_net(Net):
    design = plant(bent_law, batches=16)
    linear = Net(readout_decay=1e9)  # the net's readout held at 0
    assert left_out_um(Net(), design) < 0.75 * left_out_um(linear, design)
    assert Net().fit_design(design, range(16)).fitted["share"] > 0.7


def test_noise_that_no_batch_shares_leaves_the_net_silent(Net):
    rng = np.random.default_rng(0)
    design = plant(lambda load, a, b: a + rng.normal(0, 2.0) * lag(np.ones(len(a)), 3600.0))
    assert Net().fit_design(design, range(8)).fitted["share"] < 0.3
    assert Net().fit_design(design, [0, 1]).fitted["share"] == 0.0


def test_a_machine_at_rest_is_told_its_intercept(Net):
    design = plant(bent_law)
    model = Net().fit_design(design, range(8))
    still = Design(design.inputs, "z", ("rest",), np.zeros((30, 2)), np.zeros(30), np.arange(30) * STEP_S,
                   np.array([0, 30]), STEP_S)  # fmt: skip
    np.testing.assert_allclose(model.predict_design(still, [0])[0], model.fitted["intercept_um"], atol=1e-12)


def recorded(x, step_s, ids=("K1",)) -> Design:
    n = len(x)
    return Design(("a", "b"), "", ids, x, np.full(n, np.nan), np.arange(n) * step_s, np.array([0, n]), step_s)


def test_a_finer_recording_is_told_the_same_at_the_same_times(Net):
    model = Net().fit_design(plant(bent_law), range(4))
    fine = np.random.default_rng(3).uniform(0, 0.2, (371, 2)).cumsum(axis=0)
    by_minute = model.predict_design(recorded(fine, 60.0), [0])[0]
    np.testing.assert_allclose(by_minute[::5], model.predict_design(recorded(fine[::5], 300.0), [0])[0], atol=1e-9)
    assert np.isfinite(by_minute).all() and model.fitted["spacing_s"] == 1200.0
    assert np.isfinite(model.predict_design(recorded(fine[:1], 0.0), [0])[0]).all()


def test_a_step_that_does_not_fit_is_told(Net):
    model = Net(epochs=1).fit_design(plant(bent_law), range(3))
    with pytest.raises(InputError) as error:
        model.predict_design(recorded(np.zeros((9, 2)), 1800.0), [0])
    assert str(error.value) == (
        f"family {Net.key}: batch K1 has a step of 1800 s, the net learned steps of 1200 s; expected a step that "
        "divides these: resample the batch"
    )


def test_short_batches_take_a_narrower_spacing(Net):
    design = plant(bent_law, batches=4, n=13)  # an hour
    assert Net(epochs=2).fit_design(design, range(4)).fitted["spacing_s"] == STEP_S


def test_holes_are_bridged_by_the_last_value_and_an_absent_input_is_told_as_nan(Net):
    design = plant(bent_law)
    model = Net().fit_design(design, range(4))
    holed, held = design.x.copy(), design.x.copy()
    holed[design.rows(6)][20:25, 0] = np.nan
    held[design.rows(6)][20:25, 0] = held[design.rows(6)][19, 0]
    holed[design.rows(7), 1] = np.nan
    parts = [design.batch_ids, None, design.y_um, design.time_s, design.offsets, STEP_S]
    got, want = (Design(design.inputs, "z", parts[0], x, *parts[2:]) for x in (holed, held))
    np.testing.assert_allclose(model.predict_design(got, [6])[0], model.predict_design(want, [6])[0], atol=1e-12)
    six, seven = model.predict_design(got, [6, 7])
    assert np.isfinite(six).all() and np.isnan(seven).all()
    assert Net(epochs=2).fit_design(got, range(8)).fitted["n_rows"] == 8 * 76 - 76 - 5


def test_a_driver_that_no_sensor_feels_is_followed_when_asked_for(Net):
    design = plant(lambda load, a, b: a)
    feed = np.repeat(np.random.default_rng(5).integers(0, 2, 8 * 4), 19) * 1500.0
    feed[design.offsets[:-1]] = 0.0
    y_um = design.y_um + 0.01 * np.concatenate([lag(feed[design.rows(k)], 3600.0) for k in range(8)])
    design = replace(design, y_um=y_um, drivers=feed[:, None])
    assert left_out_um(Net(drivers=True), design) < 0.2 * left_out_um(Net(), design)
    model = Net(drivers=True).fit_design(design, range(4))
    assert model.fitted["drivers"] == ["spindle"]
    blind = recorded(design.x[:76], STEP_S)
    assert np.isnan(model.predict_design(blind, [0])[0]).all()


def test_parameters_are_counted(Net):
    model = Net(hidden=3, epochs=1).fit_design(plant(bent_law), range(3))
    net = {"lstm": 12 * 2 + 12 * 3 + 12, "gru": 9 * 2 + 9 * 3 + 9, "tcn": 3 * 2 + 4 * (9 + 9 + 3)}[Net.key]
    assert model.n_parameters() == net + model.n_states() + 5 * 2


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_gpu_that_is_not_there_is_told_in_one_line(Net):
    design = plant(bent_law, batches=3)
    with pytest.warns(UserWarning) as told:
        asked = Net(epochs=2, device="cuda").fit_design(design, range(3))
    line = f"family {Net.key}: device 'cuda' was requested, but torch sees no GPU; trained on the processor"
    assert {str(w.message) for w in told} == {line}
    cpu = Net(epochs=2, device="cpu").fit_design(design, range(3))
    np.testing.assert_array_equal(asked.predict_design(design, [0])[0], cpu.predict_design(design, [0])[0])


def test_what_cannot_be_used_is_told_in_one_line(Net):
    design = plant(bent_law, batches=3)
    with pytest.raises(InputError, match="no inputs given for z; name at least one channel"):
        Net().fit_design(design.subset(()), [0])
    bare = Design(design.inputs, "z", design.batch_ids, design.x, design.y_um, design.time_s, design.offsets, STEP_S)
    with pytest.raises(InputError, match="drivers=True, but batch K1 has no driver channel; expected at least one"):
        Net(drivers=True).fit_design(bare, [0])


def test_small_stacks_give_what_one_stack_gives(Net, monkeypatch):
    design, folds = plant(bent_law), [[0, 1, 2, 3], [1, 2, 3, 4], [0, 2, 5]]
    want = Net(epochs=5).fit_folds(design, folds)
    told = Net().predict_folds(design, want, [[6], [7], [6]])
    monkeypatch.setattr("models.families.sequence_net._STACK_VALUES", 1)
    again = Net(epochs=5).fit_folds(design, folds)
    for a, b in zip(told, Net().predict_folds(design, again, [[6], [7], [6]]), strict=True):
        np.testing.assert_allclose(a[0], b[0], atol=1e-7)


@pytest.mark.parametrize("waiting", [1, 10_000_000])
def test_subsets_together_are_each_alone_and_one_that_fails_keeps_the_others(Net, waiting, monkeypatch):
    monkeypatch.setattr("models.families.sequence_net._WAITING_VALUES", waiting)
    design = plant(bent_law)
    designs = [design.subset(names) for names in (("a",), ("b",), ("a", "b"), ("b", "a"))]
    folds = [[[0, 1, 2, 3], [4]], [[]], [[1, 2, 3]], [[0, 1, 2, 3], [2, 3, 4, 5, 6, 7]]]
    one, failed, *others = Net(epochs=4).fit_subsets(designs, folds)
    assert isinstance(failed, InputError) and "in no batch" in str(failed)
    for d, fitted in zip((0, 2, 3), (one, *others), strict=True):
        for model, fold in zip(fitted, folds[d], strict=True):
            alone = Net(epochs=4).fit_design(designs[d], fold)
            got, want = (m.predict_design(designs[d], [7])[0] for m in (model, alone))
            np.testing.assert_allclose(got, want, atol=1e-7)


def test_a_family_that_joins_nothing_fits_subset_by_subset():
    design = plant(bent_law)
    first, failed = MLR().fit_subsets([design.subset(("a",)), design], [[[0, 1], [2]], [[]]])
    assert [m.inputs for m in first] == [("a",), ("a",)] and isinstance(failed, InputError)


def test_torch_keeps_its_thread_count_and_a_result_does_not_depend_on_it(Net):
    design, before = plant(bent_law, batches=4), torch.get_num_threads()
    told = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            told.append(Net(epochs=5).fit_design(design, range(3)).predict_design(design, [3])[0])
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(told[0], told[1])
