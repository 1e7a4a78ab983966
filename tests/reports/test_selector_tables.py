"""The table of the selectors' weaknesses: every measured row in words, none lost, none invented."""

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from features.design import Design
from features.selectors import SELECTORS
from features.selectors.base import Diagnostic
from models.selection.result import GridResult
from reports.comparison import write_report
from reports.comparison.certainty import MEANINGS, diagnostics_table
from reports.labels import selector_label
from reports.layout import Table
from tests.toys.report_training import Maker, column, results, settings, table_after, training

CAPTION = "z: known weaknesses of the selectors"


def test_the_page_and_the_text_hold_every_measured_row(toy_batches: Maker, tmp_path: Path) -> None:
    result = results(toy_batches)["z"]
    measured = result.selector_diagnostics
    assert set(measured["selector"]) == {"correlation", "pca_elimination"}
    for suffix in ("md", "html"):
        write_report([training(result)], tmp_path / f"r.{suffix}", settings(tmp_path).promotion)
    rows = table_after((tmp_path / "r.md").read_text(), CAPTION)
    own = measured[measured["statistic"] != "stability over batches"]
    stable = measured[measured["statistic"] == "stability over batches"].set_index("selector")
    assert column(rows, "here") == own["comment"].tolist() and len(own) >= 1
    for name, value, row in zip(
        column(rows, "selector"), column(rows, "stability"), own.to_dict("records"), strict=True
    ):
        fine = row["ok"] and stable["ok"][row["selector"]]
        assert name == selector_label(row["selector"]) + ("" if fine else " (look)")
        assert value == f"{stable['value'][row['selector']]:.2f}"
    assert CAPTION in (tmp_path / "r.html").read_text()


def table_of(result: GridResult, *found: Diagnostic) -> Table:
    rows = pd.DataFrame([{"selector": "kmedoids", "n_tsp": 3, **vars(d)} for d in found])
    table = diagnostics_table("z", replace(result, selector_diagnostics=rows))
    assert table is not None
    return table


def test_limits_say_their_side(toy_batches: Maker) -> None:
    table = table_of(
        results(toy_batches)["z"],
        Diagnostic("stability over batches", 0.9, 0.7, True, "d"),
        Diagnostic("mean silhouette", 0.1, 0.25, False, "a"),
        Diagnostic("largest VIF left", 4.0, 10.0, True, "b"),
        Diagnostic("something new", 12.0, 10.0, False, "c"),
    )
    assert [r.cells[:3] for r in table.rows] == [("k-medoids", "3", "0.90")] * 3
    assert [r.cells[5] for r in table.rows] == ["at least 0.25", "at most 10.00", "at most 10.00"]
    assert [r.mark for r in table.rows] == ["look", "", "look"]
    assert table.rows[2].cells[3] == "something new"


def test_an_unstable_choice_is_marked_whatever_else_is_fine(toy_batches: Maker) -> None:
    unstable = Diagnostic("stability over batches", 0.4, 0.7, False, "not in every fold: t1 50 %")
    alone = table_of(results(toy_batches)["z"], unstable)
    assert alone.rows[0].mark == "look" and alone.rows[0].cells[-1] == "not in every fold: t1 50 %"
    fine = Diagnostic("mean silhouette", 0.6, 0.25, True, "a")
    assert [r.mark for r in table_of(results(toy_batches)["z"], unstable, fine).rows] == ["look"]


def test_a_result_of_an_older_version_has_no_such_table(toy_batches: Maker, tmp_path: Path) -> None:
    older = replace(results(toy_batches)["z"], selector_diagnostics=pd.DataFrame())
    assert diagnostics_table("z", older) is None
    write_report([training(older)], tmp_path / "r.md", settings(tmp_path).promotion)
    assert "known weaknesses" not in (tmp_path / "r.md").read_text()


@pytest.mark.parametrize("key", SELECTORS)
def test_every_statistic_has_words(key: str, toy_batches: Maker) -> None:
    batches = toy_batches(k=4, n=40, sensors=4)
    design = Design.build(batches, batches[0].names("temperature"), "z")
    for n in (2, 3):
        assert {d.statistic for d in SELECTORS[key]().diagnostics(design, range(4), n)} <= set(MEANINGS)
