"""The report of a diagnosis: what was found, where, how much better, and the evidence, on one self-contained page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from data.atomic_file import write_atomic
from data.errors import InputError
from pipelines.report import diagnosis_words as words
from pipelines.report.diagnosis_extracts import by_change, by_channel
from pipelines.report.diagnosis_parts import Part, diagnosis_parts
from pipelines.report.words import number
from pipelines.report.write import template_environment
from twin.diagnosis.diagnosis import Diagnosis
from twin.diagnosis.telling.findings import Finding

_MOST_FIGURES, _TELLING = 3, 0.1  # a change by the noise floor
_DRAFTED = (
    "The machine file has no twin part. This diagnosis is against a network that was drafted from the recordings: "
    "places are named after the sensors."
)


@dataclass(frozen=True)
class Found:
    """A finding as it stands on top of the page."""

    number: int
    statement: str
    what: str
    where: str
    when: str
    others: str
    probability: str
    likelihood: str
    percent: float  # of the bar


@dataclass(frozen=True)
class KeyFigure:
    """One large number."""

    label: str
    before: str
    after: str
    unit: str
    small: str


@dataclass(frozen=True)
class DiagnosisPage:
    """Everything that the template shows."""

    title: str
    machine: str
    simulated: bool
    verdict: str
    chip: str
    headline: str
    lead: str
    drafted: str
    found: tuple[Found, ...]
    figures: tuple[KeyFigure, ...]
    settle: str  # the run that would tell tied causes apart
    remarks: tuple[str, ...]
    parts: tuple[Part, ...]
    method: tuple[str, ...]
    glossary: tuple[tuple[str, str], ...]
    seconds: str


def write_diagnosis_report(path: Path, d: Diagnosis, pictures: bool = True) -> None:
    """Write the page. It holds everything it needs and asks no network; it appears whole or not at all.

    Without `pictures` the tables and words alone.

    Raises:
        InputError: another suffix than .html, or a place that cannot be written.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise InputError(f"report {path}: got suffix {path.suffix!r}, expected .html")
    shown = diagnosis_page(d, pictures)
    written = f"{pd.Timestamp.now('UTC'):%Y-%m-%d %H:%M} UTC"
    text = template_environment(True).get_template("diagnosis.html.j2").render(page=shown, written=written)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, text)
    except OSError as error:
        raise InputError(f"report {path}: cannot be written ({error.strerror}); give another place") from None


def diagnosis_page(d: Diagnosis, pictures: bool = True) -> DiagnosisPage:
    """Collect the page; whatever table is empty leaves its section out."""
    f = d.findings
    lead = f.statement or words.below_headline(f.verdict, f.fit.batches, bool(len(d.tables["limits"])))
    return DiagnosisPage(
        title=f"Diagnosis of {f.machine}: {words.CHIPS[f.verdict]}",
        machine=f.machine,
        simulated=d.simulated,
        verdict=f.verdict,
        chip=words.CHIPS[f.verdict],
        headline=words.headline(f.verdict, [x.probability for x in f.findings]),
        lead="" if f.findings else lead,  # the findings say it themselves
        drafted=_DRAFTED if d.drafted else "",
        found=tuple(_found(k, x) for k, x in enumerate(f.findings, 1)),
        figures=tuple(_figures(d)),
        settle="" if f.next_experiment is None else words.experiment_words(f.next_experiment),
        remarks=d.words,
        parts=tuple(diagnosis_parts(d, pictures)),
        method=words.METHOD,
        glossary=words.GLOSSARY,
        seconds="" if f.seconds is None else words.seconds_words(f.seconds),
    )


def _found(k: int, x: Finding) -> Found:
    what = words.mechanism_words(x.mechanism)
    others = [(o.mechanism, o.where.kind, o.where.name, o.probability) for o in x.alternatives]
    return Found(
        k,
        x.statement,
        what,
        words.where_words(x.where.kind, x.where.name),
        x.when.regime,
        words.alternative_words(others),
        words.probability_words(x.probability),
        words.likelihood(x.probability),
        round(100 * x.probability, 1),
    )


def _figures(d: Diagnosis) -> list[KeyFigure]:
    """The channels that changed most (or, where nothing did, that differ most), then the runs that improved."""
    f, changed = d.findings, bool(d.findings.findings)
    out = []
    if len(d.tables["rms"]):
        ranked = by_change(by_channel(d.tables["rms"]))
        telling = ranked[ranked["change"] > _TELLING]
        ranked = telling if changed and len(telling) else ranked
        for r in ranked[:_MOST_FIGURES].to_dict("records"):
            digits = 1 if max(r["before"], r["after"]) >= 0.95 else 2
            unit = words.UNITS.get(str(r["unit"]), str(r["unit"]))
            before = number(r["before"], digits) if changed else ""
            small = f"noise {number(r['floor'], digits)} {unit}"
            out.append(KeyFigure(f"{r['channel']}, left-out rms", before, number(r["after"], digits), unit, small))
    runs = f.fit.batches
    if changed:
        improved = f"{f.fit.batches_improved} of {runs}"
        out.append(KeyFigure("left-out runs that improve", "", improved, "", "each predicted from the others"))
    else:
        out.append(KeyFigure("left-out runs", "", f"{runs}", "", "each predicted from the others"))
    return out
