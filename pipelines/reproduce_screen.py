"""What `thermodrift reproduce` says: published figures beside ours, and every ordering counted."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.table import Table

from evidence.studies.base import StudyResult
from evidence.studies.report import our_gain, printed_gain, spread
from pipelines import screen
from reports.labels import number, percent

LABEL = "SIMULATED"


def print_results(results: Sequence[StudyResult], page: Path | None) -> None:
    """Per study: figures with a published value, orderings with their evidence, why what does not hold does not."""
    for result in results:
        study = result.study
        screen.out.print(f"{study.key} ({LABEL})", style="bold", highlight=False)
        screen.line(f"{study.words}; after the {study.source}; {len(result.seeds)} simulated machine-years")
        printed = result.figures().dropna(subset="published")
        if len(printed):
            screen.out.print(_figures(printed))
        table = result.orderings()
        screen.out.print(_orderings(table))
        for remark in result.remarks:
            screen.line(remark)
        for row in table[(table["verdict"] != "holds") & (table["why"] != "")].to_dict("records"):
            screen.line(f"why not always: {row['words']}: {row['why']}")
    if page is not None:
        screen.line(f"page     {page}")


def outcome_dict(results: Sequence[StudyResult], page: Path | None) -> dict[str, Any]:
    """What came of the studies, for machines."""
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
                "figures": screen.records(r.figures().drop(columns="study")),
                "orderings": screen.records(r.orderings().drop(columns="study")),
            }
            for r in results
        ],
    }


def _figures(table: pd.DataFrame) -> Table:
    shown = _table(f"published | ours ({LABEL})", "figure", "unit", "published", "ours", "5 … 95 %")
    for row in table.to_dict("records"):
        published = number(float(row["published"]), int(row["digits"]))
        shown.add_row(str(row["words"]), str(row["unit"]), published, *spread(row))
    return shown


def _orderings(table: pd.DataFrame) -> Table:
    shown = _table(f"orderings ({LABEL})", "verdict", "seeds", "95 %", "printed", "gain", "ordering")
    for row in table.to_dict("records"):
        evidence = bool(row["evidence_for"])
        words = f"evidence: {row['words']}" if evidence else str(row["words"])
        sure = f"{percent(row['low']).removesuffix(' %')} … {percent(row['high'])}"
        held = f"{row['held']}/{row['seeds']}"
        cells = (str(row["verdict"]), held, sure, printed_gain(row), our_gain(row), words)
        shown.add_row(*cells, style="dim" if evidence else None)
    return shown


def _table(title: str, *names: str) -> Table:
    """The words wrap, numbers do not."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for name in names:
        words = name in ("figure", "ordering")
        table.add_column(name, no_wrap=not words, justify="left" if words or name == "verdict" else "right")
    return table
