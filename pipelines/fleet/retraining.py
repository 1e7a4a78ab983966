"""One scheduled retraining as a flow run of Prefect: its name, its lines and its report are in Prefect's UI."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from data.errors import InputError, WorkError
from data.machine import load_machine
from pipelines.caller import DirectCaller
from pipelines.flows import FlowRun
from pipelines.jobs.request import request_for
from pipelines.jobs.training import TrainOutcome, train
from pipelines.prefect_reports import Reports
from pipelines.settings import load


def retrain(
    machine_file: str,
    recordings: Sequence[str],
    effort: str = "usual",
    channels: Sequence[str] | None = None,
    families: Sequence[str] | None = None,
    selectors: Sequence[str] | None = None,
    reports: Reports | None = None,
    scheduled: str | None = None,
) -> str:
    """Ingest what arrived since the last time and train if there is anything new; returns a summary.

    Its lines are those of the run, and the report is an artifact of it. An error is printed in one line, and the run
    counts as failed.

    Args:
        reports: the way to Prefect, which may have begun to come up; None opens one.
        scheduled: the id of the run that a server has made for it.
    """
    parameters = {
        "machine_file": machine_file, "recordings": list(recordings), "effort": effort, "channels": channels,
        "families": families, "selectors": selectors,
    }  # fmt: skip
    machine = machine_name(machine_file)
    name = " ".join(("retrain", machine, *(channels or ())))
    with FlowRun(reports or Reports(), "thermodrift-retrain", name, machine, parameters, scheduled) as run:
        request = request_for(machine_file, recordings, effort, channels or (), families or (), selectors or ())
        try:
            outcome = train(request, load(), DirectCaller(working=run.working), say=run.line)
        except (InputError, WorkError) as error:
            run.line(f"not retrained: {error}", logging.ERROR)
            print(f"{datetime.now():%Y-%m-%d %H:%M} not retrained: {error}", flush=True)
            raise
        summary = summarized(outcome)
        run.line(summary)
        print(f"{datetime.now():%Y-%m-%d %H:%M} {machine}: {summary}", flush=True)
        if outcome.report is not None:
            run.link(outcome.report)
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
