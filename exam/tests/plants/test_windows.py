"""When an effect is at work: against what the recordings' own drivers and clocks say."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pytest import approx

from tests.plants.plant_cases import QUIET, SEED, with_and_without
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.plant import Case, draw, stretches

ROW_S = 300.0


def told(case: Case, key: str) -> list[list[float]] | str:
    (active,) = [t["active"] for t in case.truth["terms"] if t["effect"] == key]
    return active


def flags(case: Case, key: str) -> dict[str, np.ndarray]:
    """By batch, whether the key's windows hold a row; their end is the first row without it."""
    out = {b.batch_id: np.zeros(b.n_rows, bool) for b in case.batches}
    for batch, start_s, end_s in told(case, key):
        out[batch][round(start_s / ROW_S) : round(end_s / ROW_S)] = True
    return out


@pytest.mark.parametrize(
    ("key", "channels"),
    [
        ("pump_heat", ("coolant",)),
        ("guide_friction", ("feed",)),
        ("rotating_convection", ("spindle_rpm",)),
        ("viscosity_feedback", ("spindle_rpm",)),
        ("speed_shift", ("spindle_rpm",)),
        ("motor_loss", ("spindle_rpm",)),
        ("unlisted_warm_speed", ("spindle_rpm",)),
        ("unlisted_coolant_speed", ("coolant", "spindle_rpm")),
        ("unlisted_feed_speed", ("feed", "spindle_rpm")),
    ],
)
def test_what_a_driver_switches_works_while_the_recording_shows_it_on(key: str, channels: tuple[str, ...]) -> None:
    case = with_and_without(key)[0]
    on = flags(case, key)
    for b in case.batches:
        recorded = np.all([b.values(c) != 0 for c in channels], axis=0)
        assert on[b.batch_id][:-1].tolist() == recorded[:-1].tolist()
    assert EFFECTS[key].driver == channels[0]


def test_what_no_list_has_is_stated_as_a_regression_over_channels() -> None:
    """The true model of a case fits it by that; what a list has needs none."""
    for key, role in (("warm_speed", "product"), ("coolant_speed", "square_cross"), ("feed_speed", "cross")):
        case = with_and_without(f"unlisted_{key}")[0]
        stated, *drivers = case.truth["terms"][0]["form"]
        assert stated == role and drivers[0] == "spindle_rpm"
        assert all(case.machine.channels[name].role == "driver" for name in drivers)
    assert "form" not in with_and_without("pump_heat")[0].truth["terms"][0]


def test_the_sun_is_up_between_its_hours_by_a_tenth_of_noon() -> None:
    """A tenth of the sine's top is reached 3.2 % of the day after the rise."""
    case = with_and_without("sun")[0]
    rise_h, set_h = (case.truth["parameters"][n]["value"] for n in ("rise", "set"))
    trim_h = np.arcsin(0.1) / np.pi * (set_h - rise_h)
    on = flags(case, "sun")
    for b in case.batches:
        assert b.start is not None
        clock_h = b.start.hour + b.start.minute / 60 + b.time_s / 3600
        sure = np.abs(np.minimum(np.abs(clock_h - rise_h - trim_h), np.abs(clock_h - set_h + trim_h))) > 0.1
        up = (clock_h > rise_h + trim_h) & (clock_h < set_h - trim_h)
        assert on[b.batch_id][:-1][sure[:-1]].tolist() == up[:-1][sure[:-1]].tolist()


def test_the_gate_is_open_for_its_minutes_in_every_run() -> None:
    case = draw(SEED, "draught", has=(), **{**QUIET, "hours": 6.0, "batches": 2})
    start_s = 3600 * case.truth["parameters"]["start"]["value"]
    end_s = start_s + 60 * case.truth["parameters"]["duration"]["value"]
    assert [w[0] for w in told(case, "draught")] == [b.batch_id for b in case.batches]
    for _, first_s, behind_s in told(case, "draught"):
        assert 0 <= first_s - start_s < ROW_S and 0 <= behind_s - end_s < ROW_S


def test_exchange_rests_where_it_is_below_a_tenth_of_its_largest() -> None:
    """h ΔT with h ∝ ΔT^(1/4) to ΔT^(1/3): a tenth of the heat is at 16 to 18 % of the largest excess."""
    case = with_and_without("natural_convection")[0]
    on = flags(case, "natural_convection")
    excess_K = {b.batch_id: np.abs(b.values("t_motor") - b.values("room")) for b in case.batches}
    largest_K = max(v.max() for v in excess_K.values())
    assert any(v.any() for v in on.values()) and any(not v.all() for v in on.values())
    for batch, lead_K in excess_K.items():
        flagged, inner_K = on[batch][:-1], lead_K[:-1]
        assert flagged[inner_K > 0.25 * largest_K].all()
        assert not flagged[inner_K < 0.10 * largest_K].any()


@pytest.mark.parametrize(
    "key", ["cabinet_heat", "stratification", "sensor_drift", "sensor_lag", "time_skew", "wrong_parameter",
            "column_bending", "spindle_growth", "mandrel"],
)  # fmt: skip
def test_constants_faults_and_chains_always_work(key: str) -> None:
    assert told(with_and_without(key)[0], key) == "always"


def test_windows_are_plain_data_within_the_runs() -> None:
    case = with_and_without("pump_heat")[0]
    active = told(case, "pump_heat")
    assert json.loads(json.dumps(active)) == active
    assert active and all(0 <= a < b <= case.batches[0].time_s[-1] for _, a, b in active)


def test_a_stretch_ends_at_the_row_at_which_it_is_over() -> None:
    time_s = np.arange(6) * 60.0
    assert stretches(np.array([1, 1, 0, 0, 1, 1], bool), time_s) == [[0.0, 120.0], [240.0, 300.0]]
    assert stretches(np.zeros(6, bool), time_s) == []
    assert stretches(np.array([0, 1, 0, 0, 0, 0], bool), time_s)[0][1] == approx(120.0)
