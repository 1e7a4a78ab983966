"""The run: every case answered once, each by a process of its own, under one and the same source."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from uuid import uuid4

from data.errors import InputError
from twin.proof.sealing.digests import folder_digest, source_digest
from twin.proof.sealing.examining import Examinee, examine
from twin.proof.sealing.folder import ProofFolder
from twin.proof.sealing.ledger import Ledger
from twin.proof.sealing.seal import Done, names_of
from twin.proof.sealing.state import State, state_of


@dataclass(frozen=True)
class RunOutcome:
    """How many cases there are, how many were answered before and by this run, begun anew, and void."""

    cases: int
    before: int
    answered: int
    interrupted: int
    void: int


def run(
    folder: ProofFolder, by: Examinee, workers: int = 1, restart: bool = False, done: Done | None = None
) -> RunOutcome:
    """Answer every case that has no answer yet; what is there is kept, what was interrupted starts again.

    Args:
        restart: drop all answers of another source and begin anew; the ledger says so.

    Raises:
        InputError: not sealed, opened already, another source than the earlier answers', a changed case.
        WorkError: an answering process could not be started, or the folder cannot be written.
    """
    commitment = folder.committed()
    with folder.locked():
        ledger = folder.ledger()
        state = state_of(ledger.entries, str(folder.path))
        if state.opened is not None:
            raise InputError(
                f"{folder.path}: was opened at {state.opened}; a case answered after that counts for nothing, "
                "seal a new proof"
            )
        source = source_digest()
        state = _resumed(folder, ledger, state, source, restart)
        names = list(names_of(commitment))
        waiting = [n for n in names if n not in state.answered and n not in state.void]
        ledger.add("run", source=source, cases=len(waiting), workers=workers)
        told = len(names) - len(waiting)

        def answered(case: str, files: dict[str, bytes]) -> None:
            nonlocal told
            ledger.add("answered", case=case, answer=_store(folder.answers / case, files))
            told += 1
            if done is not None:
                done("run", told, len(names))

        def answer(case: str, stop: Event) -> dict[str, bytes]:
            check_case(folder, case, commitment["cases"][case]["case"])
            ledger.add("started", case=case)
            files = examine(folder.cases / case, by, source, stop)
            _check_source(folder, source)
            return files

        _side_by_side(waiting, answer, answered, workers)
    return RunOutcome(len(names), len(state.answered), len(waiting), len(state.begun), len(state.void))


def _side_by_side(
    cases: list[str],
    answer: Callable[[str, Event], dict[str, bytes]],
    answered: Callable[[str, dict[str, bytes]], None],
    workers: int,
) -> None:
    """At most `workers` cases under way; the first failure stops the others."""
    stop, left = Event(), iter(cases)
    with ThreadPoolExecutor(workers) as pool:
        under_way: dict[Future[dict[str, bytes]], str] = {}
        try:
            for case in left:
                under_way[pool.submit(answer, case, stop)] = case
                if len(under_way) == workers:
                    _take(under_way, answered)
            while under_way:
                _take(under_way, answered)
        finally:
            stop.set()


def _take(
    under_way: dict[Future[dict[str, bytes]], str], answered: Callable[[str, dict[str, bytes]], None]
) -> None:  # fmt: skip
    for future in wait(under_way, return_when=FIRST_COMPLETED).done:
        answered(under_way.pop(future), future.result())


def _resumed(folder: ProofFolder, ledger: Ledger, state: State, source: str, restart: bool) -> State:
    """Note what happened since the last run, and drop what may not stay."""
    if state.source != source:
        if not restart:
            raise InputError(
                f"{folder.path}: is to be answered by source {state.source[:12]}, the source is now {source[:12]}; put "
                f"it back, or give --restart, which drops the {len(state.answered)} answers so far and is recorded"
            )
        dropped = folder.path / f"dropped_{state.restarts + 1}"
        folder.answers.replace(dropped)
        folder.answers.mkdir()
        ledger.add("restarted", dropped=len(state.answered), into=dropped.name, source=source)
    else:
        for case in sorted(state.begun):
            ledger.add("interrupted", case=case)
        for case in sorted(set(state.answered) - set(state.void)):
            if not (folder.answers / case).is_dir():
                ledger.add("void", case=case, why="its answer was taken away")
    state = state_of(ledger.entries, str(folder.path))
    for path in folder.answers.iterdir():
        if path.name not in state.answered:  # stored or half stored, and never recorded
            shutil.rmtree(path)
    return state


def check_case(folder: ProofFolder, case: str, expected: str) -> None:
    """Raises InputError where a case's folder is not as it was sealed."""
    found = folder_digest(folder.cases / case)
    if found != expected:
        raise InputError(
            f"{folder.cases / case}: is not as it was sealed, digest {found[:12]}, expected {expected[:12]}; "
            "put it back or seal a new proof"
        )


def _check_source(folder: ProofFolder, source: str) -> None:
    found = source_digest()
    if found != source:
        raise InputError(
            f"{folder.path}: the source changed during the run, from {source[:12]} to {found[:12]}; put it back and "
            "run again, or give --restart, which drops what was answered and is recorded"
        )


def _store(target: Path, files: dict[str, bytes]) -> str:
    """All files of an answer in one step; gives their digest."""
    scratch = target.with_name(f".{uuid4().hex}.part")
    scratch.mkdir()
    for name, content in files.items():
        (scratch / name).write_bytes(content)
    digest = folder_digest(scratch)
    scratch.replace(target)
    return digest
