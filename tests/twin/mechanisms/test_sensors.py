"""What sensors make of temperatures, against closed forms; and what faults do to them."""

from __future__ import annotations

import numpy as np
import pytest

from tests.toys.small_machine import part_with
from twin.compile import expanded
from twin.mechanisms.base import View
from twin.mechanisms.sensors import (
    SensorLag,
    SensorQuantised,
    SensorStuck,
    SensorSwap,
    TimeSkew,
)

EVEN = np.arange(0.0, 601.0, 30.0)
UNEVEN = np.array([0.0, 1.0, 5.0, 30.0, 31.0, 95.0, 300.0, 900.0])


def read(mechanism, seen, time_s, step_s=np.nan, degC=None, **p: float) -> np.ndarray:
    view = View(time_s=np.asarray(time_s), step_s=step_s, degC=degC or {})
    return mechanism.reading(np.asarray(seen), view, {k: np.asarray(v) for k, v in p.items()})


@pytest.mark.parametrize(("time_s", "step_s"), [(EVEN, 30.0), (EVEN, np.nan), (UNEVEN, np.nan)])
def test_lag_of_a_ramp_is_exact(time_s, step_s):
    shown = read(SensorLag(), 20.0 + 0.01 * time_s, time_s, step_s, lag=60.0)
    assert shown == pytest.approx(20.0 + 0.01 * (time_s - 60.0 * (1.0 - np.exp(-time_s / 60.0))), abs=1e-12)


def test_even_steps_and_uneven_steps_are_the_same_law():
    seen = np.random.default_rng(0).normal(20, 3, (2, 4, len(EVEN)))
    lag = np.array([10.0, 1e-3, 200.0, 1e9]).reshape(4, 1)
    even, uneven = (read(SensorLag(), seen, EVEN, step, lag=lag) for step in (30.0, np.nan))
    assert even == pytest.approx(uneven, abs=1e-12)
    assert even[1, 2] == pytest.approx(read(SensorLag(), seen[1, 2], EVEN, 30.0, lag=200.0), abs=1e-12)


def test_lags_of_many_parameter_sets_over_the_same_batches():
    seen = np.random.default_rng(1).normal(20, 3, (1, 5, len(EVEN)))
    lag = np.array([20.0, 90.0]).reshape(2, 1, 1)
    shown = read(SensorLag(), seen, EVEN, 30.0, lag=lag)
    assert shown.shape == (2, 5, len(EVEN))
    assert shown[1, 3] == pytest.approx(read(SensorLag(), seen[0, 3], EVEN, 30.0, lag=90.0), abs=1e-12)


@pytest.mark.parametrize("step_s", [30.0, np.nan])
def test_no_lag_is_the_limit_of_a_small_one(step_s):
    seen = 20.0 + np.sin(EVEN / 100.0)
    assert read(SensorLag(), seen, EVEN, step_s, lag=0.0).tolist() == seen.tolist()
    slope = np.diff(seen) / 30.0
    by_lag = read(SensorLag(), seen, EVEN, step_s, lag=1e-30j).imag / 1e-30
    assert by_lag[1:] == pytest.approx(-slope)


def test_a_pause_of_no_length_changes_nothing():
    time_s = np.array([0.0, 10.0, 10.0, 20.0])
    shown = read(SensorLag(), [0.0, 1.0, 1.0, 2.0], time_s, lag=5.0)
    assert shown[1] == shown[2]
    assert np.isfinite(shown).all()


def test_a_swap_exchanges_all_that_belongs_to_a_sensor():
    part = part_with(SensorSwap(), acts_on=["first", "third"])
    lagging = part.sensors["first"].model_copy(update={"words": "the late one"})
    part = part.model_copy(update={"sensors": {**part.sensors, "first": lagging}})
    swapped = expanded(part)
    assert {n: s.at for n, s in swapped.sensors.items()} == {"first": "third", "second": "second", "third": "first"}
    assert swapped.sensors["third"].words == "the late one"
    assert list(swapped.sensors) == list(part.sensors)
    assert "tried" not in swapped.mechanisms


def test_a_stuck_sensor_keeps_its_value():
    time_s = np.array([0.0, 10.0, 20.0, 30.0])
    assert read(SensorStuck(), [1.0, 2.0, 4.0, 8.0], time_s, start=15.0).tolist() == [1.0, 2.0, 3.0, 3.0]
    assert read(SensorStuck(), [1.0, 2.0, 4.0, 8.0], time_s, start=0.0).tolist() == [1.0] * 4
    assert read(SensorStuck(), [1.0, 2.0, 4.0, 8.0], time_s, start=99.0).tolist() == [1.0, 2.0, 4.0, 8.0]


def test_a_coarse_sensor_shows_stairs_and_lets_derivatives_pass():
    assert read(SensorQuantised(), [20.24, 20.26, -0.1], 0.0, step=0.5) == pytest.approx([20.0, 20.5, 0.0])
    assert read(SensorQuantised(), [20.24], 0.0, step=0.0).tolist() == [20.24]
    seen = np.array([20.24 + 1e-20j])
    assert read(SensorQuantised(), seen, 0.0, step=0.5).imag.tolist() == [1e-20]
    assert read(SensorQuantised(), [20.24], 0.0, step=0.5 + 1e-20j).imag.tolist() == [0.0]


def test_skew_shows_the_future_and_holds_the_ends():
    time_s, seen = np.array([0.0, 10.0, 20.0, 40.0]), np.array([0.0, 1.0, 3.0, 4.0])
    assert read(TimeSkew(), seen, time_s, delay=5.0) == pytest.approx([0.5, 2.0, 3.25, 4.0])
    assert read(TimeSkew(), seen, time_s, delay=-10.0) == pytest.approx([0.0, 0.0, 1.0, 3.5])
    assert read(TimeSkew(), seen, time_s, delay=0.0).tolist() == seen.tolist()


def test_skew_of_batches_with_their_own_times_and_of_many_sets():
    rng = np.random.default_rng(2)
    time_s = rng.uniform(1.0, 60.0, (3, 40)).cumsum(-1)
    seen = rng.normal(20, 5, (2, 3, 40))
    delay = np.array([-25.0, 70.0]).reshape(2, 1, 1)
    shown = read(TimeSkew(), seen, time_s, delay=delay)
    for q, b in np.ndindex(2, 3):
        at = np.clip(time_s[b] + delay[q, 0, 0], time_s[b, 0], time_s[b, -1])
        assert shown[q, b] == pytest.approx(np.interp(at, time_s[b], seen[q, b]), abs=1e-12)
