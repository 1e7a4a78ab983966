"""The process of its own that `pipelines.fleet.scheduling` starts for a run, and for the check of a fleet.

    python -m pipelines.fleet.apart check < FLEET     what is wrong with a fleet, as JSON
    python -m pipelines.fleet.apart run < JOB         one retraining; its outcome is written to the job's file

A process per run keeps the one that waits small, and an error, however bad, with the machine that caused it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from data.errors import InputError, WorkError
from data.files import write_atomic
from pipelines import stopping
from pipelines.fleet.fleet_file import Fleet


def check(fleet: Fleet) -> dict[str, Any]:
    """What is wrong with a fleet's machine files: `problems`; folders that are not there now: `notes`; the names of the
    machines; the schema of a run's parameters, where a Prefect server needs it."""
    from pipelines.fleet.service import has_server
    from pipelines.home import home
    from pipelines.jobs.request import check_request, request_for
    from pipelines.settings import load

    settings = load()
    problems, notes, names = list[str](), list[str](), list[str]()
    for k, m in enumerate(fleet.machines):
        name = m.name
        try:
            name = check_request(request_for(**m.parameters | {"recordings": []}), settings)[0].machine
        except InputError as error:
            problems.append(f"{fleet.at(k)}{error}")
        if name in names:
            problems.append(f"{fleet.at(k)}machine {name} is there twice; give each machine one entry")
        names.append(name)
        absent = [r for r in m.recordings if not Path(r).exists()]
        if absent:
            notes.append(f"{name}: {', '.join(absent)}: no such file or folder now; its runs fail until it is there")
    return {"names": names, "problems": problems, "notes": notes, "schema": _schema() if has_server(home()) else {}}


def _schema() -> dict[str, Any]:
    from prefect.utilities.callables import parameter_schema

    from pipelines.jobs.request import request_for

    return parameter_schema(request_for).model_dump()


def run(parameters: Mapping[str, Any], scheduled: str | None) -> dict[str, Any]:
    """One retraining, reported as the run that a server scheduled or as a new one: `ok` and `summary`."""
    from pipelines.prefect_reports import Reports

    reports = Reports()  # comes up while the rest is imported
    from pipelines.fleet.retraining import retrain

    try:
        return {"ok": True, "summary": retrain(**parameters, reports=reports, scheduled=scheduled)}
    except (InputError, WorkError) as error:
        return {"ok": False, "summary": str(error)}
    except Exception as error:
        return {"ok": False, "summary": f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]}


def main(what: str) -> None:
    """The process: one line of JSON on standard input. It ends with the process that started it."""
    from pipelines.settings import configure_environment, load

    configure_environment()
    text = sys.stdin.readline()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if what == "check":
        sys.stdout.write(json.dumps(check(Fleet.from_json(text))) + "\n")
        return
    job = json.loads(text)
    outcome = run(job["parameters"], job["flow_run_id"])
    from pipelines.fleet import watching

    try:
        watching.refresh(load())
    except (InputError, WorkError) as error:
        outcome["state"] = str(error)
    write_atomic(Path(job["result"]), json.dumps(outcome))


def _end_with_parent() -> None:
    """Standard input ends when the process that started this one does."""
    sys.stdin.read()
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    with stopping.prompt():
        main(sys.argv[1])
