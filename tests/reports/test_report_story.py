"""The outcome of a training in sentences."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

from models.protocols import PromotionRule
from models.selection.promotion import choose, score_of_choice
from reports.comparison.story import mark_of, promoted_cell, verdict
from tests.snapshots import check_snapshot
from tests.toys.report_training import COMPARISON, Maker, promotion, results, training

RULE = PromotionRule()
WORSE = COMPARISON | {"better": False, "difference_um": -0.1, "low_um": -0.31, "high_um": 0.11, "p_value": 0.71}
FORCED = COMPARISON | {"better": False, "difference_um": -0.6, "low_um": -1.0, "high_um": -0.2}
FEW = COMPARISON | {"n_batches": 3, "words": "3 batches in common, need at least 5: the champion stays"}
OUTCOMES: dict[str, dict[str, object]] = {
    "first": {"version": 1, "champion_version": 1, "against": None},
    "better": {"comparison": COMPARISON},
    "rolled back": {"comparison": COMPARISON, "champion_version": 2},
    "forced": {"comparison": FORCED, "forced": True},
    "not better": {"outcome": "challenger", "champion_version": 2, "comparison": WORSE},
    "too few batches": {"outcome": "challenger", "champion_version": 2, "comparison": FEW},
    "not comparable": {"outcome": "challenger", "champion_version": 2, "obstacle": "gone"},
    "unchanged": {"outcome": "unchanged", "champion_version": 2},
}


def test_the_outcome_of_a_training_in_one_sentence(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    choice = choose(result, RULE)
    shown = {k: verdict("z", training(result, promotion(choice.cell, **c)), choice) for k, c in OUTCOMES.items()}
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
    said = verdict("z", training(result, recorded), choice).summary
    assert re.search(
        r": 9\.4\d? ± 7\.31? µm where the other batches choose the model of each \(forward, 4 batches\); 0\.7", said
    )


def test_a_winner_that_luck_explains_is_not_trusted(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    reason = "each batch by the cell that the others chose: 9.44 ± 7.31 µm, no better than mean_curve (8.10 µm)"
    recorded = promotion(choose(result, RULE).cell, caution=reason)
    said = verdict("z", training(result, recorded), choose(result, RULE))
    short = "each batch by the cell that the others chose: 9.44 ± 7.31 µm, no better than mean curve"
    assert (said.caution, said.outcome) == (f"No trustworthy model: {short}.", "untrusted")
    assert said.summary.endswith(f" Not trustworthy: {short} (8.10 µm).")


def test_a_provisional_model_has_its_badge_and_its_share(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    own = {"outcome": "provisional", "standing": "provisional", "authority": 0.6, "champion_version": None}
    recorded = promotion(choose(result, RULE).cell, caution="not shown to be better than zero", **own)
    said = verdict("z", training(result, recorded), choose(result, RULE))
    assert (said.chip, said.caution) == ("provisional", "Provisional: not shown to be better than no model.")
    assert "is provisional: " in said.summary and "0.6 of its correction" in said.summary
    assert mark_of(training(result, recorded)) == "provisional"


def test_the_recorded_outcome_counts_not_a_later_doubt(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    choice = replace(choose(result, RULE), caution="not shown to be better than zero")
    said = verdict("z", training(result, promotion(choice.cell)), choice)
    assert (said.outcome, said.chip, said.caution) == ("champion", "champion", "")


def test_nothing_promoted_and_nothing_to_trust_are_said(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    cells, scores = (t[t["family"].isin(["zero", "mean_curve"])] for t in (result.cells, result.scores))
    choice = choose(replace(result, cells=cells, scores=scores), RULE)
    said = verdict("z", training(result), choice)
    assert said.summary.startswith("Nothing was promoted. The rule would take mean curve: ")
    assert said.caution == "No trustworthy model: nothing beats mean curve."
