"""The whole proof in small, nothing replaced: fixed cases sealed, answered apart by the real diagnosis, opened.

It proves the chain, not the diagnosis: with six runs of four hours a case is too short to judge that. All six cases
(nothing missing, a decoy, one effect on either plant, two effects, one that no list holds) take minutes: `-m slow`. By
default `test_prove_command` walks the same chain with an examinee that answers at once.
"""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from thermodrift_exam.proof.proving import ProofOutcome, examinee, make_case, open_proof, run_proof
from thermodrift_exam.proof.scoring.goals import GOALS
from thermodrift_exam.proof.sealing.folder import ProofFolder
from thermodrift_exam.proof.sealing.seal import Suite, seal
from thermodrift_exam.proof.spec import CaseSpec
from thermodrift_exam.proof.suite import small_suite

WORKERS = 2
pytestmark = pytest.mark.slow
Proof = tuple[Path, ProofOutcome, list[CaseSpec]]


@pytest.fixture(scope="module")
def proof(tmp_path_factory: pytest.TempPathFactory) -> Proof:
    out, specs = tmp_path_factory.mktemp("small") / "proof", small_suite()
    seal(ProofFolder(out), Suite("development", specs, "small", secret=False), make_case, WORKERS)
    run_proof(out, WORKERS, by=examinee(limit_s=3600.0))  # no time is judged here
    return out, open_proof(out, WORKERS, deals=0), specs


def test_every_case_is_answered_apart_and_counts(proof: Proof) -> None:
    out, outcome, specs = proof
    r = outcome.run
    assert (r.cases, dict(r.void), dict(r.failed), r.partial) == (len(specs), {}, {}, False)
    assert sum(r.isolation.values()) == len(specs) and set(r.isolation) <= {"landlock and audit hook", "audit hook"}
    for name in (s.name for s in specs):
        assert {"findings.json", "rivals.json", "run.json", "series.csv"} <= {
            p.name for p in (out / "answers" / name).iterdir()
        }
        findings = json.loads((out / "answers" / name / "findings.json").read_text())
        assert findings["simulated"] and findings["machine"] in (out / "cases" / name / "machine.yml").read_text()


def test_the_same_specs_seal_the_same_cases(proof: Proof, tmp_path: Path) -> None:
    """Whoever has the key can draw any case again: here the first, its files compared by their digest."""
    from thermodrift_exam.proof.sealing.folder import folder_digest, salted_digest

    first = proof[2][0]
    opened = json.loads((proof[0] / "opened.json").read_text())["cases"][first.name]
    committed = json.loads((proof[0] / "commitment.json").read_text())["cases"][first.name]
    answer = make_case(first, tmp_path / "again")
    assert folder_digest(tmp_path / "again") == committed["case"]
    assert salted_digest(opened["salt"], answer) == committed["answer"]


def test_the_tables_hold_every_case_and_goal(proof: Proof) -> None:
    out, _, specs = proof
    cases = pd.read_csv(out / "outcomes.csv").set_index("case")
    assert cases["kind"].tolist() == [s.kind for s in specs]
    assert cases["plant"].tolist() == [s.plant for s in specs]
    assert not cases["failed"].any() and cases["verdict"].notna().all() and (cases["error_before"] > 0).all()
    assert cases["visible"].notna().sum() >= len(specs) // 2
    terms = pd.read_csv(out / "terms.csv")
    assert terms["effect"].tolist() == [e for s in specs for e in (*s.effects, *s.decoys)]
    goals = pd.read_csv(out / "goals.csv")
    assert {g.measure for g in GOALS} <= set(goals["measure"]) and {"all", *(s.plant for s in specs)} == set(
        goals["plant"]
    )
    compared = pd.read_csv(out / "compared.csv")
    assert {"baseline", "ablation", "diagnosis"} <= set(compared["group"])


def test_the_page_tells_the_root(proof: Proof) -> None:
    text = (proof[0] / "report.html").read_text(encoding="utf-8")
    assert proof[1].run.root in text and "SIMULATED" in text
