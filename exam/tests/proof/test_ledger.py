"""The ledger: a chain in which every changed, lost, added or exchanged line shows, and what it says of a proof."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

from data.errors import InputError
from thermodrift_exam.proof.sealing.folder import LATE, START, TWICE, Ledger, state_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    ledger = Ledger(tmp_path / "ledger.jsonl")
    ledger.add("sealed", root="ab", source="00", number=2)
    ledger.add("run", source="cd")
    ledger.add("started", case="case_0001")
    ledger.add("answered", case="case_0001", answer="ef")
    return ledger.path


def test_each_line_holds_the_hash_of_the_line_before(path: Path) -> None:
    before = START
    for text in path.read_text(encoding="utf-8").splitlines():
        line = json.loads(text)
        told = line.pop("hash")
        plain = json.dumps(line, sort_keys=True, separators=(",", ":"))
        assert line["before"] == before and told == hashlib.sha256(plain.encode()).hexdigest()
        before = told
    assert before != START


def test_what_is_read_back_can_be_added_to(path: Path) -> None:
    ledger = Ledger(path)
    ledger.add("opened", answered=1)
    assert [e.step for e in Ledger(path).entries] == ["sealed", "run", "started", "answered", "opened"]
    assert Ledger(path).entries[3].summary == "case case_0001, answer ef"


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda t: [*t[:3], t[3].replace('"ef"', '"00"')], 4),
        (lambda t: [*t[:1], *t[2:]], 2),
        (lambda t: [t[0], t[2], t[1], t[3]], 2),
        (lambda t: [*t, t[3]], 5),
        (lambda t: t[1:], 1),
        (lambda t: [*t[:2], "not a line", *t[2:]], 3),
        (lambda t: [t[0].replace("20", "19", 1), *t[1:]], 1),
    ],
)  # fmt: skip
def test_a_line_that_was_tampered_with_is_named(path: Path, change: object, line: int) -> None:
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join(change(lines)) + "\n", encoding="utf-8")  # type: ignore[operator]
    with pytest.raises(InputError) as error:
        Ledger(path)
    assert str(error.value) == (
        f"ledger {path} line {line}: is not as it was written, the chain of hashes breaks there; "
        "this proof is void, seal a new one"
    )


def test_a_state_is_replayed_from_the_lines(path: Path) -> None:
    ledger = Ledger(path)
    ledger.add("started", case="case_0002")
    state = state_of(ledger.entries, "p")
    assert (state.root, state.source, dict(state.answered)) == ("ab", "cd", {"case_0001": "ef"})
    assert state.ran and not state_of(ledger.entries[:1], "p").ran and state_of(ledger.entries[:1], "p").source == "00"
    assert state.begun == {"case_0002"} and not state.void and state.opened is None
    ledger.add("interrupted", case="case_0002")
    ledger.add("answered", case="case_0001", answer="11")
    ledger.add("opened", answered=1)
    ledger.add("answered", case="case_0002", answer="22")
    state = state_of(ledger.entries, "p")
    assert dict(state.void) == {"case_0001": TWICE, "case_0002": LATE}
    assert state.interrupted == 1 and state.answered["case_0001"] == "ef" and state.opened is not None


def test_a_restart_drops_what_was_answered(path: Path) -> None:
    ledger = Ledger(path)
    ledger.add("restarted", dropped=1)
    ledger.add("answered", case="case_0001", answer="11")
    state = state_of(ledger.entries, "p")
    assert dict(state.answered) == {"case_0001": "11"} and not state.void and state.restarts == 1


def test_a_ledger_begins_with_the_seal(path: Path) -> None:
    with pytest.raises(InputError, match=r"^p: its ledger does not begin with the seal; seal a new proof$"):
        state_of(Ledger(path).entries[1:], "p")
