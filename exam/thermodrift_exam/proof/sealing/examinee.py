"""The process that answers one case: it confines itself, diagnoses its case, and writes the answer.

Started by `thermodrift_exam.proof.sealing.running` with its task as JSON on standard input. Its folder holds `case`
(machine file and recordings), `answer`, which it fills, and `witness`, a file that it must not be able to read. Only
the standard library and names of packages are imported before the process is confined.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from thermodrift_exam.proof.sealing.isolation import allowed, confine, is_package

STATUS, FINDINGS, REPLIES = "status.json", "findings.json", "rivals.json"
PLAN, SERIES = "next_run.yml", "series.csv"


def main() -> None:
    """Answer the case; `status.json` states the last step, the protection, and any error."""
    task = json.loads(sys.stdin.read())
    place = Path(task["place"])
    import_from = [Path(p) for p in task["import_from"]]
    on_path = [str(p.parent if is_package(p) else p) for p in import_from]
    status: dict[str, Any] = {"stage": "isolated", "isolation": confine(allowed(place, import_from), place / "witness")}
    sys.path[:0] = on_path
    diagnose = _function(task["diagnose"])
    baselines = _function(task["baselines"]) if task["baselines"] else None
    _report(place, status)
    try:
        begun, begun_cpu = perf_counter(), process_time()
        case = read_case(place / "case", place / "answer" / "lake")

        def progress(*at: Any) -> None:
            status["progress"] = at
            _report(place, status)

        diagnosis = diagnose(*case, seed=0, processes=1, progress=progress)
        status |= {"stage": "diagnosed", "seconds": round(perf_counter() - begun, 2)}
        status["processor_seconds"] = round(process_time() - begun_cpu, 2)
        _write_diagnosis(place, diagnosis)
        _report(place, status)
        if baselines is not None:
            _write(place, REPLIES, _json(baselines(diagnosis)))
        _report(place, status | {"stage": "done"})
    except Exception as error:  # any error is the answer to this case
        _report(place, status | {"error": _one_line(error)})


def read_case(case: Path, lake: Path) -> tuple[Any, list[Any]]:
    """Machine and batches of a case as `thermodrift diagnose` reads them: into a lake of its own, and checked.

    Raises:
        InputError: a machine file or recordings that cannot be used.
    """
    from data.checks import check_machine
    from data.errors import InputError
    from data.ingest import ingest
    from data.lake import Lake
    from data.machine import load_machine

    machine = load_machine(case / "machine.yml")
    held = Lake(lake)
    report = ingest([case / "recordings"], machine, held)
    if not report.batches:
        reasons = [r.reason for r in report.quarantined]
        raise InputError(reasons[0] if reasons else "recordings: none that the machine file describes")
    return machine, check_machine(held.load_all(machine.machine), machine)


def _write_diagnosis(place: Path, diagnosis: Any) -> None:
    """The findings, the plan of the next run if any, and the series for a figure of the case."""
    from diagnosis.findings.schema import as_json

    _write(place, FINDINGS, as_json(diagnosis.findings))
    if diagnosis.plan_text is not None:
        _write(place, PLAN, diagnosis.plan_text)
    rms, series = diagnosis.tables["rms"], diagnosis.tables["series"]
    if len(rms) and len(series):
        squares = rms.assign(share=rms["rows"] * (rms["after"] / rms["floor"]) ** 2).groupby("channel")
        worst = (squares["share"].sum() / squares["rows"].sum()).idxmax()
        _write(place, SERIES, series[series["channel"] == worst].to_csv(index=False, float_format="%.5g"))


def _function(where: str) -> Any:
    module, name = where.split(":")
    return getattr(import_module(module), name)


def _json(value: Any) -> str:
    """Plain data; a text is some already."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1) + "\n"


def _write(place: Path, name: str, text: str) -> None:
    """Atomic."""
    scratch = place / "answer" / f"{name}.part"
    scratch.write_text(text, encoding="utf-8")
    scratch.replace(place / "answer" / name)


def _report(place: Path, status: dict[str, Any]) -> None:
    _write(place, STATUS, _json(status))


def _one_line(error: Exception) -> str:
    message = " ".join(str(error).split())
    return message if type(error).__name__ in ("InputError", "WorkError") else f"{type(error).__name__}: {message}"
