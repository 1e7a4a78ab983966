"""The thermal exponential against closed forms, and what a stop does."""

from dataclasses import replace

import numpy as np
import pytest

from features.design import Design
from models.families.thermal_exponential import ThermalExponential
from models.numerics.lags import behind
from tests.toys.runs import stack


def make_design(speeds, y) -> Design:
    """One batch per series; `speeds` None makes a design without drivers."""
    sizes = [len(v) for v in y]
    design = stack(np.empty((sum(sizes), 0)), np.concatenate(y), sizes)
    if speeds is None:
        return design
    drivers = np.concatenate(speeds)[:, None].astype(float)
    return replace(design, drivers=drivers, driver_names=("spindle",), driver_units=("rpm",))


T = np.arange(100) * 300.0


def rise(amplitude, tau_s, t=T):
    return amplitude * (1 - np.exp(-t / tau_s))


def test_recovers_one_lag_from_time_alone():
    design = make_design(None, [rise(40.0, 4000.0), rise(40.0, 4000.0)])
    model = ThermalExponential().fit_design(design, [0, 1])
    assert model.fitted["speed_channel"] == "" and len(model.fitted["tau_s"]) == 1
    assert model.fitted["tau_s"][0] == pytest.approx(4000.0, rel=1e-3)
    assert model.fitted["amplitude_um"][0] == pytest.approx(40.0, rel=1e-3)


def test_recovers_two_lags_and_the_exponent_over_three_speeds():
    speeds, errors = [], []
    for rpm in (2000.0, 4000.0, 6000.0):
        load = (rpm / 1000) ** 1.5
        speeds.append(np.full(100, rpm))
        errors.append(load * (rise(8.0, 1500.0) - rise(3.0, 12000.0)))
    design = make_design(speeds, errors)
    model = ThermalExponential().fit_design(design, [0, 1, 2])
    assert model.fitted["exponent"] == 1.5 and model.fitted["speed_channel"] == "spindle"
    np.testing.assert_allclose(model.fitted["tau_s"], [1500.0, 12000.0], rtol=2e-3)
    np.testing.assert_allclose(model.fitted["amplitude_um"], [8.0, -3.0], rtol=3e-3)


def test_a_response_is_the_closed_form_for_steps():
    load = np.concatenate([np.ones(50), np.zeros(50)])[None]
    got = behind(load, 2000.0, np.array([300.0]))[0]
    np.testing.assert_allclose(got[:50], 1 - np.exp(-T[:50] / 2000), atol=1e-12)
    np.testing.assert_allclose(got[50:], got[49] * np.exp(-(T[50:] - T[49]) / 2000), atol=1e-12)


def test_a_stop_cools_down():
    speed = np.where(T < 15000, 3000.0, 0.0)
    error = 4.0 * 3.0 * behind((speed > 0).astype(float)[None], 3000.0, np.array([300.0]))[0]
    running = np.full(100, 3000.0)
    design = make_design([speed, running], [error, np.full(100, np.nan)])
    model = ThermalExponential().fit_design(design, [0])
    stop, run = model.predict_design(design, [0, 1])
    np.testing.assert_allclose(stop, error, atol=0.02)
    assert stop[-1] < 0.1 * stop.max() and run[-1] > 0.95 * run.max()
    assert stop[0] == run[0] == 0.0


def test_one_speed_keeps_the_exponent_at_one():
    model = ThermalExponential().fit_design(make_design([np.full(100, 4000.0)], [rise(30.0, 3000.0)]), [0])
    assert model.fitted["exponent"] == 1.0
    faster = make_design([np.full(100, 6000.0)], [np.full(100, np.nan)])
    assert model.predict_design(faster, [0])[0][-1] == pytest.approx(45.0, rel=0.01)


def test_a_batch_without_speed_gets_the_mean_load():
    design = make_design([np.full(100, 4000.0), np.full(100, np.nan)], [rise(30.0, 3000.0)] * 2)
    model = ThermalExponential().fit_design(design, [0])
    with_speed, without = model.predict_design(design, [0, 1])
    np.testing.assert_allclose(without, with_speed, atol=1e-9)
    no_driver = make_design(None, [np.full(100, np.nan)])
    np.testing.assert_allclose(model.predict_design(no_driver, [0])[0], with_speed, atol=1e-9)
    assert ThermalExponential().fit_design(design, [0, 1]).fitted["speed_channel"] == ""


def test_missing_errors_do_not_count_and_inputs_do_not_matter():
    errors = [rise(30.0, 3000.0), rise(30.0, 3000.0)]
    errors[1][10:40] = np.nan
    design = make_design(None, errors)
    broken = replace(design, inputs=("t",), x=np.full((200, 1), np.nan))
    model = ThermalExponential().fit_design(broken, [0, 1])
    assert model.fitted["tau_s"][0] == pytest.approx(3000.0, rel=1e-3)


def test_longer_batches_stay_bounded():
    rng = np.random.default_rng(0)
    design = make_design(None, [rise(20.0, 5000.0) + rng.normal(0, 3, 100) for _ in range(3)])
    model = ThermalExponential().fit_design(design, [0, 1, 2])
    week = make_design(None, [np.full(2016, np.nan)])
    assert np.abs(model.predict_design(week, [0])[0]).max() < 5 * 26
