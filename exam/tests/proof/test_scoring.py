"""Outcomes against answers made by hand: every column says what the case says."""

from __future__ import annotations

from typing import Any

import pandas as pd
import pytest

from data.errors import InputError
from tests.proof.answered import answer, finding, findings, other, stored, term, truth
from thermodrift_exam.proof.scoring.answer_key import Stored
from thermodrift_exam.proof.scoring.outcomes import OUTCOMES, TERMS, outcomes
from thermodrift_exam.proof.scoring.true_model import TrueModel


def scored(
    key: dict[str, Any], given: Stored, true: TrueModel | None = None
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The one row of outcomes and the rows of terms, as plain values; None where a cell is empty."""
    name = key["case"]
    cases, terms = outcomes({name: key}, {name: given}, {} if true is None else {name: true})
    assert list(cases.columns) == list(OUTCOMES)
    assert list(terms.columns) == list(TERMS)
    return plain(cases)[0], plain(terms)


def plain(table: pd.DataFrame) -> list[dict[str, Any]]:
    return [{k: None if pd.isna(v) else v for k, v in row.items()} for row in table.to_dict("records")]


def test_one_effect_that_is_found() -> None:
    case, (own,) = scored(answer("one", term()), stored("explained", finding()), truth(True, error_true=0.9))
    assert {k: case[k] for k in ("case", "kind", "plant", "effect", "verdict", "terms", "visible_terms", "claims")} == {
        "case": "case_0001", "kind": "one", "plant": "volumes", "effect": "cabinet_heat", "verdict": "explained",
        "terms": 1, "visible_terms": 1, "claims": 1,
    }  # fmt: skip
    for column in ("visible", "detected", "first_right", "in_set", "place_exact", "place_near", "all_named", "right"):
        assert case[column] is True, column
    assert case["failed"] is False
    assert (case["false_claims"], case["set_size"], case["seconds"], case["probability"]) == (0, 1, 20.0, 0.95)
    assert case["overlap"] == 1.0
    assert case["amplitude_error"] == pytest.approx(0.1)
    assert case["interval_covers"] is True
    assert case["error_before"] == pytest.approx(12.5**0.5)  # mean of 3² and 4²
    assert (case["error_after"], case["error_true"], case["error_floor"]) == (1.0, 0.9, 1.0)
    assert case["closed"] == pytest.approx((12.5**0.5 - 1.0) / (12.5**0.5 - 0.9))
    assert case["limit_share"] == 4.0
    for column in ("driver_right", "set_holds_truth", "settled"):
        assert case[column] is None, column
    assert case["flagged_unlisted"] is False
    assert own["named_mechanism"] == "cabinet_heat"
    assert (own["amplitude_true"], own["amplitude_found"], own["low90"], own["high90"]) == (100.0, 110.0, 90.0, 130.0)


def test_a_place_beside_the_true_one_is_near_and_the_answer_not_right() -> None:
    case, (own,) = scored(answer("one", term()), stored("explained", finding(name="head")), truth(True))
    assert (case["place_exact"], case["place_near"], case["false_claims"]) == (False, True, 0)
    assert case["right"] is False
    assert (own["found"], own["named_place"]) == (True, "head")


def test_the_same_mechanism_far_away_is_a_false_claim() -> None:
    case, (own,) = scored(answer("one", term()), stored("explained", finding(name="spindle")), truth(True))
    assert (case["first_right"], case["place_near"], case["false_claims"], case["right"]) == (True, False, 1, False)
    assert (own["found"], own["named_mechanism"], own["named_place"]) == (False, "cabinet_heat", "spindle")
    assert own["amplitude_found"] is None


def test_the_reported_set_holds_what_is_a_tenth_as_likely() -> None:
    alternatives = [other("cabinet_heat", "column", 0.06), other("draught", "room", 0.04)]
    given = finding("sun", probability=0.5, alternatives=alternatives)
    case, _ = scored(answer("one", term()), stored("explained", given), truth(True))
    assert (case["first_right"], case["in_set"], case["set_size"], case["false_claims"]) == (False, True, 2, 1)


def test_what_is_missed_is_wrong_in_every_way() -> None:
    case, (own,) = scored(answer("one", term()), stored("consistent"), truth(True))
    for column in ("detected", "first_right", "in_set", "place_exact", "place_near", "all_named", "right"):
        assert case[column] is False, column
    assert case["closed"] == pytest.approx(0.0)
    assert own["named_mechanism"] == own["named_place"] == "nothing"


def test_what_cannot_be_seen_need_not_be_said() -> None:
    case, _ = scored(answer("invisible", term(limit_share=0.2)), stored("consistent"), truth(False))
    assert (case["visible"], case["detected"], case["right"]) == (False, False, True)


def test_nothing_missing() -> None:
    case, terms = scored(answer("nothing"), stored("consistent"), truth())
    assert terms == []
    assert (case["right"], case["claims"], case["false_claims"], case["effect"]) == (True, 0, 0, "nothing")
    for column in ("visible", "detected", "first_right", "place_exact", "all_named", "closed", "probability"):
        assert case[column] is None, column


@pytest.mark.parametrize(
    ("verdict", "claims"), [("explained", (finding(),)), ("undecidable", ()), ("undecidable", (finding(),))]
)
def test_whatever_is_said_to_be_missing_from_nothing_is_false(verdict: str, claims: tuple[dict[str, Any], ...]) -> None:
    case, _ = scored(answer("nothing"), stored(verdict, *claims), truth())
    assert (case["false_claims"], case["right"]) == (1, False)


def test_a_decoy_may_be_named_and_nothing_else() -> None:
    drift = term("sensor_drift", where={"kind": "sensor", "name": "t_bed"}, decoy=True, neighbours=[])
    named = finding("sensor_drift", "t_bed", "sensor")
    case, (own,) = scored(answer("decoy", drift), stored("explained", named), truth(True))
    assert (case["false_claims"], case["right"], case["terms"], case["visible"]) == (0, True, 0, None)
    assert (own["decoy"], own["found"]) == (True, True)
    assert scored(answer("decoy", drift), stored("consistent"), truth(True))[0]["right"] is True
    case, _ = scored(answer("decoy", drift), stored("explained", named, finding()), truth(True))
    assert (case["false_claims"], case["right"]) == (1, False)


def test_two_effects_are_named_each_once() -> None:
    conductance = {"conductance": {"value": 20.0, "unit": "W/K"}}
    floor = term("floor_sink", where={"kind": "node", "name": "bed"}, parameters=conductance)
    key = answer("two", term(), floor)
    both = (finding(), finding("floor_sink", "bed", parameters={}))
    case, rows = scored(key, stored("explained", *both), truth(True, True))
    assert (case["all_named"], case["false_claims"], case["right"], case["closed"]) == (True, 0, True, None)
    assert [r["found"] for r in rows] == [True, True]
    case, rows = scored(key, stored("explained", finding(), finding(name="head")), truth(True, True))
    assert (case["all_named"], case["false_claims"], case["right"]) == (False, 1, False)
    assert (rows[1]["found"], rows[1]["named_mechanism"], rows[1]["named_place"]) == (False, "cabinet_heat", "head")
    case, _ = scored(key, stored("explained", finding()), truth(True, False))
    assert (case["all_named"], case["right"], case["visible_terms"]) == (True, True, 1)


def test_one_effect_is_found_at_every_place_that_it_acts_on() -> None:
    y, z = ({"kind": "error", "name": name} for name in "yz")
    key = answer("one", term("column_bending", where=y, also=[z], neighbours=[], parameters={}))
    at = {name: finding("column_bending", name, "error", parameters={}) for name in "xyz"}
    case, _ = scored(key, stored("explained", at["z"], at["y"]), truth(True))
    assert (case["right"], case["false_claims"]) == (True, 0)
    for wrong in (at["x"], at["y"]):  # another error, and the same place twice
        case, _ = scored(key, stored("explained", at["y"], wrong), truth(True))
        assert case["false_claims"] == 1


def test_a_confounded_pair_wants_the_truth_in_the_set_and_a_run_that_settles_it() -> None:
    partner = {"mechanism": "sun", "where": {"kind": "node", "name": "column"}}
    key = answer("confounded", term(same_as=[partner]))
    tie = finding("sun", probability=0.5, alternatives=[other("cabinet_heat", "column", 0.45)])
    run = {"separates": ["a", "b"], "run": "a night", "hours": 8.0}
    open_ = stored("undecidable", tie)
    case, _ = scored(key, open_, truth(True))
    assert (case["set_holds_truth"], case["false_claims"], case["right"], case["settled"]) == (True, 0, True, False)
    asked = Stored(findings("undecidable", tie, next_experiment=run), open_.run, None, open_.length_s, open_.body_of)
    assert scored(key, asked, truth(True))[0]["settled"] is None
    for again, settled in ((finding(), True), (finding("sun"), False), (tie, False)):
        done = Stored(asked.findings, asked.run, None, asked.length_s, asked.body_of, findings("explained", again))
        assert scored(key, done, truth(True))[0]["settled"] is settled
    alone = scored(key, stored("explained", finding("sun")), truth(True))[0]
    assert (alone["set_holds_truth"], alone["false_claims"], alone["right"]) == (False, 0, False)


def test_of_one_law_under_two_names_the_set_must_hold_the_keys_own_and_no_run_need_tell() -> None:
    partner = {"mechanism": "nut_friction", "where": {"kind": "node", "name": "column"}}
    key = answer("confounded", term("guide_friction", same_as=[partner], driver="feed"))
    both = finding("nut_friction", probability=0.5, alternatives=[other("guide_friction", "column", 0.4)])
    case, _ = scored(key, stored("undecidable", both), truth(True))
    assert (case["first_right"], case["set_holds_truth"], case["right"], case["settled"]) == (True, True, True, None)
    case, _ = scored(key, stored("explained", finding("nut_friction")), truth(True))
    assert (case["first_right"], case["set_holds_truth"], case["right"]) == (True, False, False)


def test_unlisted_physics_is_flagged_and_its_driver_named() -> None:
    key = answer("unlisted", term("odd", mechanism=None, driver="coolant, spindle_rpm"))
    said = finding("free_flux", statement="60 W into the column: it follows coolant and spindle_rpm^2", parameters={})
    case, (own,) = scored(key, stored("unlisted", said), truth(True))
    assert (case["flagged_unlisted"], case["driver_right"], case["right"], case["first_right"]) == (True,) * 4
    assert (own["mechanism"], own["named_mechanism"]) == ("unlisted", "unlisted")
    half = finding("free_flux", statement="60 W into the column: it follows coolant", parameters={})
    assert scored(key, stored("unlisted", half), truth(True))[0]["driver_right"] is False
    case, _ = scored(key, stored("explained", finding()), truth(True))
    assert (case["flagged_unlisted"], case["driver_right"], case["false_claims"], case["right"]) == (
        False,
        False,
        1,
        False,
    )
    assert scored(answer("one", term()), stored("unlisted", said), truth(True))[0]["flagged_unlisted"] is True


def test_windows_are_compared_in_time() -> None:
    key = answer("one", term(active=[["r1", 0.0, 500.0], ["r2", 1000.0, 2000.0]]))
    when = {"regime": "at times", "windows": [["r1", 250.0, 500.0], ["r2", 1000.0, 2500.0]]}
    case, _ = scored(key, stored("explained", finding(when=when)), truth(True))
    assert case["overlap"] == pytest.approx(1250.0 / 2000.0)
    assert scored(key, stored("explained", finding()), truth(True))[0]["overlap"] == pytest.approx(1500.0 / 4000.0)


def test_a_failed_diagnosis_has_found_nothing() -> None:
    run = {"seconds": None, "error": "no end", "started": "2026-11-22T02:06:00Z", "ended": "2026-11-22T02:11:00Z"}
    case, (own,) = scored(answer("one", term()), Stored(None, run), truth(True))
    assert (case["failed"], case["detected"], case["first_right"], case["right"]) == (True, False, False, False)
    assert (case["verdict"], case["claims"], case["seconds"], own["found"]) == (None, None, 300.0, False)


def test_without_a_true_model_visibility_is_left_open() -> None:
    case, (own,) = scored(answer("one", term()), stored("explained", finding()))
    assert (case["visible"], case["visible_terms"], own["visible"], case["error_true"]) == (None, None, None, None)


def test_a_key_of_another_schema_is_refused() -> None:
    with pytest.raises(InputError, match=r"answer key: schema is 'other', expected 'thermodrift.proof_answer/1'; seal"):
        scored(answer("one", term()) | {"schema": "other"}, stored("consistent"))
    broken = answer("one", term())
    del broken["plant"]
    with pytest.raises(InputError, match=r"answer key of case_0001: key 'plant' is missing; seal the cases again"):
        scored(broken, stored("consistent"))
