"""The part of the page that says how sure the models are: stated intervals, selectors, the error to expect of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from features.design import Design
from models.families.gaussian_process import GaussianProcess
from models.protocols import PromotionRule
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from models.selection.promotion import choose
from models.selection.result import GridResult
from models.selection.trust import COLUMNS
from reports.comparison.page import page as page_of
from reports.comparison.story import certainty, certainty_verdict, weaknesses
from reports.comparison.tables import bounds
from reports.layout import Pairs
from tests.toys.pages import blocks
from tests.toys.report_training import Maker, promotion, training

RULE = PromotionRule()
LBO = "leave-batch-out"


@pytest.fixture(scope="module")
def result(toy_batches: Maker) -> GridResult:
    families = ("zero", "mean_curve", "pcr", "gaussian_process")
    plan = Plan(("none", "correlation"), families, (LBO, "leave-season-out"), n_tsps=(2,))
    ((_, found),) = run_grid(toy_batches(k=6, n=40, sensors=4), ["z"], plan).values()
    return found


@pytest.mark.parametrize(
    ("mean", "spread", "n", "words"),
    [
        (0.90, 0.25, 30, "calibrated"),
        (0.851, 0.01, 30, "calibrated"),
        (0.80, 0.10, 30, "too sure"),
        (0.80, 0.40, 30, "perhaps too sure"),
        (0.99, 0.02, 30, "too careful"),
        (0.97, 0.30, 9, "perhaps too careful"),
        (0.20, float("nan"), 1, "perhaps too sure"),
        (float("nan"), float("nan"), 0, "–"),
    ],
)
def test_the_verdict_in_plain_words(mean: float, spread: float, n: int, words: str) -> None:
    assert certainty_verdict(mean, spread, n) == words


def test_a_new_season_is_asked_too() -> None:
    assert certainty_verdict(0.9, 0.2, 30, 0.78) == "calibrated, but too sure of a new season"
    assert certainty_verdict(0.9, 0.2, 30, 0.94) == "calibrated"


def test_the_share_inside_is_that_of_fits_done_one_by_one(result: GridResult, toy_batches: Maker) -> None:
    batches = toy_batches(k=6, n=40, sensors=4)
    inputs = tuple(
        result.cells.query("selector == 'none' and family == 'gaussian_process'")["inputs"].iloc[0].split("|")
    )
    inside = []
    for left_out in batches:
        model = GaussianProcess().fit([b for b in batches if b is not left_out], inputs, "z")
        recorded = left_out.values("z") - left_out.values("z")[0]
        sd = model.sd_um(Design.build([left_out], inputs, None), [0])[0]
        inside.append(np.mean(np.abs(recorded - model.predict(left_out)) <= 1.6449 * sd))
    choice = replace(choose(result, RULE), selector="none", family="gaussian_process", n_tsp=5, protocol=LBO)
    season = result.cells.query(
        "protocol == 'leave-season-out' and selector == 'none' and family == 'gaussian_process'"
    )
    said = certainty(result, choice)
    assert said.startswith(
        f"{100 * np.mean(inside):.0f} ± {100 * np.std(inside, ddof=1):.0f} % ({LBO}, mean ± std of batches), "
        f"{100 * season['coverage90'].item():.0f} % where whole seasons are left out: "
    )
    page = page_of([training(result, promotion("none|gaussian_process|5"))], RULE)
    (facts,) = [b for b in blocks(page, Pairs) if b.look == "pairs"]
    seasons = f"{100 * season['coverage90'].item():.0f} ± "
    assert dict(facts.entries)["inside the stated 90 % interval"].startswith(seasons), "the protocol of the choice"


def test_a_family_that_states_no_interval_and_an_old_training_say_nothing(result: GridResult) -> None:
    choice = replace(choose(result, RULE), selector="none", family="pcr", n_tsp=5)
    assert certainty(result, choice) == ""
    old = replace(result, scores=result.scores.drop(columns=["coverage90", "sd_um"]))
    assert certainty(old, replace(choice, family="gaussian_process")) == ""


def test_the_weaknesses_of_the_chosen_selector_are_named(result: GridResult) -> None:
    rows = [("kmedoids", 3, "mean silhouette", 0.1, 0.25, False, "too few groups"),
            ("kmedoids", 3, "largest VIF left", 4.0, 10.0, True, "fine"),
            ("fcgc", 3, "mean silhouette", 0.1, 0.25, False, "of another")]  # fmt: skip
    names = ["selector", "n_tsp", "statistic", "value", "threshold", "ok", "comment"]
    choice = replace(choose(result, RULE), selector="kmedoids")
    found = replace(result, selector_diagnostics=pd.DataFrame(rows, columns=names))
    assert weaknesses(found, choice) == ["mean silhouette 0.10: too few groups"]
    assert weaknesses(replace(result, selector_diagnostics=pd.DataFrame()), choice) == []


def left_out() -> pd.DataFrame:
    """Twelve runs left out one by one, and each twice as bad as a later run that is half a width out."""
    start, rows = pd.Timestamp("2026-01-01"), []
    for k in range(12):
        rows.append(("c", "leave-batch-out", f"b{k}", f"b{k}", start, 0.0, "", 9.0, 1.0, 2.0 + k))
        rows.append(("c", "forward", "autumn", f"b{k}", start, 0.5, "room@start", 9.0, 2.0, 4.0 + 2 * k))
        rows.append(("c", "train-on-one", "b0", f"b{k}", start, 3.0, "bed@start", 9.0, 3.0, 90.0))
    return pd.DataFrame(rows, columns=COLUMNS)


def test_the_table_compares_every_protocol_with_the_bound() -> None:
    table = bounds("z", left_out(), 1)
    assert table is not None
    later, near = (row.cells for row in table.rows)
    assert later[:3] == ("forward", "12", "15.0") and near[:3] == ("leave-batch-out", "12", "7.5")
    assert float(str(later[3])) > float(str(near[3])) and float(str(later[4])) > float(str(later[3]))
    assert str(later[5]).endswith(" %")
    assert table.notes[1] == "Later runs left the trained region most often in room@start (12)."


def test_tables_of_older_trainings_and_without_runs_are_read() -> None:
    older = left_out().drop(columns=["start", "predicted_rms_um", "disagreement_um"])
    assert bounds("z", older, 1) is not None
    for nothing in (pd.DataFrame(), left_out().query("protocol == 'train-on-one'")):
        assert bounds("z", nothing, 1) is None
