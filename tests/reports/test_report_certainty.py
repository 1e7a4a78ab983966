"""The part of the page that says how sure the models say they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from features.design import Design
from models.families.gaussian_process import GaussianProcess
from models.protocols import PromotionRule
from models.selection.crossing import Plan
from models.selection.grid import run_grid
from models.selection.promotion import choose
from models.selection.result import GridResult
from reports.comparison import write_report
from reports.comparison.certainty import certainty_table, verdict
from reports.comparison.tables import scored
from tests.toys.report_training import Maker, column, promotion, settings, table_after, training

RULE = PromotionRule()
LBO = "leave-batch-out"


@pytest.fixture(scope="module")
def result(toy_batches: Maker) -> GridResult:
    families = ("zero", "mean_curve", "pcr", "gaussian_process")
    plan = Plan(("none", "correlation"), families, (LBO, "leave-season-out"), n_tsps=(2,))
    ((_, found),) = run_grid(toy_batches(k=6, n=40, sensors=4), ["z"], plan).values()
    return found


def text_of(result: GridResult, folder: Path, suffix: str = "md", cell: str = "") -> str:
    page = [training(result, promotion(cell) if cell else None)]
    return write_report(page, folder / f"r.{suffix}", settings(folder).promotion).read_text(encoding="utf-8")


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
    assert verdict(mean, spread, n) == words


def test_a_new_season_is_asked_too() -> None:
    assert verdict(0.9, 0.2, 30, 0.78) == "calibrated, but too sure of a new season"
    assert verdict(0.9, 0.2, 30, 0.94) == "calibrated"


def test_the_share_inside_is_that_of_fits_done_one_by_one(
    result: GridResult, toy_batches: Maker, tmp_path: Path
) -> None:
    batches = toy_batches(k=6, n=40, sensors=4)
    inputs = tuple(
        result.cells.query("selector == 'none' and family == 'gaussian_process'")["inputs"].iloc[0].split("|")
    )
    inside, sd_um = [], []
    for left_out in batches:
        model = GaussianProcess().fit([b for b in batches if b is not left_out], inputs, "z")
        recorded = left_out.values("z") - left_out.values("z")[0]
        sd = model.sd_um(Design.build([left_out], inputs, None), [0])[0]
        inside.append(np.mean(np.abs(recorded - model.predict(left_out)) <= 1.6449 * sd))
        sd_um.append(sd.mean())
    cells = scored(result, LBO)
    only = cells[(cells["family"] != "gaussian_process") | (cells["selector"] == "none")]
    table = certainty_table("z", result, only, choose(result, RULE), 2)
    assert table is not None and [c.title for c in table.columns][5:7] == [
        "inside the 90 % interval",
        "season left out",
    ]
    (row,) = [r.cells for r in table.rows]
    assert row[:2] == ("gaussian process", "all sensors") and row[3] == f"{np.mean(sd_um):.2f}"
    assert row[5] == f"{100 * np.mean(inside):.0f} ± {100 * np.std(inside, ddof=1):.0f} %"
    season = result.cells.query(
        "protocol == 'leave-season-out' and selector == 'none' and family == 'gaussian_process'"
    )
    assert row[6] == f"{100 * season['coverage90'].item():.0f} %"


def test_the_page_shows_it_for_families_that_tell_and_marks_the_promoted(result: GridResult, tmp_path: Path) -> None:
    rows = table_after(
        text_of(result, tmp_path, cell="correlation|gaussian_process|2"), "z: how sure the models say they are"
    )
    assert {f.removesuffix(" (champion)") for f in column(rows, "family")} == {"gaussian process"}
    assert sum("(champion)" in f for f in column(rows, "family")) == 1
    every = ("calibrated", "calibrated, but too sure of a new season", "too sure", "too careful")
    assert {words.removeprefix("perhaps ") for words in column(rows, "it is")} <= set(every)
    assert "z: how sure the models say they are" in text_of(result, tmp_path, "html")


def test_where_no_family_tells_or_an_old_training_has_no_column_nothing_is_shown(
    result: GridResult, tmp_path: Path
) -> None:
    silent = {
        name: t[t["family"] != "gaussian_process"] for name in ("cells", "scores") if len(t := getattr(result, name))
    }
    assert "How sure" not in text_of(replace(result, **silent), tmp_path)
    old = replace(result, cells=result.cells.drop(columns=["coverage90", "sd_um"]),
                  scores=result.scores.drop(columns=["coverage90", "sd_um"]))  # fmt: skip
    assert "How sure" not in text_of(old, tmp_path)
