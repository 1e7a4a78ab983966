"""`thermodrift diagnose`: what physics the twin lacks; the work is in `pipelines.jobs.diagnosing`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError, WorkError
from data.units import unit_label
from pipelines import console
from pipelines.commands import load_settings
from pipelines.options import Json, split
from reports.labels import count, digits_of, number

if TYPE_CHECKING:
    from rich.table import Table

    from diagnosis.result import Diagnosis
    from pipelines.jobs.diagnosing import DiagnosisOutcome


def diagnosis_dict(outcome: DiagnosisOutcome) -> dict[str, Any]:
    """The outcome for other programs; `diagnosis` is findings.json as it was written."""
    from pipelines.jobs.diagnosing import FINDINGS

    return {
        "diagnosis": json.loads(outcome.files[FINDINGS].read_text(encoding="utf-8")),
        "out": str(outcome.out),
        "files": {name: str(path) for name, path in outcome.files.items()},
        "run_id": outcome.run_id,
        "quarantined": [r.reason for r in outcome.ingested.quarantined] if outcome.ingested else [],
        "trouble": outcome.trouble,
        **({} if outcome.continued is None else {"continued": continued_dict(outcome)}),
    }


def continued_dict(outcome: DiagnosisOutcome) -> dict[str, Any]:
    """What a continued diagnosis changed: new recordings, those that follow the proposed run, the earlier verdict."""
    c = outcome.continued
    assert c is not None
    return {
        "new": list(c.new),
        "made": list(c.made),
        "before": c.before.model_dump(mode="json", by_alias=True),
        "changed": c.sentences(outcome.diagnosis.findings),
    }


def print_diagnosis(outcome: DiagnosisOutcome) -> None:
    """The verdict, the findings, left-out errors, the next run and the files."""
    from pipelines.jobs.diagnosing import FINDINGS, MACHINE, PLAN, REPORT
    from reports.diagnosis.tables import experiment_sentence, headline, most_left

    contents = {
        REPORT: "the report, one page",
        MACHINE: "the machine file with what was found",
        PLAN: "the next run's plan",
        FINDINGS: "the findings, for other programs",
    }
    d, f = outcome.diagnosis, outcome.diagnosis.findings
    kept = {p for p in outcome.files if p.startswith("findings.") and p != FINDINGS}
    contents |= dict.fromkeys(sorted(kept), "the findings of the earlier diagnosis")
    label = "  (simulated recordings)" if d.simulated else ""
    against = " against a drafted network: the machine file has no twin part" if d.drafted else ""
    console.line(f"{f.machine}: diagnosis of {count(len(f.batches), 'batch')}{against}{label}")
    if outcome.ingested is not None and outcome.ingested.quarantined:
        bad = outcome.ingested.quarantined
        console.line(f"files in quarantine: {len(bad)}, not used; {bad[0].reason}")
    said = headline(f.verdict, [x.probability for x in f.findings], most_left(f.fit.left_out_rms))
    console.out.print(said, style="bold", highlight=False)
    for line in sentences(d):
        console.line(line)
    for line in outcome.continued.sentences(f) if outcome.continued is not None else ():
        console.line(f"changed: {line}")
    if len(d.tables["rms"]):
        console.out.print(error_table(d))
    if f.findings:
        console.line(f"left-out batches that improve: {f.fit.batches_improved} of {f.fit.batches}")
    if f.account:
        console.line(f.account["summary"])
    if f.next_experiment is not None:
        console.line(f"next run: {experiment_sentence(f.next_experiment)}")
    for remark in d.remarks:
        console.line(f"note: {remark}")
    for name, what in contents.items():
        if name in outcome.files:
            console.line(f"{outcome.files[name]}: {what}")


def sentences(d: Diagnosis) -> list[str]:
    """A line a finding with its probability, numbered; without any, what the verdict means here."""
    from reports.diagnosis.first_screen import claim, without_finding
    from reports.diagnosis.tables import NARROW

    claims = [claim(x) for x in d.findings.findings]
    said = [f"{k}. {sure}: {text}".replace(NARROW, " ") for k, (sure, text) in enumerate(claims, 1)]
    return said or [without_finding(d.findings)]


def error_table(d: Diagnosis) -> Table:
    """Left-out rms of every channel before and after, and the rms of the noise alone."""
    from reports.diagnosis.tables import by_channel

    columns = ("channel", "unit", "batches", "before", "after", "noise")
    table = console.table("left-out rms", *columns, left=columns[:2])
    for r in by_channel(d.tables["rms"]).to_dict("records"):
        rms = [r[k] for k in ("before", "after", "floor")]
        shown = (number(v, digits_of(*rms)) for v in rms)
        table.add_row(str(r["channel"]), unit_label(str(r["unit"])), str(r["batches"]), *shown)
    return table


def diagnose(
    machine: Annotated[Path | None, typer.Option("--machine", help="machine file (.yml)")] = None,
    to: Annotated[Path | None, typer.Option("--out", help="folder of report, findings and new machine file")] = None,
    recordings: Annotated[
        list[Path] | None, typer.Option(help="files or folders to ingest and diagnose on; default: the lake")
    ] = None,
    batches: Annotated[str, typer.Option(help="batch ids, comma separated; default: all")] = "",
    earlier: Annotated[
        Path | None,
        typer.Option("--continue", help="folder of an earlier diagnosis, to repeat with --recordings added to its own"),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="of all random draws; default: 0, or the earlier one's")] = None,
    report: Annotated[bool, typer.Option(help="write report.html")] = True,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="replace an earlier diagnosis of this machine")
    ] = False,
    as_json: Json = False,
) -> None:
    """Why simulation and recordings differ: which physics is missing, where, when, and how much better it fits."""
    settings = load_settings()
    from pipelines.jobs.continuing import continue_diagnosis
    from pipelines.jobs.diagnosing import DiagnosisRequest, diagnose_file

    given = tuple(recordings or ())
    if earlier is not None:
        _check_alone(earlier, {"--out": to, "--batches": batches, "--overwrite": overwrite})
        with console.progress(as_json) as (say, done):
            outcome = continue_diagnosis(earlier, given, settings, machine, seed, report, say=say, done=done)
    else:
        file, out = _needed("--machine", machine), _needed("--out", to)
        request = DiagnosisRequest(file, out, given, split(batches), seed or 0, report, overwrite)
        with console.progress(as_json) as (say, done):
            outcome = diagnose_file(request, settings, say, done)
    if as_json:
        console.print_json(diagnosis_dict(outcome))
    else:
        print_diagnosis(outcome)
    if outcome.trouble:
        raise WorkError(f"{outcome.trouble}; the findings stand in {outcome.out}")


def _needed(option: str, given: Path | None) -> Path:
    if given is None:
        raise InputError(f"missing option {option}; give it, or --continue the folder of an earlier diagnosis")
    return given


def _check_alone(earlier: Path, others: Mapping[str, object]) -> None:
    """Raises InputError where an option is given that --continue decides itself."""
    used = [name for name, value in others.items() if value]
    if used:
        raise InputError(
            f"{used[0]}: does not go with --continue, which takes all recordings of {earlier} and writes there; "
            f"leave {used[0]} out"
        )
