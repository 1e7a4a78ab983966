"""The record of sealed proofs: its table on the pages, its agreement with the published goal tables, a new run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from data.errors import InputError
from tests.proof.toy_proof import ROOT, toy_proof
from thermodrift_exam.proof.report.markdown import BEGIN, END, RUNS_BEGIN, RUNS_END, publish_proof, record_of, with_runs
from thermodrift_exam.proof.report.runs import FIGURES, GOAL_COLUMNS, RUN_COLUMNS, read_runs, runs_markdown

REPOSITORY = Path(__file__).parents[3]
RECORD = REPOSITORY / "exam" / "thermodrift_exam" / "proof" / "runs" / "runs.csv"
PAGES = [REPOSITORY / "exam" / "results" / name for name in ("proof.md", "proof_real.md")]


def goals_of(folder: Path, root: str) -> pd.DataFrame:
    return pd.read_csv(folder / "goals" / f"{root[:8]}.csv", dtype=str, keep_default_na=False)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_the_pages_show_the_record(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    path = record_of(page, text)
    assert path is not None and path.resolve() == RECORD
    table = read_runs(path)
    shown = text.split("Sealed root: `")[1].split("`")[0]
    plants = table.set_index("root").at[shown, "plants"]
    assert with_runs(text, table, plants) == text


def test_the_record_agrees_with_the_published_goal_tables() -> None:
    table = read_runs(RECORD)
    opened = table[table["status"] == "opened"]
    assert len(opened) == len(list((RECORD.parent / "goals").glob("*.csv"))) and table["root"].is_unique
    for row in opened.to_dict("records"):
        goals = goals_of(RECORD.parent, str(row["root"]))
        whole = goals[goals["plant"] == "all"].set_index("measure")
        met = whole["met"]
        assert row["goals_met"] == str(int((met == "yes").sum())) and row["goals"] == str(int((met != "").sum()))
        for f in FIGURES:
            shown = whole.at[f.measure, "value" if f.of == "value" else "truth_known"]
            assert f"{row[f.column]} {f.unit}".strip() == shown or (not row[f.column] and not shown), f.column
            assert not f.n_column or row[f.n_column] == whole.at[f.measure, "n"]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_the_result_on_a_page_is_that_of_its_goal_table(page: Path) -> None:
    block = page.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0]
    goals = goals_of(RECORD.parent, block.split("Sealed root: `")[1][:8])
    for row in goals[goals["plant"] == "all"].to_dict("records"):
        cells = [row[c] or "–" for c in ("measure", "goal", "value", "interval90", "n")]
        assert f"| {' | '.join(cells)} | " in block


@pytest.fixture
def page(tmp_path: Path) -> Path:
    (tmp_path / "runs.csv").write_text(RECORD.read_text(encoding="utf-8"), encoding="utf-8")
    path = tmp_path / "proof.md"
    path.write_text(f"{BEGIN}\n{END}\n\n{RUNS_BEGIN}runs.csv -->\n{RUNS_END}\n\nThe end.\n", encoding="utf-8")
    return path


def test_publishing_adds_a_run_to_the_record_once(page: Path) -> None:
    run = toy_proof(30)
    before = read_runs(RECORD)
    publish_proof(page, run)
    publish_proof(page, run)
    table = read_runs(page.parent / "runs.csv").set_index("root")
    assert len(table) == len(before) + 1
    row = table.loc[ROOT]
    assert (row["status"], row["sealed_utc"], row["cases"], row["goals_met"]) == (
        "opened",
        "2026-01-05T06:00Z",
        "31",
        "10",
    )
    assert (row["detection_percent"], row["plants"]) == ("95.5", "elements volumes")
    pd.testing.assert_frame_equal(table.drop(index=ROOT).reset_index(), before)
    goals = goals_of(page.parent, ROOT)
    assert list(goals) == list(GOAL_COLUMNS) and set(goals["plant"]) == {"all", "elements", "volumes"}
    text = page.read_text(encoding="utf-8")
    assert f"| {ROOT[:8]} |" in text and "| 10 of 12 |" in text and text.endswith(f"{RUNS_END}\n\nThe end.\n")


def test_a_note_stays_when_a_run_is_published_again(page: Path) -> None:
    run = toy_proof(30)
    publish_proof(page, run)
    path = page.parent / "runs.csv"
    table = read_runs(path)
    table.loc[table["root"] == ROOT, "note"] = "Scored twice."
    table.to_csv(path, index=False)
    publish_proof(page, replace(run, failed={}))
    assert f"- `{ROOT[:8]}`: Scored twice.\n" in page.read_text(encoding="utf-8")
    assert read_runs(path).set_index("root").at[ROOT, "failed"] == "0"


def test_roots_without_a_result_stand_apart() -> None:
    table = read_runs(RECORD)
    text = runs_markdown(table, "elements volumes")
    top, bottom = text.split("Sealed roots without a result:")
    for row in table[table["plants"] == "elements volumes"].to_dict("records"):
        assert (f"| {row['root'][:8]} |" in top) == row["status"].startswith("opened")
        assert (f"`{row['root']}`" in bottom) == (not row["status"].startswith("opened"))


def test_a_record_that_cannot_be_used_is_one_line(tmp_path: Path, page: Path) -> None:
    with pytest.raises(InputError, match=r"none.csv: cannot be read"):
        read_runs(tmp_path / "none.csv")
    (page.parent / "runs.csv").write_text("root,suite\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"runs.csv: got no column plants, status, .*, expected root, suite"):
        publish_proof(page, toy_proof(30))
    assert set(RUN_COLUMNS) >= {f.column for f in FIGURES}
