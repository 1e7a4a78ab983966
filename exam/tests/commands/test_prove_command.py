"""`thermodrift prove`: sealed, run and opened from the command line; the answers are canned, the cases are real."""

from __future__ import annotations

import json
from pathlib import Path
from threading import Event

import pytest

from data.machine import load_machine
from diagnosis.findings.schema import Findings, FitSummary, as_json
from tests.toys.command import Call, in_process
from thermodrift_exam.commands import prove
from thermodrift_exam.proof import judging as proof_judging
from thermodrift_exam.proof.scoring.true_model import TrueModel
from thermodrift_exam.proof.sealing import running
from thermodrift_exam.proof.sealing.running import Examinee

ASKED = ("--cases", 2, "--suite", "development", "--seed", 4, "--plants", "volumes", "--workers", 1)


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    return in_process(monkeypatch, capsys)


@pytest.fixture(autouse=True)
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The cases that were answered, each by "nothing is missing"; no true model is worked out."""
    cases: list[str] = []

    def examine(case: Path, by: Examinee, source: str, stop: Event | None = None) -> dict[str, bytes]:
        cases.append(f"{case.name} within {by.limit_s:g} s")
        ids = tuple(sorted(p.stem for p in (case / "recordings").iterdir()))
        fit = FitSummary(batches_improved=0, batches=len(ids))
        name = load_machine(case / "machine.yml").machine
        told = Findings(machine=name, batches=ids, verdict="consistent", fit=fit, seconds=1.0, simulated=True)
        run = {"seconds": 1.0, "cores": 1, "source_digest": source, "isolation": "none, a test", "error": None}
        return {"findings.json": as_json(told).encode(), "run.json": json.dumps(run).encode()}

    def true(machine: object, batches: object, key: dict[str, object]) -> tuple[TrueModel, str]:
        n = len(key["terms"])  # type: ignore[arg-type]
        sizes = ((None, None, None),) * n
        return TrueModel(2.0, 1.0, 1.0, (float("nan"),) * n, (9.0,) * n, (True,) * n, sizes), ""

    monkeypatch.setattr(running, "examine", examine)
    monkeypatch.setattr(proof_judging, "_true", true)
    return cases


def one_line(err: str) -> str:
    last = err.strip().splitlines()[-1]
    assert last.startswith("thermodrift: ")
    return last.removeprefix("thermodrift: ")


@pytest.mark.integration
def test_step_by_step(call: Call, asked: list[str], tmp_path: Path) -> None:
    proof = tmp_path / "proof"
    done = call("prove", "seal", *ASKED, "--out", proof)
    assert done.code == 0, done.err
    root = json.loads((proof / "commitment.json").read_text())["root"]
    assert f"root     {root}" in done.out and f"thermodrift prove run {proof}" in done.out
    assert sorted(p.name for p in (proof / "cases").iterdir()) == ["case_0001", "case_0002"]
    again = call("prove", "seal", *ASKED, "--out", proof)
    assert again.code == 2 and "holds a sealed proof already" in one_line(again.err)
    early = call("prove", "open", proof, "--deals", 0)
    assert early.code == 2 and "no case was answered yet; call `thermodrift prove run" in one_line(early.err)
    done = call("prove", "run", proof, "--workers", 1, "--limit", 9)
    assert done.code == 0 and "2 cases, 0 answered before, 2 now; 0 had been interrupted" in done.out
    assert asked == ["case_0001 within 9 s", "case_0002 within 9 s"]
    done = call("prove", "open", proof, "--workers", 1, "--deals", 0)
    assert done.code == 0, done.err
    assert root in done.out and "SIMULATED" in done.out and "false alarms" in done.out
    for name in ("outcomes.csv", "terms.csv", "goals.csv", "opened.json", "report.html"):
        assert (proof / name).stat().st_size > 0
    assert root in (proof / "report.html").read_text(encoding="utf-8")
    late = call("prove", "run", proof)
    assert late.code == 2 and "counts for nothing, seal a new proof" in one_line(late.err)
    steps = [json.loads(line)["step"] for line in (proof / "ledger.jsonl").read_text().splitlines()]
    assert steps == ["sealed", "run", *["started", "answered"] * 2, "opened", "scored"]


@pytest.mark.slow
def test_all_at_once_goes_on_where_it_stood(call: Call, asked: list[str], tmp_path: Path) -> None:
    proof = tmp_path / "proof"
    assert call("prove", "seal", *ASKED, "--out", proof).code == 0
    done = call("prove", *ASKED, "--out", proof, "--deals", 0, "--json")
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert (told["cases"], told["scored"], told["suite"], told["partial"]) == (2, 2, "development", False)
    assert told["isolation"] == {"none, a test": 2} and told["void"] == told["failed"] == {}
    assert {g["measure"] for g in told["goals"]} and Path(told["files"]["report.html"]).exists()
    again = json.loads(call("prove", *ASKED, "--out", proof, "--deals", 0, "--json").out)
    assert len(asked) == 2 and again["opened"] == told["opened"] and again["right"] == told["right"]
    other = call("prove", *ASKED, "--out", proof, "--cases", 3)
    assert other.code == 2
    assert one_line(other.err).endswith(
        "holds a development proof of 2 cases, requested is a development one of 3; give another --out"
    )


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("seal", "--cases", "0", "--out", "p"), "--cases: got 0, expected 1 or more"),
        (("seal",), "prove: got no folder for the proof; give --out PROOF"),
        (("seal", "--out", "p", "--seed", "3"), "--seed: got 3; a sealed suite is drawn from a secret, leave it out"),
        (("seal", "--out", "p", "--seed", "-3"), "--seed: got -3, expected 0 or more"),
        (("seal", "--out", "p", "--suite", "seald"), "--suite: unknown value 'seald': did you mean 'sealed'?"),
        (("seal", "--out", "p", "--plants", "volume"), "--plants: unknown value 'volume': did you mean 'volumes'?"),
        (("seal", "--out", "p", "--plants", "withheld"), "--plants withheld: is made of real recordings; give their"),
        (("seal", "--out", "p", "--plants", "withheld", "--data", "."), "--data .: holds no recordings of withheld; "),
        (("--cases", "2"), "prove: got no folder for the proof; give --out PROOF"),
        (("run", "p"), "p: is no sealed proof; call `thermodrift prove seal --out p` first"),
        (("run", "p", "--workers", "0"), "--workers: got 0, expected 1 or more"),
        (("run", "p", "--limit", "0"), "--limit: got 0, expected more than 0 seconds"),
        (("open", "p"), "p: is no sealed proof; call `thermodrift prove seal --out p` first"),
        (("open", "p", "--deals", "-1"), "--deals: got -1, expected 0 or more"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: tuple[str, ...], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = call("prove", *args)
    assert done.code == 2 and words in one_line(done.err)
    assert list(tmp_path.iterdir()) == []


def test_without_its_extra_it_says_what_to_install(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prove, "find_spec", lambda name: None)
    done = call("prove", "seal", *ASKED, "--out", "p")
    assert (done.code, done.out) == (2, "")
    assert one_line(done.err) == (
        "prove: package scikit-fem is not installed; run pip install 'thermodrift-exam[proof]'"
    )
