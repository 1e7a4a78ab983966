"""Answers in no time, for tests of what stands around them: well-behaved, curious, slow and broken ones."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd

from data.batch import Batch
from data.errors import WorkError
from data.machine import Machine
from diagnosis.findings.schema import Findings, FitSummary


def diagnosis(machine: Machine, batches: Sequence[Batch], *remarks: str) -> SimpleNamespace:
    fit = FitSummary(batches_improved=0, batches=len(batches))
    ids = tuple(b.batch_id for b in batches)
    told = Findings(
        machine=machine.machine, batches=ids, verdict="consistent", fit=fit, seconds=0.1, remarks=remarks
    )  # fmt: skip
    rms = pd.DataFrame({
        "channel": ["front", "front", "z"], "rows": [10, 30, 40], "after": [0.1, 0.1, 3.0], "floor": [0.1, 0.05, 1.0],
    })  # fmt: skip
    series = pd.DataFrame({"channel": ["front", "z"], "time_s": [0.0, 300.0], "recorded": [20.123456, 1.0]})
    tables = {"rms": rms, "series": series}
    return SimpleNamespace(findings=told, plan_text="hours: 3\n", tables=tables)


def quick(machine: Machine, batches: Sequence[Batch], **given: Any) -> SimpleNamespace:
    return diagnosis(machine, batches)


def rivals(found: SimpleNamespace) -> dict[str, Any]:
    return {"reference": {"verdict": found.findings.verdict, "findings": [], "seconds": 0.0}}


def no_rivals(found: SimpleNamespace) -> dict[str, Any]:
    raise WorkError("rivals: nothing to compare with")


def curious(machine: Machine, batches: Sequence[Batch], **given: Any) -> SimpleNamespace:
    """Tries what the machine's description asks for, and tells in its remarks what it got."""
    tries = json.loads(machine.description)
    return diagnosis(machine, batches, *(f"{what}: {_tried(what, to)}" for what, to in tries))


def _tried(what: str, to: str) -> str:
    try:
        match what:
            case "read":
                return f"got {len(Path(to).read_bytes())} bytes"
            case "list":
                return f"got {len(list(Path(to).iterdir()))} names"
            case "write":
                Path(to).write_text("here")
                return "written"
            case "native read":
                return _native(to)
            case "shell":
                return subprocess.run(["/bin/cat", to], capture_output=True, check=True).stdout.decode()
            case "connect":
                socket.create_connection(("127.0.0.1", int(to)), timeout=1.0)
                return "connected"
            case "import":
                __import__(to)
                return "imported"
            case "environment":
                return " ".join(sorted(os.environ))
    except (OSError, ImportError) as error:
        return type(error).__name__
    return "unknown"


def _native(path: str) -> str:
    """Past Python's own calls: Arrow opens files in C++."""
    from pyarrow import OSFile

    with OSFile(path) as file:
        return f"got {file.size()} bytes"


def slow(machine: Machine, batches: Sequence[Batch], **given: Any) -> SimpleNamespace:
    time.sleep(60.0)
    return diagnosis(machine, batches)


def broken(machine: Machine, batches: Sequence[Batch], **given: Any) -> SimpleNamespace:
    raise ValueError("no fit\nstays finite")


def dies(machine: Machine, batches: Sequence[Batch], **given: Any) -> SimpleNamespace:
    os.abort()
