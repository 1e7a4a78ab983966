"""Opening: everything is verified against seal and ledger before the keys are revealed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data.errors import InputError
from thermodrift_exam.proof.sealing.folder import (
    Entry,
    ProofFolder,
    State,
    digest_of,
    folder_digest,
    read_json,
    salted_digest,
    state_of,
    write_json,
)
from thermodrift_exam.proof.sealing.running import check_case
from thermodrift_exam.proof.sealing.seal import names_of

NOT_BEGUN = "it was not begun by the end of answering that was stated beforehand"
UNANSWERED = "it had no answer when the proof was opened"
LOST = "an answer is there that no run recorded"


@dataclass(frozen=True)
class Opened:
    """An opened proof: `answers` are the keys of all cases, `void` the cases that do not count with the reason."""

    commitment: Mapping[str, Any]
    answers: Mapping[str, Mapping[str, Any]]
    void: Mapping[str, str]
    partial: bool
    state: State
    entries: tuple[Entry, ...]

    @property
    def counting(self) -> tuple[str, ...]:
        """The cases that are scored."""
        return tuple(n for n in names_of(self.commitment) if n not in self.void)


def unseal(folder: ProofFolder, partial: bool = False) -> Opened:
    """Verify the proof and reveal the keys; `opened.json` allows anyone to verify it again.

    A proof may be opened again with the same result: answers after the first opening are void.

    Args:
        partial: cases without an answer become void instead of preventing the opening.

    Raises:
        InputError: no seal or no run; cases without answer; a ledger line, commitment, case, vault or answer that is
            not as it was recorded.
    """
    commitment = folder.committed()
    ledger = folder.ledger()
    state = state_of(ledger.entries, str(folder.path))
    _check_commitment(folder, commitment, state)
    if not state.ran:
        raise InputError(f"{folder.path}: no case was answered yet; call `thermodrift prove run {folder.path}` first")
    names = list(names_of(commitment))
    missing = [n for n in names if n not in state.answered and n not in state.void]
    late = {n: NOT_BEGUN for n in missing if state.until is not None and n not in state.begun}
    missing = [n for n in missing if n not in late]
    if missing and not partial and state.opened is None:
        raise InputError(
            f"{folder.path}: {len(missing)} of {len(names)} cases have no answer, the first is {missing[0]}; "
            f"call `thermodrift prove run {folder.path}`, or open it with --partial"
        )
    answers: dict[str, Mapping[str, Any]] = {}
    salts: dict[str, str] = {}
    for name in names:
        check_case(folder, name, commitment["cases"][name]["case"])
        salts[name], answers[name] = _answer(folder, name, commitment["cases"][name]["answer"])
    void = dict(state.void) | late | dict.fromkeys(missing, UNANSWERED)
    for name in set(state.answered) - set(void):
        _check_answer(folder, name, state.answered[name])
    void |= {n: LOST for n in (*missing, *late) if (folder.answers / n).exists()}
    suite = _suite_seed(folder, commitment)
    if state.opened is None:
        for name in (*late, *missing):
            ledger.add("void", case=name, why=void[name])
    ledger.add("opened", answered=len(state.answered), void=len(void), partial=bool(missing))
    state = state_of(ledger.entries, str(folder.path))
    write_json(
        folder.opened,
        {
            "schema": "thermodrift.proof_opened/1", "root": commitment["root"], "opened": state.opened,
            "partial": UNANSWERED in void.values(), "void": void, "suite": suite,
            "cases": {n: {"salt": salts[n], "answer": answers[n]} for n in names},
        },
    )  # fmt: skip
    return Opened(commitment, answers, void, UNANSWERED in void.values(), state, tuple(ledger.entries))


def _check_commitment(folder: ProofFolder, commitment: Mapping[str, Any], state: State) -> None:
    found = digest_of({k: v for k, v in commitment.items() if k != "root"})
    for stated, where in ((commitment.get("root"), "itself"), (state.root, "the ledger")):
        if found != stated:
            raise InputError(
                f"{folder.commitment}: is not as it was sealed, its root is {found[:12]}, {where} states "
                f"{str(stated)[:12]}; put it back or seal a new proof"
            )


def _answer(folder: ProofFolder, name: str, expected: str) -> tuple[str, Mapping[str, Any]]:
    """Salt and answer of a case."""
    path, kept = _kept(folder, name, ("cases", name))
    if salted_digest(str(kept["salt"]), kept["answer"]) != expected:
        raise InputError(f"{path}: is not the answer to {name} that was sealed; put it back or seal a new proof")
    return str(kept["salt"]), kept["answer"]


def _suite_seed(folder: ProofFolder, commitment: Mapping[str, Any]) -> dict[str, Any]:
    path, kept = _kept(folder, "suite", ("suite",))
    if commitment["suite_seed"] not in (kept["seed"], salted_digest(str(kept["salt"]), kept["seed"])):
        raise InputError(f"{path}: is not the seed that was sealed; put it back or seal a new proof")
    return dict(kept)


def _kept(folder: ProofFolder, name: str, keys: tuple[str, ...]) -> tuple[Path, Mapping[str, Any]]:
    """From the vault, or from `opened.json` of an opened proof without a vault."""
    path = folder.vault / f"{name}.json"
    if path.exists() or not folder.opened.exists():
        return path, read_json(path)
    kept = read_json(folder.opened)
    for key in keys:
        kept = kept[key]
    return folder.opened, kept


def _check_answer(folder: ProofFolder, name: str, expected: str) -> None:
    path = folder.answers / name
    if not path.is_dir() or folder_digest(path) != expected:
        raise InputError(f"{path}: is not the answer that the ledger recorded; put it back or seal a new proof")
