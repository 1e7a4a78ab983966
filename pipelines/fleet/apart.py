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
from pathlib import Path
from typing import Any
from uuid import UUID

from data.errors import InputError, WorkError
from data.files import write_atomic
from pipelines import stopping
from pipelines.fleet.fleet_file import Fleet, FleetMachine


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

    from pipelines.fleet.retraining import retrain

    return parameter_schema(retrain).model_dump()


def run(machine: FleetMachine, flow_run_id: str | None) -> dict[str, Any]:
    """One retraining, as a run that a server scheduled or on a temporary server: `ok` and `summary`."""
    from pipelines.prefect_server import start_server

    starting = start_server() if flow_run_id is None else None  # comes up while the rest is imported
    from pipelines.fleet.retraining import finished, retrain

    try:
        if flow_run_id is not None:
            _run_scheduled(UUID(flow_run_id))
        else:
            if starting is not None:
                starting.join()
            retrain(**machine.parameters)
    except (InputError, WorkError) as error:
        return {"ok": False, "summary": str(error)}
    except Exception as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"[:300]
        if finished:  # the training is stored and promoted
            return {"ok": True, "summary": f"{finished[-1]}; its end could not be reported to Prefect ({said})"}
        return {"ok": False, "summary": said}
    return {"ok": True, "summary": finished[-1]}


def _run_scheduled(flow_run_id: UUID) -> None:
    from prefect.client.orchestration import get_client
    from prefect.flow_engine import run_flow

    from pipelines.fleet.retraining import retrain

    with get_client(sync_client=True) as client:
        flow_run = client.read_flow_run(flow_run_id)
    run_flow(retrain, flow_run=flow_run, parameters=flow_run.parameters)


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
    machine = FleetMachine.from_plain(job["machine"])
    outcome = run(machine, job["flow_run_id"])
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
