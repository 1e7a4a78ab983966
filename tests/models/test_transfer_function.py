"""The transfer function against planted poles, an independent simulation, and fits done one by one."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.signal import cont2discrete, lti

from data.batch import Batch, Channel
from features.design import Design
from models.families.ridge import Ridge
from models.families.transfer_function import TAUS_S, Dictionary, Source, TransferFunction, combination
from models.metrics import residual_std_um
from models.numerics.batches import only
from models.numerics.lags import lag_responses

STEP_S = 120.0
CHANNELS = {
    "front": Channel("front", "temperature", "degC"),
    "bed": Channel("bed", "temperature", "degC"),
    "room": Channel("room", "ambient", "degC"),
    "spindle": Channel("spindle", "driver", "rpm"),
    "z": Channel("z", "error", "um"),
}


def held(numerator, denominator, u, step_s=STEP_S):
    """A continuous transfer function's response to inputs held over the step before their sample, from rest."""
    system = lti(numerator, denominator).to_ss()
    a, b, c, d, _ = cont2discrete((system.A, system.B, system.C, system.D), step_s, method="zoh")
    state, out = np.zeros((len(a), 1)), []
    for value in [0.0, *u[1:]]:
        out.append((c @ (a @ state + b * value) + d * value).item())
        state = a @ state + b * value
    return np.array([0.0, *out[1:]])


def make_batch(k, law, noise_um=0.0, n=180):
    """A run of steps of load; `law` gives z from the rises, the speed and how far the bed stands off the room."""
    rng = np.random.default_rng(100 + k)
    stage = rng.uniform(0, 1, 6).round(1)[np.arange(n) * 6 // n]
    rpm = np.where(np.arange(n) > 0, 6000 * stage, 0.0)
    heat = np.cumsum(rng.normal(0, 0.3, n)) + 15 * stage * (np.arange(n) > 0)
    front = held([1.0], [900.0, 1.0], heat)
    bed = held([0.3], [5000.0, 1.0], heat) + 0.5 * np.sin(np.arange(n) / 20 + k) - 0.5 * np.sin(k)
    room_degC, off_K = rng.uniform(5, 30), rng.uniform(-3, 4)
    table = pd.DataFrame({
        "time_s": np.arange(n) * STEP_S, "front": room_degC + front, "bed": room_degC + off_K + bed,
        "room": np.full(n, room_degC), "spindle": rpm,
    })  # fmt: skip
    z_um = law(front - front[0], bed - bed[0], rpm, off_K)
    return Batch("toy", f"b{k}", table.assign(z=z_um + rng.normal(0, noise_um, n)), CHANNELS)


def make(law, batches=6, noise_um=0.0, inputs=("front", "bed")):
    return Design.build([make_batch(k, law, noise_um) for k in range(batches)], inputs, "z")


def cascade(front, bed, rpm, off_K):
    """8 / ((900 s + 1)(7200 s + 1)) of the front's rise."""
    return held([8.0], np.polymul([900.0, 1.0], [7200.0, 1.0]), front)


def two_inputs(front, bed, rpm, off_K):
    return held([5.0], [1500.0, 1.0], front) + held([-20.0], [10000.0, 1.0], bed)


def left_out_S_um(family, design):
    folds = [[j for j in range(design.n_batches) if j != k] for k in range(design.n_batches)]
    models = family.fit_folds(design, folds)
    predicted = family.predict_folds(design, models, [[k] for k in range(design.n_batches)])
    errors = [design.y_um[design.rows(k)] - p[0] for k, p in enumerate(predicted)]
    return float(np.mean([residual_std_um(e) for e in errors]))


def test_a_pole_between_the_grids_is_a_combination_of_its_neighbours():
    design = make(two_inputs, batches=2)
    dictionary = Dictionary(design, (Source("input", "front"), Source("input", "bed")))
    tau_s = np.array([[130.0, 2000.0], [30000.0, 777.0]])

    def behind(pole, factor=1.0):
        return np.hstack([lag_responses(design, x[:, None], [(0.0, own[pole] * factor)])[:, 0]
                          for x, own in zip(design.x.T, tau_s, strict=True)])  # fmt: skip

    weight, slope = combination(np.log(tau_s)[None], np.array([True, True]))
    columns = dictionary.table.x @ weight[0]
    np.testing.assert_allclose(columns[:, :2], design.x, atol=1e-12)
    size = np.abs(design.x).max()
    np.testing.assert_allclose(columns[:, 2:], np.hstack([behind(0), behind(1)]), atol=2e-4 * size)
    change = (behind(1, np.exp(1e-4)) - behind(1, np.exp(-1e-4))) / 2e-4
    np.testing.assert_allclose(dictionary.table.x @ slope[0][:, 2:], change, atol=2e-3 * size)
    assert dictionary.places([0, 1], [3]) == [0, 1, 8, 9] and len(dictionary.block([1])) == len(TAUS_S) + 1


def test_a_planted_cascade_of_two_poles_is_found():
    design = make(cascade, noise_um=0.05, inputs=("front",))
    f = TransferFunction(gaps=False).fit_design(design, range(6)).fitted
    order = np.argsort(f["tau_s"][0])
    np.testing.assert_allclose(f["tau_s"][0, order], [900.0, 7200.0], rtol=0.1)
    # Partial fractions of K / ((τ1 s + 1)(τ2 s + 1)) with K = 8.
    np.testing.assert_allclose(f["gain_um"][0, order], [8 * 900 / (900 - 7200), 8 * 7200 / (7200 - 900)], rtol=0.05)
    assert abs(f["direct_um"][0]) < 0.05
    assert f["direct_um"][0] + f["gain_um"][0].sum() == pytest.approx(8.0, rel=0.05)


def test_inputs_have_poles_of_their_own():
    design = make(two_inputs, noise_um=0.02)
    f = TransferFunction(poles=1, gaps=False).fit_design(design, range(6)).fitted
    np.testing.assert_allclose(f["tau_s"][:, 0], [1500.0, 10000.0], rtol=0.12)
    np.testing.assert_allclose(f["gain_um"][:, 0], [5.0, -20.0], rtol=0.1)
    np.testing.assert_allclose(f["direct_um"] + f["gain_um"][:, 0], [5.0, -20.0], rtol=0.06)


def test_beats_ridge_where_lags_are_planted_and_costs_little_where_none_are():
    lagged = make(two_inputs, noise_um=0.5)
    assert left_out_S_um(TransferFunction(), lagged) < 0.35 * left_out_S_um(Ridge(), lagged)
    still = make(lambda front, bed, rpm, off_K: 2.0 * front - 4.0 * bed, batches=9, noise_um=0.5)
    assert left_out_S_um(TransferFunction(), still) < 1.15 * left_out_S_um(Ridge(), still)


def test_a_start_off_the_room_is_told_by_the_gap():
    def relaxing(front, bed, rpm, off_K):
        return 2.0 * front - 6.0 * off_K * (1 - np.exp(-np.arange(len(front)) * STEP_S / 6000.0))

    design = make(relaxing, batches=8, noise_um=0.3)
    model = TransferFunction().fit_design(design, range(8))
    at = [i for i, (kind, name) in enumerate(zip(model.fitted["kinds"], model.fitted["names"], strict=True))
          if (kind, name) == ("gap", "bed")]  # fmt: skip
    assert len(at) == 1 and model.fitted["gain_um"][at[0]].sum() == pytest.approx(-6.0, rel=0.15)
    with_gaps, without = (left_out_S_um(TransferFunction(gaps=g), design) for g in (True, False))
    assert with_gaps < 0.6 < 0.3 * without


def driven(front, bed, rpm, off_K):
    return 2.0 * bed + held([0.8], [3000.0, 1.0], (rpm / 1000.0) ** 2)


def test_drivers_bring_a_lagged_power_of_speed():
    design = make(driven, noise_um=0.1, inputs=("bed",))
    model = TransferFunction(drivers=True).fit_design(design, range(6))
    speed = model.fitted["kinds"].index("speed")
    assert model.fitted["names"][speed] == "spindle" and model.fitted["exponents"][speed] == 2.0
    assert model.fitted["gain_um"][speed].sum() + model.fitted["direct_um"][speed] == pytest.approx(0.8, rel=0.05)
    assert left_out_S_um(TransferFunction(drivers=True), design) < 0.3
    assert left_out_S_um(TransferFunction(), design) > 1.0


def test_what_does_not_help_takes_no_part():
    design = make(cascade, noise_um=0.5)
    kinds = TransferFunction(drivers=True).fit_design(design, range(6)).fitted["kinds"]
    still = make(lambda front, bed, rpm, off_K: 3.0 * front, noise_um=0.5)
    assert "input" in kinds
    assert TransferFunction(poles=0).fit_design(still, range(6)).fitted["tau_s"].shape == (2, 0)


def test_one_or_two_batches_have_no_poles():
    design = make(two_inputs, batches=3, noise_um=0.5)
    models = TransferFunction(drivers=True).fit_folds(design, [[1, 2], [0], [0, 1, 2]])
    assert [model.fitted["tau_s"].shape[1] > 0 for model in models] == [False, False, True]


def test_holes_are_held_inside_and_stay_holes_outside():
    design = make(two_inputs, noise_um=0.1)
    x = design.x.copy()
    x[20:23, 0] = np.nan
    holed = replace(design, x=x)
    model = TransferFunction().fit_design(holed, range(6))
    predicted = model.predict_design(holed, [0])[0]
    assert np.flatnonzero(np.isnan(predicted)).tolist() == [20, 21, 22]
    assert np.nanmax(np.abs(predicted - design.y_um[:180])) < 1.5


def test_a_batch_without_the_driver_gets_no_prediction_and_a_design_without_it_no_driver():
    design = make(driven, inputs=("bed",), noise_um=0.1)
    model = TransferFunction(drivers=True).fit_design(design, range(6))
    batch = design.batches[0]
    bare = replace(batch, table=batch.table.drop(columns="spindle"),
                   channels={n: c for n, c in batch.channels.items() if n != "spindle"})  # fmt: skip
    assert np.isnan(model.predict(bare)).all() and np.isfinite(model.predict(batch)).all()
    mixed = Design.build([*design.batches[1:], bare], ("bed",), "z")
    assert "speed" not in TransferFunction(drivers=True).fit_design(mixed, range(6)).fitted["kinds"]


def test_some_batches_of_a_design_are_those_batches():
    design = make(two_inputs, batches=4)
    some = only(design, [3, 1])
    assert some.batch_ids == ("b3", "b1")
    np.testing.assert_array_equal(some.x[some.rows(1)], design.x[design.rows(1)])
    np.testing.assert_array_equal(some.drivers[some.rows(0)], design.drivers[design.rows(3)])
