"""The process that answers a demonstration: it confines itself, diagnoses its case, and writes the answer.

Started by `evidence.demonstration.demonstrating` with its task as JSON on standard input. Its folder holds `case`
(machine file and recordings), `answer`, which it fills, and `witness`, a file that it must not be able to read.
Progress goes to standard output, a line of JSON each. Only the standard library and names of packages are imported
before the process is confined.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import data  # noqa: F401 - found before the walls stand, since the folder around it cannot be listed behind them
from evidence.sealing.isolation import Allowed, allowed, confine, own_source

STATUS, DIAGNOSIS = "status.json", "diagnosis.json"
OWN = ("__init__.py", "answering.py", "plain.py")


def visible(place: Path, import_from: list[Path]) -> Allowed:
    """What an answering process of a proof may read, and the files of this process."""
    base, here = allowed(place, import_from), own_source()[0] / "evidence" / "demonstration"
    return replace(base, read=(*base.read, *(here / name for name in OWN)), listed=(*base.listed, here))


def main() -> None:
    """Answer the case; `status.json` states which protection holds, and any error."""
    task = json.loads(sys.stdin.read())
    place = Path(task["place"])
    import_from = [Path(p) for p in task["import_from"]]
    status: dict[str, Any] = {"isolation": confine(visible(place, import_from), place / "witness"), "error": None}
    sys.path[:0] = task["import_from"]
    try:
        (place / "answer" / DIAGNOSIS).write_text(_answer(place, task), encoding="utf-8")
    except Exception as error:  # any error is the answer
        message = " ".join(str(error).split())
        ours = type(error).__name__ in ("InputError", "WorkError")
        status["error"] = message if ours else f"{type(error).__name__}: {message}"
    (place / "answer" / STATUS).write_text(json.dumps(status), encoding="utf-8")


def _answer(place: Path, task: dict[str, Any]) -> str:
    from evidence.demonstration.plain import plain_text
    from evidence.sealing.examinee import read_case

    module, name = task["diagnose"].split(":")
    diagnose = getattr(import_module(module), name)
    machine, batches = read_case(place / "case", place / "answer" / "lake")
    return plain_text(diagnose(machine, batches, seed=0, processes=1, progress=_tell))


def _tell(step: str, n: int, of: int) -> None:
    sys.stdout.write(json.dumps([step, n, of]) + "\n")
    sys.stdout.flush()
