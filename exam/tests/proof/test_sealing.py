"""Seal, run, open: the order is kept, and whatever is changed in between is noticed in one clear line."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from threading import Event

import pytest

from data.errors import InputError, WorkError
from tests.proof.toy_suite import EXAMINEE, make, sealed, specs
from thermodrift_exam.proof.sealing import running
from thermodrift_exam.proof.sealing.folder import ProofFolder
from thermodrift_exam.proof.sealing.opening import LOST, NOT_BEGUN, UNANSWERED, Opened, unseal
from thermodrift_exam.proof.sealing.running import Examinee, RunOutcome, run
from thermodrift_exam.proof.sealing.seal import Suite, seal

Asked = list[str]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """Cases that were asked for, in place of processes; a case that ends with "!" in the list fails."""
    cases: Asked = []

    def examine(case: Path, by: Examinee, source: str, stop: Event | None = None) -> dict[str, bytes]:
        cases.append(case.name)
        if f"{case.name}!" in cases:
            cases.remove(f"{case.name}!")
            raise WorkError("the answering process was stopped")
        return {"run.json": json.dumps({"case": case.name}).encode()}

    monkeypatch.setattr(running, "examine", examine)
    return cases


def opened(path: Path) -> Opened:
    folder = sealed(path)
    run(folder, EXAMINEE)
    return unseal(folder)


def test_a_seal_shows_no_answer_and_commits_to_each(tmp_path: Path) -> None:
    folder = sealed(tmp_path / "proof")
    commitment = json.loads(folder.commitment.read_text())
    for path in [folder.commitment, *folder.cases.rglob("*.*")]:
        assert "floor_sink" not in path.read_text()
    kept = json.loads((folder.vault / "case_0001.json").read_text())
    assert kept["answer"]["terms"] == [{"effect": "floor_sink"}]
    answer = json.dumps(kept["answer"], sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()
    by_hand = hashlib.sha256(bytes.fromhex(kept["salt"]) + answer).hexdigest()
    assert commitment["cases"]["case_0001"]["answer"] == by_hand
    without = {k: v for k, v in commitment.items() if k != "root"}
    plain = json.dumps(without, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert commitment["root"] == hashlib.sha256(plain.encode()).hexdigest()
    assert folder.vault.stat().st_mode & 0o777 == 0o700
    assert {p.stat().st_mode & 0o777 for p in folder.vault.iterdir()} == {0o600}
    salts = {json.loads(p.read_text())["salt"] for p in folder.vault.iterdir()}
    assert len(salts) == 4 and all(len(s) == 64 for s in salts)
    assert [e.step for e in folder.ledger().entries] == ["sealed"]


def test_a_secret_seed_is_committed_to_and_not_told(tmp_path: Path, asked: Asked) -> None:
    folder = ProofFolder(tmp_path / "proof")
    seal(folder, Suite("sealed", specs(1), "5eed" * 16, secret=True), make)
    assert "5eed5eed" not in folder.commitment.read_text()
    run(folder, EXAMINEE)
    vault = folder.vault / "suite.json"
    good = vault.read_text()
    vault.write_text(good.replace("5eed5eed", "5eed5eee", 1))
    with pytest.raises(InputError, match=r"suite\.json: is not the seed that was sealed; put it back or seal a new"):
        unseal(folder)
    vault.write_text(good)
    unseal(folder)
    assert json.loads(folder.opened.read_text())["suite"]["seed"] == "5eed" * 16


def test_a_broken_seal_is_begun_anew_and_a_whole_one_stays(tmp_path: Path) -> None:
    folder = ProofFolder(tmp_path / "proof")
    suite = Suite("development", specs(3), "7", secret=False)

    def broken(spec: object, into: Path) -> dict[str, object]:
        if into.name == "case_0002":
            raise WorkError("plant: no space left")
        return make(spec, into)  # type: ignore[arg-type]

    with pytest.raises(WorkError):
        seal(folder, suite, broken)
    assert not folder.is_sealed and (folder.cases / "case_0001" / "machine.yml").exists()
    seal(folder, suite, make)
    assert len(list(folder.cases.iterdir())) == 3
    with pytest.raises(InputError, match="holds a sealed proof already; run it, or give another --out"):
        seal(folder, suite, make)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(InputError, match=r"mine: holds letter\.txt, expected an empty folder; give another --out"):
        seal(ProofFolder(tmp_path / "mine"), suite, make)
    with pytest.raises(InputError, match="got 4 cases with 2 names; expected one name a case"):
        seal(ProofFolder(tmp_path / "other"), Suite("development", specs(2) * 2, "7", secret=False), make)


def test_several_workers_seal_the_same_cases(tmp_path: Path) -> None:
    one, two = sealed(tmp_path / "one"), ProofFolder(tmp_path / "two")
    told: list[int] = []
    seal(two, Suite("development", specs(3), "7", secret=False), make, workers=2, done=lambda s, n, of: told.append(n))
    cases = [json.loads(f.commitment.read_text())["cases"] for f in (one, two)]
    assert told == [1, 2, 3]
    assert [c["case"] for c in cases[0].values()] == [c["case"] for c in cases[1].values()]
    assert all(cases[0][n]["answer"] != cases[1][n]["answer"] for n in cases[0])  # other salts


def test_the_order_is_kept(tmp_path: Path, asked: Asked) -> None:
    with pytest.raises(InputError, match="empty: is no sealed proof; call `thermodrift prove seal --out"):
        run(ProofFolder(tmp_path / "empty"), EXAMINEE)
    folder = sealed(tmp_path / "proof")
    with pytest.raises(InputError, match="proof: no case was answered yet; call `thermodrift prove run"):
        unseal(folder)
    assert run(folder, EXAMINEE) == RunOutcome(3, 0, 3, 0, 0)
    assert unseal(folder).counting == ("case_0001", "case_0002", "case_0003")
    with pytest.raises(InputError, match=r"was opened at 20.*Z; a case answered after that counts for nothing, seal"):
        run(folder, EXAMINEE)
    assert asked == ["case_0001", "case_0002", "case_0003"]


def test_an_interrupted_run_goes_on_where_it_stood(tmp_path: Path, asked: Asked) -> None:
    folder = sealed(tmp_path / "proof")
    asked.append("case_0002!")
    with pytest.raises(WorkError):
        run(folder, EXAMINEE)
    (folder.answers / "case_0003").mkdir()  # stored, and killed before the ledger had it
    told: list[tuple[int, int]] = []
    asked.clear()
    outcome = run(folder, EXAMINEE, done=lambda step, n, of: told.append((n, of)))
    assert asked == ["case_0002", "case_0003"] and told == [(2, 3), (3, 3)]
    assert (outcome.before, outcome.answered) == (1, 2)
    entries = folder.ledger().entries
    assert [e.details["case"] for e in entries if e.step == "interrupted"] == ["case_0002"]
    assert unseal(folder).void == {}
    assert run_order(folder) == ["case_0001", "case_0002", "case_0003"]


def run_order(folder: ProofFolder) -> list[object]:
    return [e.details["case"] for e in folder.ledger().entries if e.step == "answered"]


def test_another_source_is_refused_or_drops_all(tmp_path: Path, asked: Asked, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = sealed(tmp_path / "proof")
    asked.append("case_0002!")
    with pytest.raises(WorkError):
        run(folder, EXAMINEE)
    monkeypatch.setattr(running, "source_digest", lambda: "f" * 64)
    with pytest.raises(
        InputError, match=r"is to be answered by source \w{12}, the source is now ffffffffffff; .* 1 answers so"
    ):
        run(folder, EXAMINEE)
    assert run(folder, EXAMINEE, restart=True).answered == 3
    assert (folder.path / "dropped_1" / "case_0001" / "run.json").exists()
    proof = unseal(folder)
    assert proof.state.restarts == 1 and not proof.void
    assert [e.details["dropped"] for e in proof.entries if e.step == "restarted"] == [1]


def test_a_source_that_changes_while_a_case_is_answered(
    tmp_path: Path, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = sealed(tmp_path / "proof")
    sealed_with = str(folder.ledger().entries[0].details["source"])
    digests = iter([sealed_with, sealed_with, "b" * 64])
    monkeypatch.setattr(running, "source_digest", lambda: next(digests))
    with pytest.raises(
        InputError, match=r"the source changed during the run, from \w{12} to bbbbbbbbbbbb; put it back"
    ):
        run(folder, EXAMINEE)
    assert run_order(folder) == ["case_0001"]


def test_two_at_a_time_answer_all(tmp_path: Path, asked: Asked) -> None:
    folder = sealed(tmp_path / "proof", n=5)
    run(folder, EXAMINEE, workers=2)
    assert sorted(asked) == sorted(map(str, run_order(folder))) == [f"case_{k:04d}" for k in range(1, 6)]


def test_opened_before_the_end_the_rest_is_void(tmp_path: Path, asked: Asked) -> None:
    folder = sealed(tmp_path / "proof")
    asked.append("case_0002!")
    with pytest.raises(WorkError):
        run(folder, EXAMINEE)
    with pytest.raises(InputError, match="2 of 3 cases have no answer, the first is case_0002; call `thermodrift"):
        unseal(folder)
    (folder.answers / "case_0003").mkdir()
    proof = unseal(folder, partial=True)
    assert proof.partial and proof.void == {"case_0002": UNANSWERED, "case_0003": LOST}
    assert proof.counting == ("case_0001",)
    again = unseal(folder)
    assert again.partial and again.void == proof.void and again.state.opened == proof.state.opened


def test_no_case_begins_after_the_end_that_was_stated_before(
    tmp_path: Path, asked: Asked, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, end = sealed(tmp_path / "proof"), datetime(2026, 1, 31, 12, tzinfo=UTC)
    times = iter([end - timedelta(seconds=1), end])

    class Clock(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return next(times)

    monkeypatch.setattr(running, "datetime", Clock)
    assert run(folder, EXAMINEE, until=end).answered == 1 and asked == ["case_0001"]
    with pytest.raises(InputError, match=r"--until: got None, expected 2026-01-31T12:00\+00:00, as before the first"):
        run(folder, EXAMINEE)
    proof = unseal(folder)
    assert not proof.partial and proof.state.until == "2026-01-31T12:00+00:00"
    assert proof.void == {"case_0002": NOT_BEGUN, "case_0003": NOT_BEGUN} and proof.counting == ("case_0001",)
    assert unseal(folder).void == proof.void


def test_an_answer_that_was_taken_away_or_given_twice_is_void(tmp_path: Path, asked: Asked) -> None:
    folder = sealed(tmp_path / "proof")
    run(folder, EXAMINEE)
    for file in (folder.answers / "case_0001").iterdir():
        file.unlink()
    (folder.answers / "case_0001").rmdir()
    assert run(folder, EXAMINEE).answered == 0
    ledger = folder.ledger()
    ledger.add("answered", case="case_0003", answer="00")
    proof = unseal(folder)
    assert proof.void == {"case_0001": "its answer was taken away", "case_0003": "it was answered twice"}
    assert proof.counting == ("case_0002",) and not proof.partial


def replaced(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(proof: Path) -> None:
        text = (proof / name).read_text()
        assert old in text
        (proof / name).write_text(text.replace(old, new, 1))

    return change


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (replaced("answers/case_0002/run.json", "case", "cave"), "case_0002: is not the answer that the ledger recor"),
        (replaced("cases/case_0001/machine.yml", "20,", "21,"), "case_0001: is not as it was sealed, digest "),
        (replaced("cases/case_0003/recordings/run_1.csv", "20.1", "20.2"), "case_0003: is not as it was sealed, dig"),
        (replaced("vault/case_0001.json", "floor_sink", "radiation"), "case_0001.json: is not the answer to case_0001"),
        (replaced("commitment.json", '"number": 3', '"number": 2'), "commitment.json: is not as it was sealed, its "),
        (replaced("ledger.jsonl", '"answered"', '"answerer"'), "line 4: is not as it was written, the chain of hash"),
        (lambda proof: (proof / "vault" / "case_0002.json").unlink(), "case_0002.json: cannot be read ([Errno 2] No"),
        (lambda proof: (proof / "cases" / "case_0002" / "key.txt").touch(), "case_0002: is not as it was sealed, di"),
        (lambda proof: (proof / "ledger.jsonl").unlink(), "proof: its ledger does not begin with the seal; seal a n"),
    ],
)  # fmt: skip
def test_what_was_changed_is_named(tmp_path: Path, asked: Asked, change: Callable[[Path], None], words: str) -> None:
    folder = sealed(tmp_path / "proof")
    run(folder, EXAMINEE)
    change(folder.path)
    with pytest.raises(InputError) as error:
        unseal(folder)
    assert words in str(error.value) and "\n" not in str(error.value)


def test_an_opened_proof_is_checked_again_without_its_vault(tmp_path: Path, asked: Asked) -> None:
    folder = sealed(tmp_path / "proof")
    run(folder, EXAMINEE)
    first = unseal(folder)
    for path in folder.vault.iterdir():
        path.unlink()
    assert unseal(folder).answers == first.answers
    replaced("opened.json", "floor_sink", "radiation")(folder.path)
    with pytest.raises(InputError, match=r"opened\.json: is not the answer to case_0001 that was sealed; put it back"):
        unseal(folder)


def test_a_case_changed_before_the_run_is_not_asked(tmp_path: Path, asked: Asked) -> None:
    folder = sealed(tmp_path / "proof")
    replaced("cases/case_0001/machine.yml", "20,", "21,")(folder.path)
    with pytest.raises(InputError, match="case_0001: is not as it was sealed, digest"):
        run(folder, EXAMINEE)
    assert not asked


def test_one_at_a_time_works_on_a_proof(tmp_path: Path, asked: Asked) -> None:
    folder = sealed(tmp_path / "proof")
    with folder.locked(), pytest.raises(InputError, match="proof: another process works on this proof; wait for its"):
        run(ProofFolder(folder.path), EXAMINEE)
    assert not asked


@pytest.mark.slow
def test_answers_come_from_processes_of_their_own(tmp_path: Path) -> None:
    proof = opened(tmp_path / "proof")
    stored = tmp_path / "proof" / "answers" / "case_0002"
    assert json.loads((stored / "findings.json").read_text())["verdict"] == "consistent"
    assert json.loads((stored / "rivals.json").read_text())["reference"]["verdict"] == "consistent"
    assert (stored / "next_run.yml").read_text() == "hours: 3\n"
    assert (stored / "series.csv").read_text() == "channel,time_s,recorded\nz,300,1\n"  # z is worst by its noise
    assert proof.answers["case_0002"]["kind"] == "nothing" and not proof.void
