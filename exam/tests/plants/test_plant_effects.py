"""What each effect of a development plant does to the recordings, by sign or by its formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.plants.plant_cases import SEED, Array, driver, full_speed, moved, plant, with_and_without
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.options import stream


def _used(key: str, name: str) -> NDArray[np.bool_]:
    return np.asarray(driver(key, name).any(axis=1))


def _only(key: str, channels: str) -> bool:
    case = with_and_without(key)[0]
    names = set(case.machine.names("temperature", "error"))
    return {n for n in names if np.abs(moved(key, n)).max() > 1e-4} <= set(channels)


def _skewed() -> bool:
    """Read `delay` later: the skewed channel at t is the true one at t + delay."""
    one, other = with_and_without("time_skew")
    delay_s = one.truth["parameters"]["delay"]["value"]
    a, b = one.batches[0], other.batches[0]
    inside = slice(3, -3)
    expected = np.interp(a.time_s + delay_s, b.time_s, b.values("z"))
    off = np.sqrt(np.mean((a.values("z") - expected)[inside] ** 2))
    return bool(off < 0.35 * np.sqrt(np.mean(moved("time_skew", "z")[0, inside] ** 2)) and _only("time_skew", "xyz"))


def _shifted() -> bool:
    case = with_and_without("speed_shift")[0]
    shift_um, rated = (case.truth["parameters"][n]["value"] for n in ("shift", "rated"))
    speed = driver("speed_shift", "spindle_rpm")
    expected = shift_um * ((speed / rated) ** 2 - (speed[:, :1] / rated) ** 2)
    return bool(np.abs(moved("speed_shift", "z") - expected).max() < 0.11 and np.abs(expected).max() > 1)


def _drifts() -> bool:
    case = with_and_without("sensor_drift")[0]
    rate = case.truth["parameters"]["rate"]["value"]
    expected = rate * case.batches[0].time_s / 3600.0
    return bool(np.abs(moved("sensor_drift", case.truth["where"]["name"]) - expected).max() < 1e-4)


def _late() -> bool:
    channel = with_and_without("sensor_lag")[0].truth["where"]["name"]
    late, on_time = (np.stack([b.values(channel) for b in c.batches]) for c in with_and_without("sensor_lag"))
    rate = np.gradient(on_time, axis=1)
    return bool(np.corrcoef((on_time - late).ravel(), rate.ravel())[0, 1] > 0.5)


def _swapped() -> bool:
    one, other = with_and_without("sensor_swap")
    a, b = one.truth["where"]["name"], one.truth["also"][0]
    pairs = list(zip(one.batches, other.batches, strict=True))
    return all(np.array_equal(x.values(a), y.values(b)) and np.array_equal(x.values(b), y.values(a)) for x, y in pairs)


def _toward_ground() -> bool:
    """In winter the floor warms the bed, in summer it cools it."""
    rooms = np.array([b.values("room")[0] for b in with_and_without("floor_sink")[0].batches])
    bed = moved("floor_sink", "t_bed").mean(axis=1)
    return bool(bed[rooms.argmin()] > 0.1 and bed[rooms.argmax()] < -0.1)


def _toward_walls() -> bool:
    case, plain = with_and_without("radiation")
    channel = f"t_{case.truth['where']['name']}"
    lead = np.array([np.mean(b.values("wall") - b.values(channel)) for b in plain.batches])
    return bool((np.sign(moved("radiation", channel).mean(axis=1)) == np.sign(lead))[np.abs(lead) > 1].all())


def _cold_rubs_more() -> bool:
    """Below the reference temperature the oil is thicker: more heat in the cold season than in the warm one."""
    case = with_and_without("viscosity_feedback")[0]
    runs = _used("viscosity_feedback", "spindle_rpm")
    rooms = np.array([b.values("room")[0] for b in case.batches])
    more = moved("viscosity_feedback", "t_front").max(axis=1)
    coldest = int(np.argmin(np.where(runs, rooms, np.inf)))
    return bool(more[coldest] > 0.3)


def _unlisted_by_temperature() -> bool:
    """Heat where the head is above 20 degC, cold below, none at rest."""
    p = plant()
    effect = EFFECTS["unlisted_warm_speed"](p, 1.0, stream(SEED, "effect"))
    full, heat = full_speed(p), np.zeros((p.structure.size, 1))
    for degC, expected in ((30.0, 1.0), (15.0, -0.5)):
        heat[:] = 0.0
        effect.add_heat_W(heat, np.full(heat.shape, degC), full)
        assert heat.sum() == pytest.approx(expected * effect.answer().parameters["power"][0])
    effect.add_heat_W(heat, np.full(heat.shape, 30.0), replace(full, speed_rpm=np.zeros(1)))
    assert heat.sum() == pytest.approx(-0.5 * effect.answer().parameters["power"][0])  # as before
    return bool(np.abs(moved("unlisted_warm_speed", "t_head")).max() > 0.5)


def _last(key: str, channel: str) -> Array:
    return moved(key, channel)[:, -1]


def _within(key: str, channel: str, low: float, high: float) -> bool:
    """The channel moves by more than `high` somewhere and never below `low`."""
    return bool(moved(key, channel).max() > high and moved(key, channel).min() > low)


def _gate_opens() -> bool:
    motor = moved("draught", "t_motor")
    return bool(motor.min() < -0.5 and np.abs(motor[:, 0]).max() == 0)


DIRECTIONS: dict[str, Callable[[], bool]] = {
    "cabinet_heat": lambda: bool((moved("cabinet_heat", "t_column_back") > 0.1).all()),
    "pump_heat": lambda: bool((_last("pump_heat", "t_column_back") > 0.02)[_used("pump_heat", "coolant")].all()),
    "guide_friction": lambda: bool((_last("guide_friction", "t_table") > 0.1)[_used("guide_friction", "feed")].all()),
    "sun": lambda: bool(_last("sun", "t_column_back").min() > 0.1),
    "draught": _gate_opens,
    "stratification": lambda: bool((moved("stratification", "t_head") > 0.1).all()),
    "natural_convection": lambda: bool(moved("natural_convection", "t_motor").mean() < -0.5),
    "rotating_convection": lambda: bool(moved("rotating_convection", "t_front").min() < -0.5),
    "motor_loss": lambda: _within("motor_loss", "t_motor", -1e-6, 3.0),
    "time_skew": _skewed,
    "speed_shift": _shifted,
    "sensor_drift": _drifts,
    "sensor_lag": _late,
    "sensor_swap": _swapped,
    "floor_sink": _toward_ground,
    "radiation": _toward_walls,
    "viscosity_feedback": _cold_rubs_more,
    "preload_feedback": lambda: _within("preload_feedback", "t_front", -0.2, 0.3),
    "column_bending": lambda: bool(np.abs(moved("column_bending", "y")).max() > 2 and _only("column_bending", "yz")),
    "spindle_growth": lambda: bool(_last("spindle_growth", "z").max() > 5 and _only("spindle_growth", "z")),
    "mandrel": lambda: bool(moved("mandrel", "z").max() > 5),
    "unlisted_warm_speed": _unlisted_by_temperature,
    "unlisted_coolant_speed": lambda: _within("unlisted_coolant_speed", "t_column_back", -1e-6, 0.05),
    "unlisted_feed_speed": lambda: _within("unlisted_feed_speed", "t_bed", -1e-6, 0.02),
    "wrong_parameter": lambda: _only("wrong_parameter", ""),
}


@pytest.mark.parametrize("key", EFFECTS)
def test_the_effect_moves_the_recordings_as_it_should(key: str) -> None:
    assert DIRECTIONS[key]()
