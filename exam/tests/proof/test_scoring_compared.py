"""Rivals scored as a diagnosis is: shares and paired leads counted by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from data.errors import InputError
from tests.proof.answered import answer, finding, stored, term, truth
from thermodrift_exam.proof.scoring.goal_table import goal_table
from thermodrift_exam.proof.scoring.outcomes import outcomes
from thermodrift_exam.proof.scoring.tables import ALARMS, COMPARED_COLUMNS, FIRST, RIGHT, as_findings, compared

CONSISTENT: dict[str, Any] = {"verdict": "consistent", "findings": [], "seconds": 0.1}


def reply(mechanism: str, name: str = "column", **changes: Any) -> dict[str, Any]:
    claim = {"mechanism": mechanism, "where": {"kind": "node", "name": name}, "alternatives": [], **changes}
    return {"verdict": "explained", "findings": [claim], "seconds": 0.1}


def proof() -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Six cases with one effect, all found by the diagnosis; two with nothing. Raw correlation is right about two of
    the six and claims something in one of the empty ones; the lasso is always silent."""
    keys, given, true = {}, {}, {}
    for k in range(8):
        name = f"case_{k:04d}"
        raw = reply("cabinet_heat") if k < 2 else CONSISTENT if k == 7 else reply("sun")
        replies = {
            "baselines": {"raw_correlation": raw, "sparse_regression": CONSISTENT},
            "ablations": {"in_sample": reply("cabinet_heat") if k else reply("sun")},
            "reference": reply("cabinet_heat") if k < 6 else CONSISTENT,
        }
        keys[name] = answer("one", term(), case=name) if k < 6 else answer("nothing", case=name)
        own = stored("explained", finding()) if k < 6 else stored("consistent")
        given[name] = replace(own, replies=replies)
        true[name] = truth(True) if k < 6 else truth()
    return keys, given, true


def test_every_method_is_counted_on_the_same_cases() -> None:
    table = compared(*proof())
    assert tuple(table.columns) == COMPARED_COLUMNS
    at = table.set_index(["method", "measure"])
    assert at.loc[("diagnosis", RIGHT), ["group", "value", "n"]].tolist() == ["diagnosis", 1.0, 8]
    assert at.loc[("raw_correlation", RIGHT), ["group", "value", "n"]].tolist() == ["baseline", 3 / 8, 8]
    assert at.loc[("sparse_regression", RIGHT), "value"] == 2 / 8
    assert at.loc[("raw_correlation", FIRST), ["value", "n"]].tolist() == [2 / 6, 6]
    assert at.loc[("raw_correlation", ALARMS), ["value", "n"]].tolist() == [1 / 2, 2]
    assert at.loc[("in_sample", RIGHT), ["group", "value"]].tolist() == ["ablation", 5 / 8]
    assert at.loc[("raw_correlation", RIGHT), "lead"] == pytest.approx(5 / 8)
    assert at.loc[("in_sample", RIGHT), "lead"] == pytest.approx(3 / 8)  # of the reference
    low, high = at.loc[("raw_correlation", RIGHT), ["lead_low90", "lead_high90"]]
    assert 0.25 < low < 5 / 8 < high < 1.0
    assert at["lead"].notna().sum() == 3


def test_an_ablation_counts_where_it_ran() -> None:
    keys, given, true = proof()
    for name in list(given)[2:]:
        given[name] = replace(given[name], replies={"baselines": given[name].replies["baselines"]})
    at = compared(keys, given, true).set_index(["method", "measure"])
    assert at.loc[("in_sample", RIGHT), ["value", "n", "lead"]].tolist() == [1 / 2, 2, 1 / 2]
    assert at.loc[("reference", RIGHT), "n"] == 2 and at.loc[("raw_correlation", RIGHT), "n"] == 8


def test_the_goal_is_the_lead_over_the_best_baseline() -> None:
    keys, given, true = proof()
    goals = goal_table(*outcomes(keys, given, true), compared(keys, given, true))
    own = goals[goals["measure"].str.startswith("right answers")].iloc[0]
    assert (own["value"], own["n"], own["plant"], own["goal"]) == (5 / 8, 8, "all", "≥ 15 %")
    assert own["met"]


def test_what_a_rival_cannot_tell_apart_is_its_reported_set() -> None:
    other = {"mechanism": "cabinet_heat", "where": {"kind": "node", "name": "column"}}
    partner = {"mechanism": "sun", "where": {"kind": "node", "name": "column"}}
    key = answer("confounded", term(same_as=[partner]))
    own = replace(stored("explained", finding()), replies={"baselines": {"raw": reply("sun", alternatives=[other])}})
    table = compared({"case_0001": key}, {"case_0001": own}, {"case_0001": truth(True)}).set_index("method")
    assert table.loc["raw"].set_index("measure").loc[RIGHT, "value"] == 1.0


def test_cases_without_rivals_are_left_out() -> None:
    keys, given, true = proof()
    given["case_0000"] = replace(given["case_0000"], replies=None)
    assert set(compared(keys, given, true).query("measure == @RIGHT")["n"]) == {7}
    none = {name: replace(own, replies=None) for name, own in given.items()}
    assert set(compared(keys, none, true)["n"]) == {0}


def test_a_reply_that_lacks_its_verdict_is_refused() -> None:
    like = stored("consistent").findings
    assert like is not None
    with pytest.raises(InputError, match=r"replies of baselines.*verdict"):
        as_findings({"findings": [], "seconds": 1.0}, like)
