"""What `thermodrift diagnose` shows: the verdict, what was found, left-out errors, the next run, and where it lies."""

from __future__ import annotations

import json
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from diagnosis.findings.schema import Finding
from diagnosis.result import Diagnosis
from pipelines import screen
from pipelines.diagnosing import FINDINGS, MACHINE, PLAN, REPORT, DiagnosisOutcome
from reports.diagnosis import tables as words
from reports.diagnosis.tables import by_channel
from reports.labels import count, number

_WHAT = {
    REPORT: "the report, one page",
    MACHINE: "the machine file with what was found",
    PLAN: "the next run's plan",
    FINDINGS: "the findings, for machines",
}


def outcome_dict(outcome: DiagnosisOutcome) -> dict[str, Any]:
    """What came of a diagnosis, for machines; `diagnosis` is findings.json as it was written."""
    return {
        "diagnosis": json.loads(outcome.files[FINDINGS].read_text(encoding="utf-8")),
        "out": str(outcome.out),
        "files": {name: str(path) for name, path in outcome.files.items()},
        "run_id": outcome.run_id,
        "quarantined": [r.reason for r in outcome.ingested.quarantined] if outcome.ingested else [],
        "trouble": outcome.trouble,
    }


def print_outcome(outcome: DiagnosisOutcome) -> None:
    d, f = outcome.diagnosis, outcome.diagnosis.findings
    label = "  (simulated recordings)" if d.simulated else ""
    against = " against a drafted network: the machine file has no twin part" if d.drafted else ""
    screen.line(f"{f.machine}: diagnosis of {count(len(f.batches), 'batch')}{against}{label}")
    if outcome.ingested is not None and outcome.ingested.quarantined:
        bad = outcome.ingested.quarantined
        screen.line(f"files in quarantine: {len(bad)}, not used; {bad[0].reason}")
    screen.out.print(words.headline(f.verdict, [x.probability for x in f.findings]), style="bold", highlight=False)
    for line in sentences(d):
        screen.line(line)
    if len(d.tables["rms"]):
        screen.out.print(error_table(d))
    if f.findings:
        screen.line(f"left-out batches that improve: {f.fit.batches_improved} of {f.fit.batches}")
    if f.next_experiment is not None:
        screen.line(f"next run: {words.experiment_words(f.next_experiment)}")
    for remark in d.words:
        screen.line(f"note: {remark}")
    for name, what in _WHAT.items():
        if name in outcome.files:
            screen.line(f"{outcome.files[name]}: {what}")


def sentences(d: Diagnosis) -> list[str]:
    """A sentence a finding with its probability, numbered; without any, what the verdict means here."""
    f = d.findings
    if f.findings:
        return [f"{k}. {_with_probability(x)}" for k, x in enumerate(f.findings, 1)]
    lead = f.statement or words.below_headline(f.verdict, f.fit.batches, len(d.tables["limits"]))
    return [lead] if lead else []


def _with_probability(x: Finding) -> str:
    """The statement, which says its probability itself where it is not sure."""
    percent = words.probability_words(x.probability).replace(words.NARROW, " ")
    return x.statement if percent in x.statement else f"{x.statement} ({percent})"


def error_table(d: Diagnosis) -> Table:
    """Left-out rms of every channel before and after, and what noise alone leaves."""
    table = Table(title="left-out rms", box=SIMPLE_HEAD, title_justify="left", pad_edge=False, show_edge=False)
    for name in ("channel", "unit"):
        table.add_column(name, no_wrap=True)
    for name in ("batches", "before", "after", "noise"):
        table.add_column(name, justify="right", no_wrap=True)
    for r in by_channel(d.tables["rms"]).to_dict("records"):
        digits = 1 if max(r["before"], r["after"]) >= 9.5 else 2
        shown = (number(r[k], digits) for k in ("before", "after", "floor"))
        table.add_row(str(r["channel"]), words.UNITS.get(str(r["unit"]), str(r["unit"])), str(r["batches"]), *shown)
    return table
