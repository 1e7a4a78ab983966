"""The run: every case is answered once, each by its own process, all by the same source."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import islice, takewhile
from pathlib import Path
from threading import Event
from typing import Any
from uuid import uuid4

from data.endings import ending, without_interrupt
from data.errors import InputError, WorkError
from thermodrift_exam.proof.sealing.examinee import FINDINGS, PLAN, REPLIES, SERIES, STATUS
from thermodrift_exam.proof.sealing.folder import (
    Ledger,
    ProofFolder,
    State,
    folder_digest,
    now,
    source_digest,
    state_of,
)
from thermodrift_exam.proof.sealing.isolation import allowed, roots
from thermodrift_exam.proof.sealing.seal import Done, names_of

RUN = "run.json"
LIMIT_S = 300.0
BEGIN = "import sys; sys.path[:0] = sys.argv[1:]; from thermodrift_exam.proof.sealing.examinee import main; main()"
START_S = 120.0  # for imports, which are no part of a case
POLL_S = 0.05
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Examinee:
    """Who answers: functions as ``module:function``, called as `diagnose` is and as ``replies(diagnosis)``.

    The replies of `baselines` are plain data, or a text of such; after the first `compared` cases of the suite, whose
    order is random, `cheap` answers instead. `limit_s` is the longest that a diagnosis may take,
    and again the longest that the baselines may. `import_from` are packages, or folders of modules, other than the
    product's that may be read.
    """

    diagnose: str = "diagnosis.diagnose:diagnose"
    baselines: str | None = None
    cheap: str | None = None
    compared: int | None = None
    limit_s: float = LIMIT_S
    import_from: tuple[str, ...] = ()

    def of(self, index: int) -> Examinee:
        """Who answers the case at a place of the suite."""
        past = self.compared is not None and index >= self.compared
        return replace(self, baselines=self.cheap) if past else self


def examine(
    case: Path, by: Examinee, source: str, stop: Event | None = None, progress: Done | None = None
) -> dict[str, bytes]:
    """The answer to the case in a folder as files by name; `run.json` is always among them.

    The process sees a copy of the folder in an empty directory, an empty environment, and no name of the proof.

    Args:
        source: digest of the source, for `run.json`.
        stop: set when no further answer is needed.
        progress: receives step, n, of while the diagnosis works.

    Raises:
        InputError: temporary folders lie where the process may read.
        WorkError: the process could not be started or isolated, or was stopped; there is no answer.
    """
    started = now()
    with tempfile.TemporaryDirectory(prefix="thermodrift-") as scratch:
        place = Path(scratch).resolve()
        if (seen := allowed().covers(place)) is not None:
            raise InputError(f"TMPDIR {place}: lies in {seen}, which answering processes may read; give another TMPDIR")
        _lay_out(case, place)
        error = _watched(place, by, stop or Event(), progress)
        status = _status_of(place)
        if "isolation" not in status:
            raise WorkError(f"the answering process did not start: {error or _last_line(place)}")
        written = [place / "answer" / name for name in (FINDINGS, PLAN, SERIES, REPLIES)]
        files = {p.name: p.read_bytes() for p in written if p.exists()}
        error = status.get("error") or error
        if not error and status["stage"] != "done":
            error = f"the process ended during the {'baselines' if FINDINGS in files else 'diagnosis'}"
    run: dict[str, Any] = {
        "seconds": status.get("seconds"), "processor_seconds": status.get("processor_seconds"), "cores": 1,
        "source_digest": source, "isolation": status["isolation"],
        "error": None if FINDINGS in files else error, "started": started, "ended": now(),
        "rivals_error": error if FINDINGS in files else None,
    }  # fmt: skip
    return files | {RUN: (json.dumps(run, ensure_ascii=False, indent=1) + "\n").encode()}


def _lay_out(case: Path, place: Path) -> None:
    """The folder of an answering process: a copy of the case, a folder for the answer, a file that it must not read."""
    shutil.copytree(case, place / "case")
    for path in (place / "case").rglob("*"):
        os.utime(path, (0, 0))  # the build time of a case is no information
    (place / "answer").mkdir()
    (place / "witness").write_text("not to be read\n", encoding="utf-8")


def _watched(place: Path, by: Examinee, stop: Event, progress: Done | None) -> str | None:
    """Wait for the process; returns the reason if it was stopped."""
    task = {"place": str(place), "diagnose": by.diagnose, "baselines": by.baselines, "import_from": by.import_from}
    command = [sys.executable, "-I", "-B", "-c", BEGIN, *map(str, roots())]
    with (place / "output").open("wb") as output:
        with without_interrupt():
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=output, stderr=output, cwd=place / "case",
                env=_environment(place),
            )  # fmt: skip
        try:
            assert process.stdin is not None
            process.stdin.write(json.dumps(task).encode())
            process.stdin.close()
            stage, at, since, ended = "", None, time.monotonic(), False
            while not ended:
                ended = process.poll() is not None
                if not ended and stop.wait(POLL_S):
                    raise WorkError("the answering process was stopped")
                status = _status_of(place)
                if (reached := str(status.get("stage", ""))) != stage:
                    stage, since = reached, time.monotonic()
                if progress is not None and status.get("progress", at) != at:
                    at = status["progress"]
                    progress(*at)
                limit_s = by.limit_s if stage else START_S
                if not ended and time.monotonic() - since > limit_s:
                    return f"no end within {limit_s:g} s"
        finally:
            process.kill()
            process.wait()
    return f"ended by signal {-process.returncode}" if process.returncode < 0 else None


def _environment(place: Path) -> Mapping[str, str]:
    """One thread, and no path but its own."""
    own = str(place / "answer")
    return dict.fromkeys(THREADS, "1") | {"HOME": own, "TMPDIR": own, "LANG": "C.UTF-8", "TZ": "UTC"}


def _status_of(place: Path) -> dict[str, Any]:
    """The status of the process; empty before it begins."""
    file = place / "answer" / STATUS
    return dict(json.loads(file.read_bytes())) if file.exists() else {}


def _last_line(place: Path) -> str:
    """The last output of the process."""
    lines = (place / "output").read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it ended without a message; run the case again"


Answerer = Callable[[str, Event], dict[str, bytes]]
Answered = Callable[[str, dict[str, bytes]], None]


@dataclass(frozen=True)
class RunOutcome:
    """Numbers of cases: all, answered before and by this run, restarted, and void."""

    cases: int
    before: int
    answered: int
    interrupted: int
    void: int


def run(
    folder: ProofFolder, by: Examinee, workers: int = 1, restart: bool = False, done: Done | None = None,
    until: datetime | None = None,
) -> RunOutcome:  # fmt: skip
    """Answer every case that has no answer yet; answers are kept, interrupted cases start again.

    Args:
        restart: drop all answers of another source and start again; the ledger records it.
        until: no case begins after this time (with its zone); the same for every run, since a time chosen after some
            answers chooses cases.

    Raises:
        InputError: not sealed, opened already, another source or another end than the earlier answers', a changed case.
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
        end = None if until is None else until.astimezone(UTC).isoformat(timespec="minutes")
        if state.ran and end != state.until:
            raise InputError(f"--until: got {end}, expected {state.until}, as before the first answer")
        source = source_digest()
        state = _resumed(folder, ledger, state, source, restart)
        names = list(names_of(commitment))
        waiting = [n for n in names if n not in state.answered and n not in state.void]
        ledger.add("run", source=source, cases=len(waiting), workers=workers, until=end)
        finished = len(names) - len(waiting)

        def answered(case: str, files: dict[str, bytes]) -> None:
            nonlocal finished
            ledger.add("answered", case=case, answer=_store(folder.answers / case, files))
            finished += 1
            if done is not None:
                done("run", finished, len(names))

        def answer(case: str, stop: Event) -> dict[str, bytes]:
            check_case(folder, case, commitment["cases"][case]["case"])
            ledger.add("started", case=case)
            files = examine(folder.cases / case, by.of(names.index(case)), source, stop)
            _check_source(folder, source)
            return files

        in_time = takewhile(lambda _: until is None or datetime.now(UTC) < until, waiting)
        in_parallel(in_time, answer, answered, workers)
    now_answered = finished - len(names) + len(waiting)
    return RunOutcome(len(names), len(state.answered), now_answered, len(state.begun), len(state.void))


def in_parallel(cases: Iterable[str], answer: Answerer, answered: Answered, workers: int) -> None:
    """At most `workers` cases under way; the first failure stops the others."""
    stop, waiting = Event(), iter(cases)

    def end() -> None:  # no killed process may pass for an answer
        stop.set()
        pool.shutdown(cancel_futures=True)

    with ThreadPoolExecutor(workers) as pool, ending(end):
        try:
            under_way = {pool.submit(answer, case, stop): case for case in islice(waiting, workers)}
            while under_way:
                for future in wait(under_way, return_when=FIRST_COMPLETED).done:
                    answered(under_way.pop(future), future.result())
                    under_way |= {pool.submit(answer, case, stop): case for case in islice(waiting, 1)}
        finally:
            stop.set()


def _resumed(folder: ProofFolder, ledger: Ledger, state: State, source: str, restart: bool) -> State:
    """Record the events since the last run, and drop answers that may not stay."""
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
    """Store all files of an answer atomically; returns their digest."""
    scratch = target.with_name(f".{uuid4().hex}.part")
    scratch.mkdir()
    for name, content in files.items():
        (scratch / name).write_bytes(content)
    digest = folder_digest(scratch)
    scratch.replace(target)
    return digest
