"""Why a visible effect has no claim: by what it gains, what a claim takes, and what was told instead."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from tests.proof.answered import answer, finding, stored, term, truth
from thermodrift_exam.proof.scoring.answer_key import Stored
from thermodrift_exam.proof.scoring.outcomes import outcomes
from thermodrift_exam.proof.scoring.tables import ALIKE, LITTLE, PREFERRED, SILENT, claims, missed


def reason(gain_nats: float, told: Stored, bar_nats: float = 40.0) -> str:
    """Of 100 W into the column that gain so much."""
    true = replace(truth(True), gain_nats=(gain_nats,), bar_nats=(bar_nats,))
    (row,) = missed(
        outcomes({"case_0001": answer("one", term())}, {"case_0001": told}, {"case_0001": true})[1]
    ).to_dict("records")
    assert row["gain_nats"] == gain_nats and row["place"] == "column"
    return str(row["reason"])


def told(gain_nats: float) -> Stored:
    return stored("explained", finding("sun", "spindle", evidence={"gain_nats": gain_nats}))


def test_each_reason_by_its_numbers() -> None:
    assert reason(30.0, stored("consistent")) == LITTLE
    assert reason(30.0, told(500.0)) == LITTLE  # too little, whatever was told
    assert reason(50.0, stored("consistent")) == SILENT
    assert reason(50.0, told(60.0)) == ALIKE
    assert reason(50.0, told(45.0)) == PREFERRED
    assert reason(50.0, told(45.0), bar_nats=float("nan")) == PREFERRED  # in no list: no bar is known


def test_what_was_found_or_cannot_be_seen_or_is_no_physics_is_not_missed() -> None:
    keys = {f"case_{k:04d}": answer("one", term(decoy=k == 2)) for k in range(3)}
    given = {name: stored("consistent") for name in keys} | {"case_0000": stored("explained", finding())}
    true = {"case_0000": truth(True), "case_0001": truth(False), "case_0002": truth(True)}
    assert missed(outcomes(keys, given, true)[1]).empty


def test_every_claim_is_listed_with_what_it_gains_and_whether_it_is_so() -> None:
    right, wrong = finding(evidence={"gain_nats": 90.0}), finding("sun", "spindle", probability=0.7)
    keys = {"case_0001": answer("one", term()), "case_0002": answer("nothing", case="case_0002", plant="elements")}
    given = {"case_0001": stored("explained", right, wrong), "case_0002": stored("explained", wrong)}
    table = claims(keys, given)
    assert table["true"].tolist() == [True, False, False]
    assert table["mechanism"].tolist() == ["cabinet_heat", "sun", "sun"]
    assert table["plant"].tolist() == ["volumes", "volumes", "elements"]
    assert table["gain_nats"].iloc[0] == pytest.approx(90.0) and pd.isna(table["gain_nats"].iloc[1])
    failed = replace(given["case_0002"], run={"error": "no time"})
    assert len(claims(keys, given | {"case_0002": failed})) == 2
