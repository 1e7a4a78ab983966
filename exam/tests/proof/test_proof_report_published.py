"""What a sealed run writes into exam/results/proof.md: its result between two markers, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from data.errors import InputError
from tests.proof.toy_proof import ROOT, toy_proof
from tests.toys.command import in_process
from thermodrift_exam.proof import proving
from thermodrift_exam.proof.report.markdown import BEGIN, END, proof_markdown, publish_proof
from thermodrift_exam.proof.report.tables import ProofRun
from thermodrift_exam.proof.scoring.tables import SILENT

PAGE = Path(__file__).parents[2] / "results" / "proof.md"


@pytest.fixture(scope="module")
def run() -> ProofRun:
    return toy_proof(30)


@pytest.fixture
def page(tmp_path: Path) -> Path:
    path = tmp_path / "proof.md"
    path.write_text(f"# Proof\n\n{BEGIN}\n\nwhat stood here\n{END}\n\nThe end.\n", encoding="utf-8")
    return path


def test_the_block_names_root_dates_version_results_and_shortfalls(run: ProofRun) -> None:
    text = proof_markdown(run)
    assert text.startswith("**10 of 12 goals met on 30 sealed cases.** SIMULATED\n")
    assert f"- Sealed root: `{ROOT}`\n" in text
    assert "- Sealed 2026-01-05 06:00 UTC, opened 2026-01-05 19:30 UTC, thermodrift 0.1.0\n" in text
    assert "- Cases: 31 sealed, 30 count, 1 void, 1 failed (counted as wrong)\n" in text
    row = next(line for line in text.splitlines() if line.startswith("| detection, visible"))
    assert row.startswith("| detection, visible | ≥ 97 % | 95.5 % | 93.6 to 97.4 % | 120 | **no** | 99.4 % (n 120) |")
    assert "- detection, visible: 95.5 %, goal ≥ 97 %\n" in text
    assert "A, finite elements (SIMULATED) | B, finite volumes (SIMULATED) |" in text


def test_a_plant_that_alone_misses_a_goal_is_named(run: ProofRun) -> None:
    goals = run.table("goals")
    goals = goals[goals["measure"] == "place exact"].assign(met=[True, False, True], value=[0.93, 0.90, 0.96])
    text = proof_markdown(replace(run, tables=dict(run.tables) | {"goals": goals}))
    assert "Missed goals:\n\n- plant A alone, place exact: 90.0 %, goal ≥ 92 %\n" in text
    met = proof_markdown(replace(run, tables=dict(run.tables) | {"goals": goals.assign(met=True)}))
    assert "No goal is missed on any plant." in met


def test_the_block_says_what_was_missed_and_claimed_falsely_and_why() -> None:
    run = toy_proof(60)
    text = proof_markdown(run)
    missed = run.table("missed")
    silent = missed[missed["reason"] == SILENT]
    row = next(line for line in text.splitlines() if line.startswith(f"| {SILENT} "))
    by_plant = [int((silent["plant"] == p).sum()) for p in ("elements", "volumes")]
    assert row == f"| {SILENT} | search | {by_plant[0]} | {by_plant[1]} | {len(silent)} |"
    assert "False claims, SIMULATED:\n" in text
    quiet = proof_markdown(replace(run, tables={k: v for k, v in run.tables.items() if k not in ("missed", "claims")}))
    assert "False claims" not in quiet and "limited by" not in quiet


def test_publishing_changes_the_block_alone_and_again_gives_the_same(page: Path, run: ProofRun) -> None:
    publish_proof(page, run)
    text = page.read_text(encoding="utf-8")
    assert text.startswith(f"# Proof\n\n{BEGIN}\n\n**10 of 12") and text.endswith(f"{END}\n\nThe end.\n")
    assert "what stood here" not in text
    publish_proof(page, run)
    assert page.read_text(encoding="utf-8") == text


@pytest.mark.parametrize(
    ("changed", "got"),
    [({"suite": "development"}, "a development suite"), ({"partial": True}, "a proof opened in part")],
)
def test_only_a_whole_sealed_suite_is_published(page: Path, run: ProofRun, changed: dict, got: str) -> None:
    before = page.read_text(encoding="utf-8")
    with pytest.raises(InputError, match=rf"got {got}, expected a sealed suite with all answers; leave --publish out"):
        publish_proof(page, replace(run, **changed))
    assert page.read_text(encoding="utf-8") == before


def test_a_page_without_markers_or_no_page_is_one_line(tmp_path: Path, run: ProofRun) -> None:
    bare = tmp_path / "bare.md"
    bare.write_text("# Proof\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"bare.md: expected one pair of lines <!-- result"):
        publish_proof(bare, run)
    with pytest.raises(InputError, match=r"none.md: cannot be read or written \(No such file or directory\); give"):
        publish_proof(tmp_path / "none.md", run)


def test_the_command_publishes_what_it_opened(
    page: Path, run: ProofRun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = run
    monkeypatch.setattr(proving, "open_proof", lambda *given, **named: proving.ProofOutcome(told, {}))
    call = in_process(monkeypatch, capsys)
    done = call("prove", "open", "PROOF", "--publish", page)
    assert done.code == 0, done.err
    assert ROOT in page.read_text(encoding="utf-8") and "30 answers as a whole" in done.out
    told = replace(run, suite="development")
    done = call("prove", "open", "PROOF", "--publish", page)
    assert done.code == 2 and "got a development suite, expected a sealed suite with all answers" in done.err


def test_the_docs_page_has_its_block() -> None:
    text = PAGE.read_text(encoding="utf-8")
    block = text.split(BEGIN)[1].split(END)[0]
    assert text.count(BEGIN) == text.count(END) == 1
    assert block.strip() == proof_markdown(None).strip() or "Sealed root: `" in block
