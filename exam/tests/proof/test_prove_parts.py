"""Parts of a proof: real recordings among its cases, the proposed run done, what is kept, the ledger as a table."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest

from data.errors import InputError
from thermodrift_exam.proof import judging as proof_again
from thermodrift_exam.proof.judging import plain_json, truth_from_json
from thermodrift_exam.proof.proving import ProofRequest, drawn, examinee, specs_of
from thermodrift_exam.proof.scoring.true_model import TrueModel
from thermodrift_exam.proof.sealing.folder import Ledger
from thermodrift_exam.proof.sealing.running import Examinee
from thermodrift_exam.proof.spec import CaseSpec
from thermodrift_exam.proof.tables import ledger_table


def test_real_cases_follow_the_simulated_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def real_suite(seed: int, data: Path, which: str, plants: list[str], first: int) -> list[CaseSpec]:
        assert (seed, data, which) == (5, tmp_path, "development")
        return [CaseSpec(f"case_{first + k:04d}", "one", p, 1) for k, p in enumerate(plants)]  # type: ignore[arg-type]

    monkeypatch.setattr("thermodrift_exam.proof.suite.real_suite", real_suite)
    asked = ProofRequest(tmp_path, 4, "development", ("volumes", "grafted", "withheld"), 5, tmp_path)
    suite = drawn(asked)
    assert (suite.seed, suite.secret) == ("5", False)
    assert [(s.name, s.plant) for s in suite.specs[3:]] == [  # type: ignore[attr-defined]
        ("case_0004", "volumes"), ("case_0005", "grafted"), ("case_0006", "withheld"),
    ]  # fmt: skip
    alone = specs_of(replace(asked, plants=("withheld",)), 5)
    assert [(s.name, s.plant) for s in alone] == [("case_0001", "withheld")]


def test_a_sealed_suite_has_a_secret_of_its_own(tmp_path: Path) -> None:
    one, two = (drawn(ProofRequest(tmp_path, 3, "sealed", ("volumes",))) for _ in range(2))
    assert one.secret and len(one.seed) == 64 and one.seed != two.seed
    assert {s.seed for s in one.specs}.isdisjoint(s.seed for s in two.specs)  # type: ignore[attr-defined]


def test_a_true_model_is_kept_as_it_is() -> None:
    truth = TrueModel(3.0, math.nan, 1.0, (7.5, math.nan), (4.0, math.nan), (True, None),
                      ((50.0, 40.0, 60.0), (None, None, None)))  # fmt: skip
    back = truth_from_json(plain_json(vars(truth)))
    assert back is not None and repr(back) == repr(truth)
    assert truth_from_json(None) is None


def test_ablations_run_on_the_first_cases_alone() -> None:
    by = examinee(ablated=2)
    assert [by.of(k).baselines for k in range(4)] == ["thermodrift_rivals:replies"] * 2 + [by.cheap] * 2
    assert {examinee().of(k).baselines for k in (0, 500)} == {"thermodrift_rivals:replies"}


def test_the_proposed_run_is_one_more_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "case" / "recordings").mkdir(parents=True)
    (tmp_path / "kept").mkdir()
    seen: list[list[str]] = []

    def add(case: Path, plan: str, key: object) -> None:
        if plan == "impossible":
            raise InputError("plan: no such driver")
        (case / "recordings" / f"{plan}.csv").touch()

    def examine(case: Path, by: Examinee, source: str) -> dict[str, bytes]:
        assert by.baselines is None
        seen.append([p.name for p in (case / "recordings").iterdir()])
        return {"run.json": b'{"source_digest": "' + source.encode() + b'"}'}

    monkeypatch.setattr(proof_again, "_add", add)
    monkeypatch.setattr(proof_again, "examine", examine)
    kept = tmp_path / "kept" / "case"
    assert proof_again.executed(tmp_path / "case", "night", {}, kept) is None  # it failed: there are no findings
    assert proof_again.executed(tmp_path / "case", "night", {}, kept) is None
    assert seen == [["night.csv"]] and not list((tmp_path / "case" / "recordings").iterdir())
    assert proof_again.executed(tmp_path / "case", "impossible", {}, tmp_path / "kept" / "other") is None
    assert len(seen) == 1


def test_the_ledger_counts_cases_between_steps(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "ledger.jsonl")
    ledger.add("sealed", root="ab", number=3)
    ledger.add("run", source="cd")
    for case in ("case_0001", "case_0002"):
        ledger.add("started", case=case)
        ledger.add("answered", case=case, answer="ef")
    ledger.add("run", source="cd")
    ledger.add("interrupted", case="case_0003")
    table = ledger_table(ledger.entries)
    assert table["step"].tolist() == ["sealed", "run", "answered", "run", "interrupted"]
    assert table["words"].tolist() == ["root ab, number 3", "source cd", "2 cases", "source cd", "1 case"]
