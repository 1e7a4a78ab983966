"""One case given to an answering process, and what came back."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

from data.errors import WorkError
from twin.proof.sealing.examinee import FINDINGS, PLAN, RIVALS, SERIES, TOLD
from twin.proof.sealing.isolation import own_source
from twin.proof.sealing.ledger import now

RUN = "run.json"
LIMIT_S = 300.0
BEGIN = "import sys; sys.path.insert(0, sys.argv[1]); from twin.proof.sealing.examinee import main; main()"
START_S = 120.0  # for imports, which are no part of a case
LOOK_S = 0.05
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


@dataclass(frozen=True)
class Examinee:
    """Who answers: functions as ``module:function``, called as `diagnose` is and as ``rivals(diagnosis)``.

    `limit_s` is the longest that a diagnosis may take, and again the longest that its rivals may. `import_from` are
    folders that modules may be read from beside the package itself.
    """

    diagnose: str = "twin.diagnosis.diagnose:diagnose"
    rivals: str | None = "twin.proof.rivals:rivals"
    limit_s: float = LIMIT_S
    import_from: tuple[str, ...] = ()


def examine(case: Path, by: Examinee, source: str, stop: Event | None = None) -> dict[str, bytes]:
    """The answer to the case in a folder as files by name; `run.json` is always among them.

    The process sees a copy of the folder in an empty place, an empty environment, and nothing that names the proof.

    Args:
        source: digest of the source, for `run.json`.
        stop: set by whoever wants no answer any more.

    Raises:
        WorkError: the process could not be started or shut in, or was stopped; nothing was answered.
    """
    started = now()
    with tempfile.TemporaryDirectory(prefix="thermodrift-") as scratch:
        place = Path(scratch).resolve()
        shutil.copytree(case, place / "case")
        for path in (place / "case").rglob("*"):
            os.utime(path, (0, 0))  # when a case was built is nobody's business
        (place / "answer").mkdir()
        (place / "witness").write_text("not to be read\n", encoding="utf-8")
        error = _watched(place, by, stop or Event())
        told = _told(place)
        if "isolation" not in told:
            raise WorkError(f"the answering process did not start: {error or _last_words(place)}")
        written = [place / "answer" / name for name in (FINDINGS, PLAN, SERIES, RIVALS)]
        files = {p.name: p.read_bytes() for p in written if p.exists()}
        error = told.get("error") or error
        if not error and told["stage"] != "done":
            error = f"the process ended while {'rivals were asked' if FINDINGS in files else 'it diagnosed'}"
    run: dict[str, Any] = {
        "seconds": told.get("seconds"), "processor_seconds": told.get("processor_seconds"), "cores": 1,
        "source_digest": source, "isolation": told["isolation"],
        "error": None if FINDINGS in files else error, "started": started, "ended": now(),
        "rivals_error": error if FINDINGS in files else None,
    }  # fmt: skip
    return files | {RUN: (json.dumps(run, ensure_ascii=False, indent=1) + "\n").encode()}


def _watched(place: Path, by: Examinee, stop: Event) -> str | None:
    """Wait for the process; the reason why it was ended, if it was."""
    task = {"place": str(place), "diagnose": by.diagnose, "rivals": by.rivals, "import_from": by.import_from}
    command = [sys.executable, "-I", "-B", "-c", BEGIN, str(own_source()[0])]
    with (place / "said").open("wb") as said:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=said, stderr=said, cwd=place / "case", env=_environment(place)
        )
        try:
            assert process.stdin is not None
            process.stdin.write(json.dumps(task).encode())
            process.stdin.close()
            stage, since = "", time.monotonic()
            while process.poll() is None:
                if stop.wait(LOOK_S):
                    raise WorkError("the answering process was stopped")
                if (reached := str(_told(place).get("stage", ""))) != stage:
                    stage, since = reached, time.monotonic()
                limit_s = by.limit_s if stage else START_S
                if time.monotonic() - since > limit_s:
                    return f"no end within {limit_s:g} s"
        finally:
            process.kill()
            process.wait()
    return f"ended by signal {-process.returncode}" if process.returncode < 0 else None


def _environment(place: Path) -> Mapping[str, str]:
    """One thread, and no path but its own."""
    own = str(place / "answer")
    return dict.fromkeys(THREADS, "1") | {"HOME": own, "TMPDIR": own, "LANG": "C.UTF-8", "TZ": "UTC"}


def _told(place: Path) -> dict[str, Any]:
    file = place / "answer" / TOLD
    return dict(json.loads(file.read_bytes())) if file.exists() else {}


def _last_words(place: Path) -> str:
    lines = (place / "said").read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "it ended without a word; run the case again"
