"""The report of the proof: how the diagnosis did on recordings in which the effect is concealed, on one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from data.atomic_file import write_atomic
from data.errors import WorkError
from pipelines.report import proof_words as words
from pipelines.report.proof_goals import GoalRow, counted, goal_rows, shortfalls
from pipelines.report.proof_parts import Part, proof_parts
from pipelines.report.proof_run import ProofRun
from pipelines.report.words import count
from pipelines.report.write import template_environment

__all__ = ["ProofPage", "ProofRun", "proof_page", "write_proof_report"]

REPORT = "report.html"
_MOST_MISSED = 4


@dataclass(frozen=True)
class ProofPage:
    """Everything that the template shows."""

    title: str
    headline: str
    lead: str
    warnings: tuple[str, ...]
    origin: str
    facts: tuple[tuple[str, str], ...]
    root: str
    source_digest: str
    plants: tuple[tuple[str, str], ...]  # label and where its recordings come from
    goals: tuple[GoalRow, ...]
    shortfalls: tuple[str, ...]
    parts: tuple[Part, ...]
    method: tuple[str, ...]
    glossary: tuple[tuple[str, str], ...]


def write_proof_report(folder: Path, run: ProofRun) -> Path:
    """Write `report.html` into the proof's folder. It needs no network; it appears whole or not at all.

    Raises:
        WorkError: the folder cannot be written.
    """
    path = Path(folder) / REPORT
    written = f"{pd.Timestamp.now('UTC'):%Y-%m-%d %H:%M} UTC"
    text = template_environment(True).get_template("proof.html.j2").render(page=proof_page(run), written=written)
    try:
        write_atomic(path, text)
    except OSError as error:
        raise WorkError(f"report {path}: cannot be written ({error.strerror}); free the place and open again") from None
    return path


def proof_page(run: ProofRun) -> ProofPage:
    """Collect the page. A table that is absent leaves a sentence in its section's place."""
    goals = run.table("goals")
    sealed = run.suite == "sealed"
    return ProofPage(
        title=f"The diagnosis examined: {count(run.cases, 'sealed case' if sealed else 'development case')}",
        headline=headline(run),
        lead=lead(goals),
        warnings=tuple(_warnings(run)),
        origin=words.origin(run.plants),
        facts=tuple(_facts(run)),
        root=run.root,
        source_digest=run.source_digest,
        plants=tuple((words.plant_label(p), words.plant_origin(p)) for p in run.plants),
        goals=goal_rows(goals, run.plants),
        shortfalls=tuple(shortfalls(goals)),
        parts=tuple(proof_parts(run)),
        method=words.METHOD,
        glossary=words.GLOSSARY,
    )


def headline(run: ProofRun) -> str:
    """``11 of 13 goals met on 299 sealed cases.``"""
    met, missed, _ = counted(run.table("goals"))
    cases = count(len(run.table("outcomes")), "sealed case" if run.suite == "sealed" else "development case")
    if not met + missed:
        return f"No goal could be judged on {cases}."
    told = "Every goal" if not missed else "No goal" if not met else f"{met} of {met + missed} goals"
    return f"{told} met on {cases}."


def lead(goals: pd.DataFrame) -> str:
    """What was missed, the first in words; then what could not be measured."""
    _, missed, unknown = counted(goals)
    more = [f"{missed - _MOST_MISSED} more, in the table"] if missed > _MOST_MISSED else []
    parts = [f"Missed: {'; '.join([*shortfalls(goals)[:_MOST_MISSED], *more])}."] if missed else []
    if unknown:
        parts.append(f"{count(unknown, 'goal')} had no case to be judged on.")
    return " ".join(parts)


def _warnings(run: ProofRun) -> Sequence[str]:
    return [
        *([words.NOT_SEALED] if run.suite != "sealed" else []),
        *([words.PARTIAL] if run.partial else []),
    ]


def _facts(run: ProofRun) -> list[tuple[str, str]]:
    counts = run.table("outcomes")["plant"].value_counts()
    plants = ", ".join(f"{words.plant_letter(p)} {counts[p]}" for p in run.plants)
    return [
        ("Cases sealed", f"{run.cases}"),
        ("Cases that count", f"{len(run.table('outcomes'))}" + (f" (plant {plants})" if plants else "")),
        ("Void, left out", f"{len(run.void)}"),
        ("Failed, counted as wrong", f"{len(run.failed)}"),
        ("Sealed root", run.root[:16]),
        ("Sealed", _stamp(run.sealed)),
        ("Opened", _stamp(run.opened)),
        ("thermodrift", run.version),
    ]


def _stamp(utc: str) -> str:
    return f"{pd.Timestamp(utc):%Y-%m-%d %H:%M} UTC" if utc else ""
