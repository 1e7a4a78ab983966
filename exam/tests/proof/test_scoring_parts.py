"""Parts of the scoring against closed forms and hand calculations."""

from __future__ import annotations

from typing import Any

import pytest

from tests.proof.answered import BODY_OF, LENGTH_S, answer, finding, findings, other, term
from thermodrift_exam.proof.scoring.answer_key import AnswerKey, Spot, TrueTerm
from thermodrift_exam.proof.scoring.matching import (
    always,
    amplitude,
    exact,
    found_amplitude,
    means,
    near,
    overlap,
    reported_set,
    true_amplitude,
)
from thermodrift_exam.proof.scoring.outcomes import closed, error_level


def key_term(**changes: Any) -> TrueTerm:
    return AnswerKey.from_json(answer("one", term(**changes))).terms[0]


@pytest.mark.parametrize(
    ("kind", "name", "is_exact", "is_near"),
    [
        ("node", "column", True, True),
        ("node", "bed", False, True),
        ("node", "table", False, False),
        ("link", "column-table", False, True),  # ends at the true place
        ("link", "bed-table", False, False),  # only touches a neighbour
        ("sensor", "t_column", False, True),  # stands for its body
        ("sensor", "t_room", False, False),
        ("error", "z", False, False),
        ("error", "column", False, False),
    ],
)
def test_places_beside_a_body(kind: str, name: str, is_exact: bool, is_near: bool) -> None:
    own = key_term()
    assert exact(Spot(kind, name), own) is is_exact
    assert near(Spot(kind, name), own, BODY_OF) is is_near


def test_a_link_has_two_ends_and_no_direction() -> None:
    own = key_term(where={"kind": "link", "name": "shaft-air"}, also=["shaft"], neighbours=["head"])
    assert exact(Spot("link", "air-shaft"), own)
    assert exact(Spot("node", "shaft"), own)
    assert not exact(Spot("node", "air"), own)
    assert near(Spot("node", "air"), own, {})
    assert near(Spot("node", "head"), own, {})
    assert near(Spot("link", "head-shaft"), own, {})


def test_error_channels_have_no_neighbours() -> None:
    own = key_term(where={"kind": "error", "name": "z"}, also=["y"], neighbours=[])
    assert exact(Spot("error", "y"), own)
    assert not near(Spot("error", "x"), own, {})


def test_overlap_is_the_intersection_over_the_union() -> None:
    one = [("r1", 0.0, 400.0), ("r1", 300.0, 600.0)]  # 600 s, told in two pieces that overlap
    other_ = [("r1", 500.0, 900.0), ("r2", 0.0, 100.0)]
    assert overlap(one, other_, LENGTH_S) == pytest.approx(100.0 / 1000.0)
    assert overlap(always(LENGTH_S), always(LENGTH_S), LENGTH_S) == 1.0
    assert overlap([("r2", 2900.0, 9000.0)], always(LENGTH_S), LENGTH_S) == pytest.approx(100.0 / 4000.0)
    assert overlap([], [], LENGTH_S) == 0.0


@pytest.mark.parametrize(
    ("mechanism", "values", "expected"),
    [
        ("cabinet_heat", {"heat": 80.0}, 80.0),
        ("joint_conductance", {"ratio": 1.5}, 0.5),  # counted from 1, where it does nothing
        ("sun", {"power": 90.0, "rise": 8.0, "set": 16.0}, 90.0),
        ("sun", {"irradiance": 150.0, "area": 2.0, "absorptivity": 0.3}, 90.0),
        ("guide_friction", {"friction": 0.02, "load": 5000.0}, 100.0),
        ("radiation", {"area": 2.0, "emissivity": 0.9}, 1.8),
        ("speed_shift", {"shift": 8.0, "rated": 12000.0}, 2.0),
        ("rotating_convection", {"gain": 4.0, "rated": 6000.0}, 4.0),
        ("motor_loss", {"idle": 10.0, "linear": 60.0, "quadratic": 80.0, "rated": 12000.0}, 60.0),
        ("draught", {"factor": 1.5, "drop": 3.0}, 4.5),
        ("draught", {"drop": 4.0}, 4.0),  # at a room alone nothing is multiplied
        ("column_bending", {}, None),
        ("sensor_swap", {}, None),
        ("wrong_parameter", {"factor": 0.25}, None),
    ],
)
def test_an_effect_has_one_size(mechanism: str, values: dict[str, float], expected: float | None) -> None:
    assert amplitude(mechanism, values) == (None if expected is None else pytest.approx(expected))


def test_a_size_is_never_taken_from_the_key() -> None:
    """A key may state one as another parameter than the law does: watts of sunlight, by which no finding is right."""
    own = key_term(mechanism="sun", parameters={"power": {"value": 90.0, "unit": "W"}})
    irradiance = {"value": 100.0, "unit": "W/m**2", "interval90": [80.0, 125.0]}
    told = {
        "irradiance": irradiance,
        "area": {"value": 1.0, "unit": "m**2"},
        "absorptivity": {"value": 0.5, "unit": "1"},
    }
    given = findings("explained", finding("sun", parameters=told)).findings[0]
    assert found_amplitude(given, own) == (pytest.approx(50.0), pytest.approx(40.0), pytest.approx(62.5))
    speed = key_term(
        mechanism="speed_shift",
        parameters={"shift": {"value": 8.0, "unit": "um"}, "rated": {"value": 12000.0, "unit": "rpm"}},
    )
    shift = findings("explained", finding("speed_shift", parameters={"shift": {"value": 4.0, "unit": "um"}})).findings[
        0
    ]
    assert found_amplitude(shift, speed)[0] == pytest.approx(1.0)  # at 6000 rpm, its rated speed the key's


def test_a_product_takes_its_interval_from_the_amplitude() -> None:
    values = {"area": {"value": 2.0, "unit": "m**2"}, "emissivity": {"value": 0.9, "unit": "1"}}
    own = key_term(mechanism="radiation", parameters=values)
    area = {"area": {"value": 1.8, "unit": "m**2", "interval90": [1.5, 2.1]}, "emissivity": {"value": 1.0, "unit": "1"}}
    given = findings("explained", finding("radiation", parameters=area)).findings[0]
    assert true_amplitude(own) == pytest.approx(1.8)
    assert found_amplitude(given, own) == (pytest.approx(1.8), pytest.approx(1.5), pytest.approx(2.1))


@pytest.mark.parametrize(
    ("named", "mechanism", "driver", "same"),
    [
        ("screw_bearing", "guide_friction", "feed", True),
        ("guide_friction", "nut_friction", None, True),
        ("electrical_heat", "cabinet_heat", "coolant", True),
        ("electrical_heat", "cabinet_heat", None, False),  # a cabinet that is always on follows no channel
        ("hydraulic_unit", "cabinet_heat", "coolant", False),
        ("free_shift", None, None, True),
        ("free_flux", "sun", None, False),
    ],
)
def test_one_law_may_have_several_names(named: str, mechanism: str | None, driver: str | None, same: bool) -> None:
    assert means(named, key_term(mechanism=mechanism, driver=driver)) is same


def test_the_reported_set_names_each_explanation_once() -> None:
    alternatives = [other("sun", "column", 0.2), other("sun", "column", 0.1), other("sun", "head", 0.049)]
    given = findings("explained", finding(probability=0.5, alternatives=alternatives)).findings[0]
    assert reported_set(given) == [("cabinet_heat", Spot("node", "column")), ("sun", Spot("node", "column"))]


def test_error_level_is_the_root_of_the_mean_square_over_channels() -> None:
    assert error_level({"a": 2.0, "b": 6.0}, {"a": 1.0, "b": 2.0}) == pytest.approx(6.5**0.5)
    assert error_level({"a": 2.0, "b": None}, {"a": 1.0, "b": 2.0}) == 2.0
    assert error_level({}, {}) is None


def test_closed_is_a_share_of_the_way() -> None:
    assert closed(5.0, 2.0, 1.0) == 0.75
    assert closed(5.0, 0.5, 1.0) == 1.0  # no further than the true model
    assert closed(5.0, 6.0, 1.0) == -0.25
    assert closed(1.0, 1.0, 1.0) is None
    assert closed(None, 1.0, 0.5) is None
