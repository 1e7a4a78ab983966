"""Features of one batch against analytic answers."""

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray

from data.batch import Batch, Channel, Finding
from data.errors import InputError
from features.rises import feature, feature_unit, first_order_lag, hold_last, temperature_inputs, zeroed_error_um

STEP_S = 300.0
CHANNELS = {
    "front": Channel("front", "temperature", "degC"),
    "room": Channel("room", "ambient", "degC"),
    "speed": Channel("speed", "driver", "rpm"),
    "z": Channel("z", "error", "um"),
}


def batch(findings: tuple[Finding, ...] = (), **columns: NDArray[np.float64] | list[float]) -> Batch:
    n = len(next(iter(columns.values())))
    table = pd.DataFrame({"time_s": STEP_S * np.arange(n), **columns})
    return Batch("vmc", "run1", table, {c: CHANNELS[c] for c in columns}, findings=findings)


def test_rise_is_zero_at_the_start_and_a_driver_stays_as_recorded() -> None:
    b = batch(front=[21.0, 23.5, 20.0], speed=[2000.0, 2000, 0], z=[4.0, 9, 1])
    assert feature(b, "front").tolist() == [0.0, 2.5, -1.0]
    assert feature(b, "speed").tolist() == [2000.0, 2000, 0]
    assert zeroed_error_um(b, "z").tolist() == [0.0, 5, -3]


def test_rise_starts_at_the_first_usable_sample() -> None:
    b = batch(front=[np.nan, 20.0, 22, 25], z=[1.0, 2, 3, 4])
    assert np.array_equal(feature(b, "front"), [np.nan, 0.0, 2, 5], equal_nan=True)
    hidden = batch((Finding("spike", "z", "…", 0.0, STEP_S),), z=[50.0, 2, 3, 4])
    assert np.array_equal(zeroed_error_um(hidden, "z"), [np.nan, np.nan, 0.0, 1], equal_nan=True)
    assert np.isnan(feature(batch(front=[np.nan] * 3), "front@lag1h")).all()


def test_lag_follows_the_analytic_step_response() -> None:
    t = STEP_S * np.arange(200)
    b = batch(front=np.r_[20.0, np.full(199, 30.0)], speed=np.full(200, 3000.0))
    assert feature(b, "front@lag30min") == pytest.approx(10 * (1 - np.exp(-t / 1800)), abs=1e-9)
    # a driver that is on from the first sample meets a machine at rest
    assert feature(b, "speed@lag2h") == pytest.approx(3000 * (1 - np.exp(-t / 7200)), abs=1e-6)


def test_lag_equals_the_recursion_written_out() -> None:
    u = np.random.default_rng(0).normal(size=50)
    keep, state, truth = np.exp(-60 / 900), u[0], [u[0]]
    for value in u[1:]:
        state = keep * state + (1 - keep) * value
        truth.append(state)
    assert first_order_lag(u, 900.0, 60.0) == pytest.approx(truth)
    assert first_order_lag(u, 0.0, 60.0).tolist() == u.tolist()


def test_lag_bridges_a_hole_and_leaves_it_empty() -> None:
    u = np.array([0.0, 1, np.nan, np.nan, 1, 1])
    out = first_order_lag(u, 600.0, 300.0)
    assert np.isnan(out).tolist() == [False, False, True, True, False, False]
    assert out[[4, 5]] == pytest.approx(first_order_lag(np.array([0.0, 1, 1, 1, 1, 1]), 600.0, 300.0)[[4, 5]])


def test_time_constants_in_seconds_minutes_and_hours_agree() -> None:
    b = batch(front=20 + np.random.default_rng(1).normal(size=30))
    assert feature(b, "front@lag5400s") == pytest.approx(feature(b, "front@lag90min"))
    assert feature(b, "front@lag1.5h") == pytest.approx(feature(b, "front@lag90min"))


def test_rate_is_the_slope_over_the_last_ten_minutes() -> None:
    ramp = batch(front=20 + 0.5 * np.arange(6))  # 0.5 K in 5 min = 6 K/h
    assert feature(ramp, "front@rate") == pytest.approx([0, 6, 6, 6, 6, 6])
    step = batch(front=[20.0, 20, 20, 21, 21, 21])
    assert feature(step, "front@rate") == pytest.approx([0, 0, 0, 6, 6, 0])  # 1 K in 600 s
    late = batch(front=[np.nan, 20.0, 20.5, 21, 21.5])
    assert np.array_equal(np.round(feature(late, "front@rate"), 9), [np.nan, 0, 6, 6, 6], equal_nan=True)


def test_ambient_relative_rise() -> None:
    b = batch(front=[21.0, 24, 26], room=[20.0, 21, 19])
    assert feature(b, "front@ambient").tolist() == [0.0, 2, 6]
    late = batch(front=[21.0, 24, 26], room=[np.nan, 21, 19])  # T − T_room is 3, then 7
    assert np.array_equal(feature(late, "front@ambient"), [np.nan, 0, 4], equal_nan=True)


def test_start_value_is_held() -> None:
    assert feature(batch(room=[np.nan, 18.5, 19]), "room@start").tolist() == [18.5] * 3


def test_hold_last_fills_from_before_and_the_start_from_behind() -> None:
    assert hold_last(np.array([np.nan, 1.0, np.nan, 3, np.nan])).tolist() == [1, 1, 1, 3, 3]
    assert np.isnan(hold_last(np.full(3, np.nan))).all()


@pytest.mark.parametrize("name", ["front", "front@rate", "front@ambient", "front@lag10min", "front@start"])
def test_one_row_is_enough(name: str) -> None:
    assert feature(batch(front=[20.0], room=[19.0]), name).tolist() == [20.0 if "start" in name else 0.0]


def test_units() -> None:
    b = batch(front=[20.0], room=[20.0], speed=[0.0])
    names = ["front", "front@rate", "front@ambient", "front@lag30min", "room@start", "room", "speed", "speed@rate"]
    units = ["K", "K/h", "K", "K", "degC", "K", "rpm", "rpm/h"]
    assert [feature_unit(b, n) for n in names] == units
    assert feature_unit(b, "speed@lag30min") == "rpm"


@pytest.mark.parametrize("function", [feature, feature_unit])
def test_names_that_mean_nothing_are_refused_in_one_line(function: object) -> None:
    assert callable(function)
    b = batch(front=[20.0, 21], speed=[0.0, 1])
    with pytest.raises(
        InputError, match=r"unknown kind 'slope'; allowed: rate, ambient, start, lag<number><s\|min\|h>"
    ):
        function(b, "front@slope")
    with pytest.raises(InputError, match=r"feature 'front@': unknown kind ''"):
        function(b, "front@")
    with pytest.raises(InputError, match=r"run1 of vmc: no channel 'frnt'; did you mean 'front'\? Allowed: front, sp"):
        function(b, "frnt@rate")
    with pytest.raises(InputError, match="machine vmc has no channel with role ambient"):
        function(b, "front@ambient")
    with_room = batch(room=[20.0, 21], speed=[0.0, 1])
    with pytest.raises(InputError, match="channel 'speed' is a driver; expected a temperature"):
        function(with_room, "speed@ambient")


def test_candidates_are_temperatures_and_ambient_in_order() -> None:
    assert temperature_inputs([batch(z=[0.0], room=[1.0], speed=[0.0], front=[1.0])]) == ("room", "front")
    assert temperature_inputs([]) == ()
