"""The page of repeated studies as data: published figures beside ours, a figure per claim, why what fails fails."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from models.studies.base import Ordering
from models.studies.result import StudyResult
from pipelines.report.layout import Column, Row, Table
from pipelines.report.network_picture import picture_bytes
from pipelines.report.reproduction_figures import Strip, claim_figure, published_figure
from pipelines.report.words import NOTHING, count, number, percent, plus_minus

Record = dict[Any, Any]


@dataclass(frozen=True)
class Claim:
    """One published ordering: what came out, why, and its picture as a data: address."""

    words: str
    verdict: str
    counted: str
    gain: str
    why: str
    evidence: Table | None
    picture: str


@dataclass(frozen=True)
class StudyPart:
    """One study's section."""

    key: str
    title: str
    source: str
    machine: str
    assumed: tuple[str, ...]
    remarks: tuple[str, ...]
    published: Table | None
    published_picture: str
    claims: tuple[Claim, ...]
    figures: Table


@dataclass(frozen=True)
class ReproductionPage:
    """Everything that the templates show."""

    title: str
    facts: tuple[tuple[str, str], ...]
    overview: Table
    parts: tuple[StudyPart, ...]


def reproduction_page(results: Sequence[StudyResult]) -> ReproductionPage:
    """Collect the page of one or more studies, all of it labelled simulated."""
    parts = tuple(_part(r) for r in results)
    verdicts = pd.Series([c.verdict for p in parts for c in p.claims])
    counted = ", ".join(f"{(verdicts == v).sum()} {v}" for v in ("holds", "undecided", "fails"))
    counted = counted.replace("holds", "hold").replace("fails", "fail")
    rows = [Row((p.title, c.words, c.verdict, c.counted, c.gain)) for p in parts for c in p.claims]
    columns = (
        Column("Study"), Column("Published ordering", kind="wide"), Column("Verdict"), Column("Holds in"),
        Column("Gain: published | ours"),
    )  # fmt: skip
    return ReproductionPage(
        title="Published systems repeated",
        facts=(
            ("Studies", str(len(parts))),
            ("Seeds", f"{len(results[0].seeds)} simulated machine-years each"),
            ("Published orderings", counted),
            ("thermodrift", version("thermodrift")),
        ),
        overview=Table("Published orderings and what became of them", columns, tuple(rows), simulated=True),
        parts=parts,
    )


def spread(row: Record) -> tuple[str, str]:
    """Mean ± sd, and the 5–95 % range, with the figure's digits."""
    digits = int(row["digits"])
    low, high = number(float(row["p5"]), digits), number(float(row["p95"]), digits)
    return plus_minus(float(row["mean"]), float(row["sd"]), digits), f"{low} … {high}"


def counted_words(row: Record) -> str:
    """``12 of 20 (36 % … 81 %)``."""
    return f"{row['held']} of {row['seeds']} ({percent(row['low'])} … {percent(row['high'])})"


def gain_words(row: Record) -> str:
    """``23 % | 3 (−38 … 30) %``; a dash where nothing was printed."""
    return f"{printed_gain(row)} | {our_gain(row)}"


def printed_gain(row: Record) -> str:
    """A gain as published, in percent."""
    return NOTHING if pd.isna(row["published_gain"]) else f"{number(100 * float(row['published_gain']), 0)} %"


def our_gain(row: Record) -> str:
    """Median gain and its 5–95 % range over the seeds, in percent."""
    median, low, high = (number(100 * float(row[k]), 0) for k in ("gain", "gain_p5", "gain_p95"))
    return f"{median} ({low} … {high}) %"


def _part(result: StudyResult) -> StudyPart:
    study, table = result.study, result.figures()
    strips = _strips(result)
    printed: list[str] = [f.key for f in study.figures if f.published is not None]
    orderings = result.orderings()
    evidence = {key: part for key, part in orderings.groupby("evidence_for", sort=False) if key}
    claims = [
        _claim(result, o, orderings[orderings["ordering"] == o.key].to_dict("records")[0], strips, evidence.get(o.key))
        for o in study.orderings
        if not o.evidence_for
    ]
    return StudyPart(
        key=study.key,
        title=study.title,
        source=f"{study.words[0].upper()}{study.words[1:]}, after the {study.source}.",
        machine=study.machine,
        assumed=study.assumed,
        remarks=result.remarks,
        published=_figures("Published figures and ours", table[table["published"].notna()]) if printed else None,
        published_picture=_source(published_figure([strips[k] for k in printed])) if printed else "",
        claims=tuple(claims),
        figures=_figures("Every figure of the study", table),
    )


def _claim(
    result: StudyResult, ordering: Ordering, row: Record, strips: dict[str, Strip], found: pd.DataFrame | None
) -> Claim:
    names = list(dict.fromkeys(name for pair in ordering.less for name in pair))
    held = np.array([ordering.holds(values) for values in result.by_seed(names)])
    columns = (Column("Evidence", kind="wide"), Column("Verdict"), Column("Holds in"), Column("Gain"))
    rows = []
    for e in found.to_dict("records") if found is not None else []:
        rows.append(Row((str(e["words"]), str(e["verdict"]), counted_words(e), our_gain(e))))
    return Claim(
        words=ordering.words[0].upper() + ordering.words[1:],
        verdict=str(row["verdict"]),
        counted=counted_words(row),
        gain=gain_words(row),
        why=str(row["why"]),
        evidence=Table("What the study itself says about it", columns, tuple(rows), simulated=True) if rows else None,
        picture=_source(claim_figure([strips[n] for n in names], held)),
    )


def _strips(result: StudyResult) -> dict[str, Strip]:
    wide = result.wide
    return {
        f.key: Strip(
            f.words, wide[f.key].to_numpy(float), f.unit, np.nan if f.published is None else f.published, f.digits
        )
        for f in result.study.figures
    }


def _figures(caption: str, table: pd.DataFrame) -> Table:
    columns = (Column("Figure", kind="wide"), Column("Unit"), Column("Published", kind="number"),
               Column("Ours: mean ± sd", kind="number"), Column("5 … 95 %", kind="number"))  # fmt: skip
    rows = []
    for row in table.to_dict("records"):
        published = number(float(row["published"]), int(row["digits"]))
        rows.append(Row((str(row["words"]), str(row["unit"]), published, *spread(row))))
    note = f"Over {count(int(table['seeds'].max()), 'seed')}, each another machine and year."
    return Table(caption, columns, tuple(rows), simulated=True, notes=(note,))


def _source(figure: Figure) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(picture_bytes(figure, "svg")).decode("ascii")
