"""`thermodrift diagnose`: what physics the twin lacks; the work is in `pipelines.diagnosing`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import WorkError
from pipelines import console
from pipelines.options import Json, MachineFile, split
from reports.labels import count, number, unit_label

if TYPE_CHECKING:
    from rich.table import Table

    from diagnosis.findings.schema import Finding
    from diagnosis.result import Diagnosis
    from pipelines.diagnosing import DiagnosisOutcome


def diagnosis_dict(outcome: DiagnosisOutcome) -> dict[str, Any]:
    """The outcome for other programs; `diagnosis` is findings.json as it was written."""
    from pipelines.diagnosing import FINDINGS

    return {
        "diagnosis": json.loads(outcome.files[FINDINGS].read_text(encoding="utf-8")),
        "out": str(outcome.out),
        "files": {name: str(path) for name, path in outcome.files.items()},
        "run_id": outcome.run_id,
        "quarantined": [r.reason for r in outcome.ingested.quarantined] if outcome.ingested else [],
        "trouble": outcome.trouble,
    }


def print_diagnosis(outcome: DiagnosisOutcome) -> None:
    """The verdict, the findings, left-out errors, the next run and the files."""
    from pipelines.diagnosing import FINDINGS, MACHINE, PLAN, REPORT
    from reports.diagnosis.tables import experiment_sentence, headline

    contents = {
        REPORT: "the report, one page",
        MACHINE: "the machine file with what was found",
        PLAN: "the next run's plan",
        FINDINGS: "the findings, for other programs",
    }
    d, f = outcome.diagnosis, outcome.diagnosis.findings
    label = "  (simulated recordings)" if d.simulated else ""
    against = " against a drafted network: the machine file has no twin part" if d.drafted else ""
    console.line(f"{f.machine}: diagnosis of {count(len(f.batches), 'batch')}{against}{label}")
    if outcome.ingested is not None and outcome.ingested.quarantined:
        bad = outcome.ingested.quarantined
        console.line(f"files in quarantine: {len(bad)}, not used; {bad[0].reason}")
    console.out.print(headline(f.verdict, [x.probability for x in f.findings]), style="bold", highlight=False)
    for line in sentences(d):
        console.line(line)
    if len(d.tables["rms"]):
        console.out.print(error_table(d))
    if f.findings:
        console.line(f"left-out batches that improve: {f.fit.batches_improved} of {f.fit.batches}")
    if f.next_experiment is not None:
        console.line(f"next run: {experiment_sentence(f.next_experiment)}")
    for remark in d.remarks:
        console.line(f"note: {remark}")
    for name, what in contents.items():
        if name in outcome.files:
            console.line(f"{outcome.files[name]}: {what}")


def sentences(d: Diagnosis) -> list[str]:
    """A sentence a finding with its probability, numbered; without any, what the verdict means here."""
    from reports.diagnosis.tables import below_headline

    f = d.findings
    if f.findings:
        return [f"{k}. {_with_probability(x)}" for k, x in enumerate(f.findings, 1)]
    lead = f.statement or below_headline(f.verdict, f.fit.batches, len(d.tables["limits"]))
    return [lead] if lead else []


def _with_probability(x: Finding) -> str:
    """The statement; an unsure one states its probability itself."""
    from reports.diagnosis.tables import NARROW, probability_label

    percent = probability_label(x.probability).replace(NARROW, " ")
    return x.statement if percent in x.statement else f"{x.statement} ({percent})"


def error_table(d: Diagnosis) -> Table:
    """Left-out rms of every channel before and after, and the rms of the noise alone."""
    from reports.diagnosis.tables import by_channel

    columns = ("channel", "unit", "batches", "before", "after", "noise")
    table = console.table("left-out rms", *columns, left=columns[:2])
    for r in by_channel(d.tables["rms"]).to_dict("records"):
        digits = 1 if max(r["before"], r["after"]) >= 9.5 else 2
        shown = (number(r[k], digits) for k in ("before", "after", "floor"))
        table.add_row(str(r["channel"]), unit_label(str(r["unit"])), str(r["batches"]), *shown)
    return table


def diagnose(
    machine: MachineFile,
    to: Annotated[Path, typer.Option("--out", help="folder of report, findings and the new machine file")],
    recordings: Annotated[
        list[Path] | None, typer.Option(help="files or folders to ingest and diagnose on; default: the lake")
    ] = None,
    batches: Annotated[str, typer.Option(help="batch ids, comma separated; default: all")] = "",
    seed: Annotated[int, typer.Option(help="of all random draws")] = 0,
    report: Annotated[bool, typer.Option(help="write report.html")] = True,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace an earlier diagnosis of this machine")
    ] = False,
    as_json: Json = False,
) -> None:
    """Why simulation and recordings differ: which physics is missing, where, when, and how much better it fits."""
    from pipelines import settings

    settings.configure_environment()
    from pipelines.diagnosing import DiagnosisRequest, diagnose_file

    request = DiagnosisRequest(machine, to, tuple(recordings or ()), split(batches), seed, report, overwrite)
    with console.progress(as_json) as (say, done):
        outcome = diagnose_file(request, settings.load(), say, done)
    if as_json:
        console.print_json(diagnosis_dict(outcome))
    else:
        print_diagnosis(outcome)
    if outcome.trouble:
        raise WorkError(f"{outcome.trouble}; the findings stand in {outcome.out}")
