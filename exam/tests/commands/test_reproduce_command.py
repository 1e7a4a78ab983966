"""`thermodrift reproduce` as a user meets it: tables, page, files, and one line where something is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.toys.command import Call, in_process
from thermodrift_exam.studies import STUDIES
from thermodrift_exam.studies.base import Figure, Ordering, Study
from thermodrift_exam.studies.report import FILES


class ToyStudy(Study):
    """Half a figure below its rival in all seeds but one."""

    key = "toy_study"
    title = "Toy"
    summary, source, machine = "a toy & nothing else", "toy source", "toy, ±20 %"
    assumed = ("all of it",)
    remarks = ("On average {a} µm.",)
    figures = (
        Figure("a", "method A <new>", published=1.5, digits=1),
        Figure("b", "method B", digits=1),
    )
    orderings = (
        Ordering("a_better", "A is better than B", (("a", "b"),), 0.25, why="A has {a} µm."),
        Ordering("b_better", "B is better than A", (("b", "a"),), why="B has {b} µm."),
        Ordering("because", "A is below B", (("a", "b"),), evidence_for="a_better"),
    )

    def run(self, seed: int) -> dict[str, float]:
        return {"a": 1.0 + 0.01 * seed + 2.0 * (seed == 3), "b": 2.0}


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Call:
    """`thermodrift ARGS` in this process, in an empty folder, with the toy as the only study."""
    monkeypatch.setattr(STUDIES, "_members", {"toy_study": f"{__name__}:ToyStudy"})
    monkeypatch.chdir(tmp_path)
    return in_process(monkeypatch, capsys)


def test_tables_on_the_screen(call: Call) -> None:
    done = call("reproduce", "toy_study", "--seeds", 20, "--workers", 1)
    assert done.code == 0, done.err
    assert "toy_study (SIMULATED)" in done.out and done.out.count("SIMULATED") == 3
    flat = " ".join(done.out.split())
    assert "method A <new> µm 1.5 1.2 ± 0.4 1.0 … 1.3" in flat
    assert "holds 19/20 75 … 100 % 25 % 45 (36 … 50) % A is better than B" in flat
    assert "fails 1/20 0 … 25 %" in flat
    assert "why not always: B is better than A: B has 2.0 µm." in flat
    assert "On average 1.2 µm." in flat
    assert "A has 1.2" not in flat, "what holds needs no excuse"


def test_json_for_machines(call: Call) -> None:
    done = call("reproduce", "all", "--seeds", 3, "--workers", 1, "--json")
    told = json.loads(done.out)
    assert told["simulated"] is True and told["page"] is None
    (study,) = told["studies"]
    assert study["study"] == "toy_study" and study["seeds"] == [0, 1, 2]
    (a, b) = study["figures"]
    assert a["published"] == 1.5 and b["published"] is None and a["mean"] == pytest.approx(1.01)
    assert study["orderings"][0]["held"] == 3


def test_the_folder(call: Call, tmp_path: Path) -> None:
    done = call("reproduce", "toy_study", "--seeds", 4, "--workers", 1, "--out", "out")
    assert done.code == 0, done.err
    out = tmp_path / "out"
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    assert done.out.strip().endswith("page     out/reproduction.html")
    values = pd.read_parquet(out / "values.parquet")
    assert values["simulated"].all() and len(values) == 8
    np.testing.assert_allclose(values[values["figure"] == "a"]["value"], [1.0, 1.01, 1.02, 3.03])
    figures = pd.read_csv(out / "figures.csv")
    assert figures["published"].tolist()[0] == 1.5 and figures["simulated"].all()
    assert pd.read_csv(out / "orderings.csv")["held"].tolist() == [3, 3, 1]

    page = (out / "reproduction.html").read_text(encoding="utf-8")
    assert page.count("SIMULATED") >= 8 and "method A &lt;new&gt;" in page and "toy &amp; nothing" in page.lower()
    assert page.count("data:image/svg+xml;base64,") == 3, "the published figures and a picture per claim"
    assert "http://" not in page and "https://" not in page
    told = (out / "reproduction.md").read_text(encoding="utf-8")
    assert told.startswith("# Published systems repeated (SIMULATED)")
    assert "| A is better than B | undecided | 3 of 4 (19 % … 99 %) | 25 % \\| 49 (−36 … 50) % |" in told

    again = call("reproduce", "toy_study", "--seeds", 4, "--workers", 1, "--out", "out")
    assert again.code == 2 and "values.parquet exists; give another --out, or --overwrite" in again.err
    assert call("reproduce", "toy_study", "--seeds", 4, "--workers", 1, "--out", "out", "--overwrite").code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("toy_studi",), "unknown study 'toy_studi': did you mean 'toy_study'? Allowed: all, toy_study"),
        (("toy_study", "--seeds", 1), "seeds is 1; expected at least 2"),
        (("toy_study", "--workers", 0), "--workers: got 0, expected 1 or more"),
    ],
)
def test_what_cannot_be_is_told_in_one_line(call: Call, arguments: tuple[object, ...], words: str) -> None:
    done = call("reproduce", *arguments)
    assert done.code == 2 and words in done.err and len(done.err.strip().splitlines()) == 1
