"""`thermodrift reproduce`: published studies repeated on simulated machines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from data.errors import InputError, closest
from pipelines import console
from pipelines.options import Json
from reports.labels import number, percent
from thermodrift_exam.commands import Workers, processes

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

    from thermodrift_exam.studies.base import StudyResult

LABEL = "SIMULATED"


def print_results(results: Sequence[StudyResult], page: Path | None) -> None:
    """Per study: figures with a published value, orderings with their evidence, why what does not hold does not."""
    for result in results:
        study = result.study
        console.out.print(f"{study.key} ({LABEL})", style="bold", highlight=False)
        console.line(f"{study.summary}; after the {study.source}; {len(result.seeds)} simulated machine-years")
        printed = result.figures().dropna(subset="published")
        if len(printed):
            console.out.print(_figures(printed))
        table = result.orderings()
        console.out.print(_orderings(table))
        for remark in result.remarks:
            console.line(remark)
        for row in table[(table["verdict"] != "holds") & (table["why"] != "")].to_dict("records"):
            console.line(f"why not always: {row['words']}: {row['why']}")
    if page is not None:
        console.line(f"page     {page}")


def studies_dict(results: Sequence[StudyResult], page: Path | None) -> dict[str, Any]:
    """The outcome of the studies for other programs."""
    from importlib.metadata import version

    return {
        "simulated": True,
        "thermodrift": version("thermodrift"),
        "page": None if page is None else str(page),
        "studies": [
            {
                "study": r.study.key,
                "source": r.study.source,
                "machine": r.study.machine,
                "assumed": list(r.study.assumed),
                "remarks": list(r.remarks),
                "seeds": list(r.seeds),
                "figures": console.records(r.figures().drop(columns="study")),
                "orderings": console.records(r.orderings().drop(columns="study")),
            }
            for r in results
        ],
    }


def _figures(table: pd.DataFrame) -> Table:
    from thermodrift_exam.studies.report import spread

    columns = ("figure", "unit", "published", "ours", "5 … 95 %")
    shown = console.table(f"published | ours ({LABEL})", *columns, left=columns[:1], wrap=columns[:1])
    for row in table.to_dict("records"):
        published = number(float(row["published"]), int(row["digits"]))
        shown.add_row(str(row["words"]), str(row["unit"]), published, *spread(row))
    return shown


def _orderings(table: pd.DataFrame) -> Table:
    from thermodrift_exam.studies.report import our_gain, printed_gain

    columns = ("verdict", "seeds", "95 %", "printed", "gain", "ordering")
    shown = console.table(f"orderings ({LABEL})", *columns, left=("verdict", "ordering"), wrap=("ordering",))
    for row in table.to_dict("records"):
        evidence = bool(row["evidence_for"])
        label = f"evidence: {row['words']}" if evidence else str(row["words"])
        interval = f"{percent(row['low']).removesuffix(' %')} … {percent(row['high'])}"
        held = f"{row['held']}/{row['seeds']}"
        cells = (str(row["verdict"]), held, interval, printed_gain(row), our_gain(row), label)
        shown.add_row(*cells, style="dim" if evidence else None)
    return shown


def reproduce(
    study: Annotated[str, typer.Argument(help="a published study, or `all`")],
    seeds: Annotated[int, typer.Option(help="simulated machine-years")] = 20,
    to: Annotated[Path | None, typer.Option("--out", help="folder of the page and the tables")] = None,
    workers: Workers = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="replace an earlier page in --out")] = False,
    as_json: Json = False,
) -> None:
    """Repeat published studies on simulated machines: their figures next to ours, and which orderings hold."""
    from thermodrift_exam.studies import STUDIES
    from thermodrift_exam.studies.base import run_studies
    from thermodrift_exam.studies.report import FILES, write_results

    if study != "all" and study not in STUDIES:
        raise InputError(f"unknown study {study!r}: {closest(study, [*STUDIES, 'all'])}")
    count = processes(workers)
    if to is not None:
        from data.files import check_folder

        check_folder(to, [to / name for name in FILES], overwrite)
    with console.progress(as_json) as (_, done):
        results = list(run_studies(tuple(STUDIES) if study == "all" else (study,), seeds, count, done).values())
        page = write_results(results, to) if to is not None else None
    if as_json:
        console.print_json(studies_dict(results, page))
    else:
        print_results(results, page)
