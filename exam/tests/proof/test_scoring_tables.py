"""The goal table and other views, against counts by hand and intervals from an independent source."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import brentq
from scipy.stats import binom

from tests.proof.answered import answer, finding, stored, term, truth
from tests.snapshots import check_snapshot
from thermodrift_exam.proof.scoring.goal_table import GOAL_COLUMNS, error_by_chance, goal_table, reliability
from thermodrift_exam.proof.scoring.goals import bootstrap, clopper_pearson
from thermodrift_exam.proof.scoring.outcomes import OUTCOMES, outcomes
from thermodrift_exam.proof.scoring.tables import by, confusion, worst

HEATS_W = (100.0, 105.0, 110.0, 120.0, 150.0, 90.0, 100.0, 100.0)  # of 100; intervals 90 to 130


def examined() -> tuple[pd.DataFrame, pd.DataFrame]:
    """One effect: eight right answers, one missed, one false name; nothing: nine quiet answers, one false alarm."""
    keys, given, true = {}, {}, {}
    for k in range(20):
        name = f"case_{k:04d}"
        plant = "volumes" if k % 2 else "elements"
        heat = {"heat": {"value": HEATS_W[k % 8], "unit": "W", "interval90": [90.0, 130.0]}}
        found = finding(parameters=heat, probability=0.9)
        keys[name] = (
            answer("one", term(), case=name, plant=plant) if k < 10 else answer("nothing", case=name, plant=plant)
        )
        given[name] = stored("explained", found) if k < 8 else stored("consistent")
        true[name] = truth(True) if k < 10 else truth()
    given["case_0009"] = stored("explained", finding("sun", "spindle", probability=0.6))
    given["case_0019"] = stored("explained", finding("sun", "spindle", probability=0.6))
    return outcomes(keys, given, true)


def row(goals: pd.DataFrame, measure: str, plant: str = "all") -> dict[str, Any]:
    at = goals[goals["measure"].str.startswith(measure) & (goals["plant"] == plant)]
    assert len(at) == 1, measure
    return dict(at.iloc[0])


@pytest.fixture
def few_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of resampling, for tests that look at no interval."""
    for module in ("goals", "goal_table"):
        monkeypatch.setattr(f"thermodrift_exam.proof.scoring.{module}.DRAWS", 50)


def test_every_goal_is_measured_over_all_and_by_plant(few_draws: None) -> None:
    goals = goal_table(*examined())
    assert list(goals.columns) == list(GOAL_COLUMNS)
    assert set(goals["plant"]) == {"all", "elements", "volumes"}
    assert (goals.groupby("plant")["measure"].nunique() == goals["measure"].nunique()).all()
    alarms = row(goals, "false alarms")
    assert (alarms["value"], alarms["n"], alarms["met"], alarms["goal"]) == (0.1, 10, False, "≤ 1 %")
    assert row(goals, "false alarms", "elements")["met"]
    assert (row(goals, "detection")["value"], row(goals, "detection")["n"]) == (0.9, 10)
    assert row(goals, "mechanism first")["value"] == 0.8
    assert row(goals, "place exact,")["value"] == 0.8
    assert row(goals, "amplitude error, median")["value"] == pytest.approx(0.075)  # 0 0 0 5 10 10 20 50 %
    assert row(goals, "90 % intervals that cover, at least")["value"] == 1.0
    assert row(goals, "90 % intervals that cover, at most")["met"] == False  # noqa: E712 - a nullable boolean
    assert row(goals, "time of one case, median")["value"] == 20.0
    absent = row(goals, "three visible effects")
    assert absent["n"] == 0 and pd.isna(absent["value"]) and pd.isna(absent["met"])


def test_an_answer_that_is_told_the_truth_is_held_to_the_same_bars(few_draws: None) -> None:
    """Of ten visible effects (80 W by the true model, 60 to 110) eight pass the bar; of a pair both must."""
    keys, given, true = {}, {}, {}
    for k in range(12):
        name = f"case_{k:04d}"
        terms = [term(parameters={"heat": {"value": 100.0 - 5 * k, "unit": "W"}})] * (2 if k > 9 else 1)
        keys[name] = answer("two" if k > 9 else "one", *terms, case=name)
        given[name] = stored("consistent")
        true[name] = replace(truth(*[True] * len(terms)), gain_nats=(50.0 if k > 1 else 39.0, 39.0)[: len(terms)])
    true["case_0011"] = replace(true["case_0011"], gain_nats=(50.0, 60.0))
    keys["case_0012"], given["case_0012"] = answer("unlisted", term(mechanism=None), case="case_0012"), given[name]
    true["case_0012"] = replace(truth(True), bar_nats=(float("nan"),))  # no bar is known: not asked
    goals = goal_table(*outcomes(keys, given, true))

    def informed(measure: str) -> tuple[float, int]:
        r = row(goals, measure)
        return r["informed"], r["informed_n"]

    assert row(goals, "detection")["value"] == 0.0
    assert informed("detection") == (pytest.approx(10 / 12), 12)
    assert informed("place exact,") == informed("mechanism first") == (0.8, 10)
    assert informed("left-out error closed, worst tenth") == (0.0, 10)
    assert informed("two visible effects") == (0.5, 2)
    assert informed("amplitude error, median") == (pytest.approx(15 / 65), 11)  # of 90 to 45 W
    assert informed("90 % intervals that cover, at least") == (pytest.approx(7 / 11), 11)
    for nothing in ("false alarms", "time of one case, median", "unlisted: flagged", "probabilities"):
        assert pd.isna(informed(nothing)[0])


def test_what_is_unlisted_or_confounded_is_told_the_truth_too(few_draws: None) -> None:
    """Of four each the last gains less than a claim takes; what is unlisted has no amplitude that could be compared."""
    keys, given, true = {}, {}, {}
    for kind, mechanism in (("unlisted", None), ("confounded", "cabinet_heat")):
        for k in range(4):
            name = f"case_{len(keys):04d}"
            keys[name] = answer(kind, term(mechanism=mechanism), case=name)
            given[name], true[name] = stored("consistent"), replace(truth(True), gain_nats=(50.0 - 4 * k,))
    goals = goal_table(*outcomes(keys, given, true))
    for measure in ("unlisted: flagged", "unlisted: driver found", "confounded: the set holds"):
        r = row(goals, measure)
        assert (r["value"], r["informed"], r["informed_n"]) == (0.0, 0.75, 4), measure
    assert row(goals, "amplitude error, median")["informed_n"] == 3


def test_exact_intervals_leave_five_per_cent_on_either_side() -> None:
    low, high = clopper_pearson(7, 20)
    assert low == pytest.approx(brentq(lambda p: binom.sf(6, 20, p) - 0.05, 0.01, 0.9))
    assert high == pytest.approx(brentq(lambda p: binom.cdf(7, 20, p) - 0.05, 0.01, 0.9))
    assert clopper_pearson(0, 20) == (0.0, pytest.approx(1.0 - 0.05 ** (1 / 20)))
    assert clopper_pearson(0, 0) == (0.0, 1.0)


def test_the_bootstrap_draws_whole_cases() -> None:
    values = np.random.default_rng(1).standard_normal(400)
    low, high = bootstrap(pd.Series(values), lambda v: float(np.mean(v)))
    assert high - low == pytest.approx(2 * 1.645 * values.std() / 20.0, rel=0.1)
    twice = pd.Series(np.repeat(values, 2), index=np.repeat(np.arange(400), 2))
    assert bootstrap(twice, lambda v: float(np.mean(v))) == (pytest.approx(low), pytest.approx(high))


def test_probabilities_that_come_true_as_often_as_they_say_have_no_error() -> None:
    n = 1000
    told = np.repeat([0.2, 0.8], n // 2)
    right = np.r_[np.arange(n // 2) % 5 == 0, np.arange(n // 2) % 5 != 0]
    cases = pd.DataFrame({"probability": told, "first_right": right, "place_near": True})
    table, error = reliability(cases)
    assert error == pytest.approx(0.0, abs=0.005)
    assert table["n"].sum() == n
    _, error = reliability(cases.assign(probability=0.2))  # half come true
    assert error == pytest.approx(0.3)
    assert np.isnan(reliability(cases[:0])[1])


def test_probabilities_that_are_exactly_right_show_an_error_too_where_cases_are_few() -> None:
    """The mean distance from 0.9 of the share right of 12 cases, by the binomial distribution."""
    k = np.arange(13)
    expected = float(np.sum(binom.pmf(k, 12, 0.9) * np.abs(k / 12 - 0.9)))
    assert error_by_chance(np.full(120, 0.9)) == pytest.approx(expected, abs=0.003)
    assert error_by_chance(np.full(12000, 0.9)) < 0.15 * expected
    assert error_by_chance(np.ones(50)) == 0.0 and np.isnan(error_by_chance(np.zeros(0)))


def test_other_views_count_what_they_say() -> None:
    cases, terms = examined()
    effects = by(cases, "effect").set_index("effect")
    assert effects.loc["cabinet_heat", ["n", "visible", "right", "detected"]].tolist() == [10, 10, 0.8, 0.9]
    assert effects.loc["nothing", "false_claims"] == 0.1
    assert by(cases, "plant")["n"].tolist() == [10, 10]
    named = confusion(terms, "mechanism").set_index(["true", "named"])["count"]
    assert named.to_dict() == {
        ("cabinet_heat", "cabinet_heat"): 8, ("cabinet_heat", "nothing"): 1, ("cabinet_heat", "sun"): 1,
    }  # fmt: skip
    places = confusion(terms, "place").set_index(["true", "named"])["count"]
    assert places["column", "spindle"] == 1


def test_the_worst_come_first_with_a_reason() -> None:
    cases, _ = examined()
    table = worst(cases)
    assert table["case"].tolist() == ["case_0019", "case_0009", "case_0008"]
    check_snapshot(__file__, "worst", "".join(f"{why}\n" for why in table["why"]))
    assert list(table.columns) == [*OUTCOMES, "why"]


def test_a_listed_effect_that_is_called_unlisted_is_reported_so() -> None:
    own = stored("unlisted", finding("free_flux", parameters={}))
    cases, _ = outcomes({"case_0001": answer("one", term())}, {"case_0001": own}, {"case_0001": truth(True)})
    why = "cabinet_heat in plant volumes is listed and is reported as unlisted, at the right place."
    assert worst(cases)["why"].tolist() == [why]


def test_tables_come_back_from_csv_as_they_were(tmp_path: Any) -> None:
    cases, _ = examined()
    cases.to_csv(tmp_path / "outcomes.csv", index=False)
    again = pd.read_csv(tmp_path / "outcomes.csv", dtype=dict(OUTCOMES))
    pd.testing.assert_frame_equal(again, cases)
