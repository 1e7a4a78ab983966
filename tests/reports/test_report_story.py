"""The outcome of a training in sentences."""

from __future__ import annotations

from dataclasses import replace

import pytest

from models.protocols import PromotionRule
from models.selection.promotion import choose, score_of_choice
from reports.comparison.story import mark_of, promoted_cell, verdict
from tests.snapshots import check_snapshot
from tests.toys.report_training import COMPARISON, Maker, promotion, results, training

RULE = PromotionRule()
OUTCOMES: dict[str, dict[str, object]] = {
    "first": {"version": 1, "champion_version": 1, "against": None},
    "rolled back": {"comparison": COMPARISON, "champion_version": 2},
    "challenger": {"outcome": "challenger", "champion_version": 2},
    "refused": {"outcome": "challenger", "champion_version": None},
}


def test_the_outcome_of_a_training_in_one_sentence(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    choice = choose(result, RULE)
    shown = {k: verdict(training(result, promotion(choice.cell, **c)), choice) for k, c in OUTCOMES.items()}
    assert all(v.caution == "" for v in shown.values())
    check_snapshot(__file__, "outcomes", "".join(f"{k}: {v.summary}\n" for k, v in shown.items()))


def test_the_price_of_choosing_is_told_as_recorded_or_computed(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    rule_cell = choose(result, RULE)
    nested = score_of_choice(result, RULE.only(rule_cell.protocol))
    nested = nested.loc[nested["protocol"] == rule_cell.protocol, "S_um"]
    computed = promoted_cell(training(result), RULE)
    assert computed.nested_S_mean_um == pytest.approx(nested.mean())
    assert computed.nested_S_std_um == pytest.approx(nested.std())
    recorded = promotion(rule_cell.cell, nested_S_mean_um=9.44, nested_S_std_um=7.31)
    choice = promoted_cell(training(result, recorded), RULE)
    assert (choice.cell, choice.nested_S_mean_um, choice.nested_S_std_um) == (rule_cell.cell, 9.44, 7.31)


def test_a_winner_that_luck_explains_is_not_trusted(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    reason = "each batch by the cell that the others chose: 9.44 ± 7.31 µm, no better than mean_curve (8.10 µm)"
    recorded = promotion(choose(result, RULE).cell, caution=reason)
    said = verdict(training(result, recorded), choose(result, RULE))
    short = "each batch by the cell that the others chose: 9.44 ± 7.31 µm, no better than mean curve"
    assert (said.caution, said.outcome) == (f"No trustworthy model: {short}.", "untrusted")
    assert said.summary.endswith(f" Not trustworthy: {short} (8.10 µm).")


def test_a_provisional_model_has_its_badge_and_its_share(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    own = {"outcome": "provisional", "standing": "provisional", "authority": 0.6, "champion_version": None}
    recorded = promotion(choose(result, RULE).cell, caution="not shown to be better than zero", **own)
    said = verdict(training(result, recorded), choose(result, RULE))
    assert (said.chip, said.caution) == ("provisional", "Provisional: not shown to be better than no model.")
    assert mark_of(training(result, recorded)) == "provisional"


def test_the_recorded_outcome_counts_not_a_later_doubt(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    choice = replace(choose(result, RULE), caution="not shown to be better than zero")
    said = verdict(training(result, promotion(choice.cell)), choice)
    assert (said.outcome, said.chip, said.caution) == ("champion", "champion", "")


def test_nothing_promoted_and_nothing_to_trust_are_said(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    cells, scores = (t[t["family"].isin(["zero", "mean_curve"])] for t in (result.cells, result.scores))
    choice = choose(replace(result, cells=cells, scores=scores), RULE)
    said = verdict(training(result), choice)
    assert said.summary.startswith("Nothing was promoted. The rule would take mean curve: ")
    assert said.caution == "No trustworthy model: nothing beats mean curve."
