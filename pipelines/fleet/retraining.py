"""One scheduled retraining as a Prefect flow: its name, its lines and its report are in Prefect's UI."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from prefect import flow, get_run_logger, runtime
from prefect.task_runners import ThreadPoolTaskRunner

from data.errors import InputError, WorkError
from data.machine import load_machine
from pipelines.caller import LANES
from pipelines.flows import PrefectCaller, link_report, log_to_server
from pipelines.jobs.request import request_for
from pipelines.jobs.training import TrainOutcome, train
from pipelines.settings import load

finished: list[str] = []  # summaries of this process: known even where Prefect loses its server at the end of a run


def _run_name() -> str:
    """The run as the UI lists it: "retrain mill z x"."""
    given = runtime.flow_run.parameters
    return " ".join(("retrain", machine_name(given["machine_file"]), *given.get("channels", [])))


@flow(name="thermodrift-retrain", flow_run_name=_run_name, task_runner=ThreadPoolTaskRunner(max_workers=LANES),
      persist_result=False)  # fmt: skip
def retrain(
    machine_file: str,
    recordings: list[str],
    effort: str = "usual",
    channels: list[str] | None = None,
    families: list[str] | None = None,
    selectors: list[str] | None = None,
) -> str:
    """Ingest what arrived since the last time and train if there is anything new; returns a summary.

    Its lines are logged to the run, and the report is an artifact of it. An error is printed in one line, and the run
    counts as failed.
    """
    log_to_server()
    log = get_run_logger()
    request = request_for(machine_file, recordings, effort, channels or (), families or (), selectors or ())
    try:
        machine = load_machine(request.machine_file).machine
        outcome = train(request, load(), PrefectCaller(machine=machine), say=log.info)
    except (InputError, WorkError) as error:
        log.error("not retrained: %s", error)
        print(f"{datetime.now():%Y-%m-%d %H:%M} not retrained: {error}", flush=True)
        raise
    summary = summarized(outcome)
    finished.append(summary)
    log.info(summary)
    print(f"{datetime.now():%Y-%m-%d %H:%M} {machine}: {summary}", flush=True)
    if outcome.report is not None:
        link_report(machine, outcome.report)
    return summary


def summarized(outcome: TrainOutcome) -> str:
    """One line: what was promoted, or why nothing was trained, files left out, and the diagnosis."""
    summary = outcome.stopped or "; ".join(p.summary for p in outcome.promotions.values())
    quarantined = len(outcome.ingested.quarantined) if outcome.ingested else 0
    summary += f" (files in quarantine: {quarantined})" if quarantined else ""
    waiting = len(outcome.ingested.waiting) if outcome.ingested else 0
    summary += f" (files still being written: {waiting})" if waiting else ""
    summary += f"; postponed: {outcome.postponed}" if outcome.postponed else ""
    return summary + (f"; {outcome.diagnosis_summary}" if outcome.diagnosis_summary else "")


def machine_name(file: str) -> str:
    """The name in a machine file, its stem where it cannot be read."""
    try:
        return load_machine(Path(file)).machine
    except InputError:
        return Path(file).stem
