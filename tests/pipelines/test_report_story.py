"""What became of a training, in sentences: every outcome word for word."""

from __future__ import annotations

import re

import pytest
from report_training import COMPARISON, Maker, promotion, results, training

from models.promotion import choose, score_of_choice
from models.protocols import PromotionRule
from reports.comparison.story import promoted_cell, verdict
from reports.labels import cell_label

RULE = PromotionRule()
SCORE = r"\d+\.\d+ ± \d+\.\d+ µm on left-out batches \(leave-batch-out, 6 batches\)"


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        (
            {"version": 1, "champion_version": 1, "against": None},
            rf"Version 1, {{cell}}, is champion: {SCORE}; it is the first model of this machine and channel\.",
        ),
        (
            {"comparison": COMPARISON},
            rf"Version 3, {{cell}}, is champion: {SCORE}; replaces version 2, 0\.60 µm better "
            r"\(90 %: 0\.20 to 1\.00 µm\) on 28 batches\.",
        ),
        (
            {
                "comparison": COMPARISON | {"better": False, "difference_um": -0.6, "low_um": -1.0, "high_um": -0.2},
                "forced": True,
            },
            rf"Version 3, {{cell}}, is champion: {SCORE}; replaces version 2 by force, 0\.60 µm worse "
            r"\(90 %: 0\.20 to 1\.00 µm\) on 28 batches\.",
        ),
        (
            {
                "outcome": "challenger",
                "champion_version": 2,
                "comparison": COMPARISON
                | {"better": False, "difference_um": -0.1, "low_um": -0.31, "high_um": 0.11, "p_value": 0.71},
            },
            rf"Version 2 stays champion; version 3, {{cell}}, is challenger: {SCORE}; on 28 batches it is "
            r"0\.10 µm worse \(90 %: −0\.11 to 0\.31 µm\), p = 0\.71: not shown to be better\.",
        ),
        (
            {
                "outcome": "challenger",
                "champion_version": 2,
                "comparison": COMPARISON
                | {"n_batches": 3, "words": "3 batches in common, need at least 5: the champion stays"},
            },
            rf"Version 2 stays champion; .*{SCORE}; 3 batches in common, need at least 5\.",
        ),
        (
            {
                "outcome": "challenger",
                "champion_version": 2,
                "obstacle": "gone",
            },
            rf"Version 2 stays champion; .*{SCORE}; it could not be compared with the champion \(gone\)\.",
        ),
        (
            {"outcome": "unchanged", "champion_version": 2},
            rf"Nothing new: batches, cell and machine file are those of version 3, {{cell}}: {SCORE}\. "
            r"Version 2 is champion\.",
        ),
    ],
)
def test_what_became_of_a_training_in_one_sentence(
    changes: dict[str, object], pattern: str, toy_batches: Maker
) -> None:
    result = results(toy_batches)["z"]
    choice = choose(result.cells, RULE)
    said = verdict("z", training(result, promotion(choice.cell, **changes)), choice)
    assert re.fullmatch(
        pattern.format(cell=re.escape(cell_label(choice.selector, choice.family, choice.n_tsp))), said.words
    ), said.words
    assert said.caution == ""


def test_the_price_of_choosing_is_told_as_recorded_or_computed(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    rule_cell = choose(result.cells, RULE)
    nested = score_of_choice(result, RULE)["S_um"]
    computed = promoted_cell(training(result), RULE, "leave-batch-out", nested=True)
    assert computed.nested_S_mean_um == pytest.approx(nested.mean())
    assert computed.nested_S_std_um == pytest.approx(nested.std())
    recorded = promotion(rule_cell.cell, nested_S_mean_um=9.44, nested_S_std_um=7.31)
    choice = promoted_cell(training(result, recorded), RULE, "leave-batch-out", nested=True)
    assert (choice.cell, choice.nested_S_mean_um, choice.nested_S_std_um) == (rule_cell.cell, 9.44, 7.31)
    said = verdict("z", training(result, recorded), choice).words
    assert re.search(
        r"6 batches; 9\.4\d? ± 7\.31? µm when a batch has no say in the choice of its model either\)", said
    )


def test_a_winner_that_luck_explains_is_not_trusted(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    reason = "each batch by the cell that the others chose: 9.44 ± 7.31 µm, no better than mean_curve (8.10 µm)"
    recorded = promotion(choose(result.cells, RULE).cell, caution=reason)
    said = verdict("z", training(result, recorded), choose(result.cells, RULE))
    assert said.caution == f"Do not trust this model: {reason}."


def test_nothing_promoted_and_nothing_to_trust_are_said(toy_batches: Maker) -> None:
    result = results(toy_batches)["z"]
    only = result.cells["family"].isin(["zero", "mean_curve"])
    choice = choose(result.cells[only], RULE)
    said = verdict("z", training(result), choice)
    assert said.words.startswith("Nothing was promoted. The rule would take mean curve: ")
    assert said.caution == "Do not trust this model: nothing beats mean_curve."
