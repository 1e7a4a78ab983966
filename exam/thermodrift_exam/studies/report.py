"""The page of repeated studies as data: published figures next to ours, a figure per claim, why a claim fails."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from data.arrays import Array
from data.files import staged
from reports.drawing import Picture, picture
from reports.labels import BLUE, GREEN, INK, NOTHING, ORANGE, count, number, percent, plus_minus
from reports.layout import Column, Group, Heading, Items, Page, Pairs, Row, Section, Table, Text, given
from reports.rendering import rendered
from thermodrift_exam.studies.base import Ordering, StudyResult

_SOFT, _LINE, _FAINT = "#5a6572", "#c5cbd3", "#eef1f4"
_WIDTH_IN, _ROW_IN, _TOP_IN, _BOTTOM_IN, _LEFT_IN, _RIGHT_IN = 9.6, 0.5, 0.06, 0.5, 3.1, 1.55
_LABEL_CHARACTERS = 46


@dataclass(frozen=True)
class Strip:
    """One figure of a study over its seeds: values (S,), unit, the published value (NaN: none)."""

    label: str
    values: Array
    unit: str
    published: float
    digits: int


def claim_figure(strips: Sequence[Strip], held: NDArray[np.bool_]) -> Figure:
    """The figures of one ordering on one axis, a line per seed: grey where the ordering holds, orange where not."""
    fig, ax = _canvas(len(strips))
    places = np.arange(len(strips), dtype=float)
    table = np.stack([s.values for s in strips])  # noqa: PD011 - no frame
    for seed, holds in enumerate(held):
        ax.plot(table[:, seed], places, color=_LINE if holds else ORANGE, lw=0.8 if holds else 1.1, alpha=0.9, zorder=1)
    for place, strip in zip(places, strips, strict=True):
        _strip(ax, place, strip)
    ax.set_ylim(len(strips) - 0.5, -0.5)
    ax.set_xlabel(strips[0].unit, fontsize=9, color=_SOFT)
    return fig


def published_figure(strips: Sequence[Strip]) -> Figure:
    """Figures with a printed value, each on an axis of its own."""
    height = _ROW_IN + 0.22
    total = height * len(strips)
    fig = Figure(figsize=(_WIDTH_IN, total))
    for k, strip in enumerate(strips):
        bottom = total - height * (k + 1) + 0.27
        box = (_LEFT_IN / _WIDTH_IN, bottom / total, 1 - (_LEFT_IN + _RIGHT_IN) / _WIDTH_IN, (height - 0.3) / total)
        ax = fig.add_axes(box)
        _bare(ax)
        _strip(ax, 0.0, strip)
        ax.set_ylim(0.4, -0.4)
    return fig


def _canvas(rows: int) -> tuple[Figure, Axes]:
    total = _TOP_IN + _ROW_IN * rows + _BOTTOM_IN
    fig = Figure(figsize=(_WIDTH_IN, total))
    box = (_LEFT_IN / _WIDTH_IN, _BOTTOM_IN / total, 1 - (_LEFT_IN + _RIGHT_IN) / _WIDTH_IN, _ROW_IN * rows / total)
    ax = fig.add_axes(box)
    _bare(ax)
    return fig, ax


def _bare(ax: Axes) -> None:
    ax.set_yticks([])
    ax.tick_params(labelsize=8, color=_LINE, labelcolor=_SOFT)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.spines["bottom"].set_color(_LINE)
    ax.grid(axis="x", color=_FAINT, lw=0.8)
    ax.set_axisbelow(True)


def _strip(ax: Axes, place: float, strip: Strip) -> None:
    """Label on the left; dots, the 5–95 % range, the mean; numbers on the right."""
    values = strip.values[np.isfinite(strip.values)]  # noqa: PD011 - no frame
    side = ax.get_yaxis_transform()
    name = textwrap.fill(strip.label, _LABEL_CHARACTERS)
    ax.text(-0.02, place, name, fontsize=8.5, color=INK, transform=side, va="center", ha="right", linespacing=1.15)
    if not len(values):
        return
    low, high = np.quantile(values, [0.05, 0.95])
    ax.plot([low, high], [place, place], color=BLUE, lw=6, alpha=0.18, solid_capstyle="butt", zorder=2)
    ax.plot(values, np.full(len(values), place), "o", color=BLUE, ms=4.5, alpha=0.5, mec="none", zorder=3)
    ax.plot([values.mean()] * 2, [place - 0.16, place + 0.16], color=INK, lw=2, zorder=4)
    sd = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
    ours = plus_minus(float(values.mean()), sd, strip.digits) + f" {strip.unit}"
    printed = np.isfinite(strip.published)
    up = 0.13 if printed else 0.0
    ax.text(1.02, place - up, ours, fontsize=8.5, color=INK, transform=side, va="center")
    if printed:
        ax.plot([strip.published], [place], "D", color=GREEN, ms=7, mec="white", mew=1.0, zorder=5)
        ax.text(1.02, place + 0.17, f"published {number(strip.published, strip.digits)}", fontsize=8, color=GREEN,
                transform=side, va="center")  # fmt: skip


Record = dict[Any, Any]


def reproduction_page(results: Sequence[StudyResult]) -> Page:
    """The page of one or more studies, all of it labelled simulated."""
    rows, sections = [], []
    for result in results:
        claims = _claims(result)
        rows += [Row.of(result.study.title, title, *_verdict(row)) for title, row in claims]
        sections.append(_section(result, claims))
    verdicts = pd.Series([row.cells[2] for row in rows])
    counted = ", ".join(f"{(verdicts == v).sum()} {v}" for v in ("holds", "undecided", "fails"))
    counted = counted.replace("holds", "hold").replace("fails", "fail")
    columns = (
        Column("Study"), Column("Published ordering", kind="wide"), Column("Verdict"), Column("Holds in"),
        Column("Gain: published | ours"),
    )  # fmt: skip
    facts = (
        ("Studies", str(len(sections))),
        ("Seeds", f"{len(results[0].seeds)} simulated machine-years each"),
        ("Published orderings", counted),
        ("thermodrift", version("thermodrift")),
    )
    overview = Table("Published orderings and their verdicts", columns, tuple(rows), simulated=True)
    return Page(
        "thermodrift reproduce",
        "Published systems repeated",
        (Text(_LEAD, "lead"), Pairs(facts), overview),
        (*sections, Section("how", "How to read it", (Pairs(_HOW, "glossary"),))),
        (
            "All numbers are simulated, except those under “published”; none was measured on a machine. Every figure "
            "of every seed: values.parquet; summaries: figures.csv, orderings.csv. `thermodrift reproduce all --out "
            "FOLDER` writes this page.",
        ),
        simulated=True,
    )


_LEAD = (
    "The recordings behind the published studies are not public. Each study runs here on simulated machines built to "
    "its description, every seed another machine and another year. Nothing is tuned to make an ordering hold."
)
_HOW = (
    ("seed", "Another simulated machine of the type (every conductance, capacity and heat ±20 %), with another year of "
     "runs: room drift, start from non-equilibrium, friction, sensor offsets, noise."),
    ("± and 5 … 95 %", "Standard deviation and quantiles over the seeds, not over batches."),
    ("holds in", "Seeds in which every inequality of the ordering is true, with the 95 % interval of Clopper and "
     "Pearson for its probability."),
    ("holds, fails, undecided", "The whole interval lies above one half, below it, or neither. This is a two-sided "
     "sign test at 5 %."),
    ("gain", "1 − a/b of the ordering's first pair, a the one said to be less: the median over the seeds, in brackets "
     "5 … 95 %."),
    ("evidence", "An ordering that no source printed, counted the same way, to say why a published one holds or does "
     "not."),
)  # fmt: skip


def spread(row: Record) -> tuple[str, str]:
    """Mean ± sd, and the 5–95 % range, with the figure's digits."""
    digits = int(row["digits"])
    low, high = number(float(row["p5"]), digits), number(float(row["p95"]), digits)
    return plus_minus(float(row["mean"]), float(row["sd"]), digits), f"{low} … {high}"


def counted_label(row: Record) -> str:
    """``12 of 20 (36 % … 81 %)``."""
    return f"{row['held']} of {row['seeds']} ({percent(row['low'])} … {percent(row['high'])})"


def gain_label(row: Record) -> str:
    """``23 % | 3 (−38 … 30) %``; a dash where nothing was printed."""
    return f"{printed_gain(row)} | {our_gain(row)}"


def printed_gain(row: Record) -> str:
    """A gain as published, in percent."""
    return NOTHING if pd.isna(row["published_gain"]) else f"{number(100 * float(row['published_gain']), 0)} %"


def our_gain(row: Record) -> str:
    """Median gain and its 5–95 % range over the seeds, in percent."""
    median, low, high = (number(100 * float(row[k]), 0) for k in ("gain", "gain_p5", "gain_p95"))
    return f"{median} ({low} … {high}) %"


def _claims(result: StudyResult) -> list[tuple[str, Record]]:
    """Of each published ordering its label and its row."""
    found = {str(r["ordering"]): r for r in result.orderings().to_dict("records")}
    published = [o for o in result.study.orderings if not o.evidence_for]
    return [(o.label[0].upper() + o.label[1:], found[o.key]) for o in published]


def _verdict(row: Record) -> tuple[str, str, str]:
    return str(row["verdict"]), counted_label(row), gain_label(row)


def _section(result: StudyResult, claims: Sequence[tuple[str, Record]]) -> Section:
    study, table, strips = result.study, result.figures(), _strips(result)
    printed: list[str] = [f.key for f in study.figures if f.published is not None]
    orderings = result.orderings()
    evidence = {key: part for key, part in orderings.groupby("evidence_for", sort=False) if key}
    source = f"{study.summary[0].upper()}{study.summary[1:]}, after the {study.source}."
    blocks: list[Any] = [Text(source, "lead"), Text(study.machine, strong="Machine."), Items(study.assumed, "how soft")]
    if printed:
        blocks.append(_figures("Published figures and ours", table[table["published"].notna()]))
        drawn = published_figure([strips[k] for k in printed])
        blocks.append(_picture(drawn, "Published (diamond) and ours, a dot per seed"))
    blocks += [Text(said) for said in result.remarks]
    by_key = {o.key: o for o in study.orderings}
    for title, row in claims:
        key = str(row["ordering"])
        blocks.append(_claim(result, by_key[key], title, row, strips, evidence.get(key)))
    blocks.append(_figures("Every figure of the study", table).folded())
    return Section(study.key, study.title, given(*blocks), simulated=True)


def _claim(
    result: StudyResult, ordering: Ordering, title: str, row: Record, strips: dict[str, Strip],
    found: pd.DataFrame | None,
) -> Group:  # fmt: skip
    names = list(dict.fromkeys(name for pair in ordering.less for name in pair))
    held = np.array([ordering.holds(values) for values in result.by_seed(names)])
    columns = (Column("Evidence", kind="wide"), Column("Verdict"), Column("Holds in"), Column("Gain"))
    rows = []
    for e in found.to_dict("records") if found is not None else []:
        rows.append(Row.of(str(e["words"]), str(e["verdict"]), counted_label(e), our_gain(e)))
    verdict, counted, gain = _verdict(row)
    blocks = given(
        Heading(title, (verdict, verdict)),
        Text(f"Holds in {counted} of the seeds; gain, published | ours: {gain}", "soft"),
        Text(str(row["why"]), "" if verdict == "holds" else "why"),
        _picture(claim_figure([strips[n] for n in names], held), "A line per seed; orange where the ordering fails"),
        Table("Evidence within the study", columns, tuple(rows), simulated=True) if rows else None,
    )
    return Group(blocks, "claim")


def _picture(figure: Figure, label: str) -> Picture:
    return replace(picture(figure, label, True, "svg", "full"), captioned=True)


def _strips(result: StudyResult) -> dict[str, Strip]:
    wide = result.wide
    return {
        f.key: Strip(
            f.label, wide[f.key].to_numpy(float), f.unit, np.nan if f.published is None else f.published, f.digits
        )
        for f in result.study.figures
    }


def _figures(caption: str, table: pd.DataFrame) -> Table:
    columns = (Column("Figure", kind="wide"), Column("Unit"), Column("Published", kind="number"),
               Column("Ours: mean ± sd", kind="number"), Column("5 … 95 %", kind="number"))  # fmt: skip
    rows = []
    for row in table.to_dict("records"):
        published = number(float(row["published"]), int(row["digits"]))
        rows.append(Row.of(str(row["words"]), str(row["unit"]), published, *spread(row)))
    note = f"Over {count(int(table['seeds'].max()), 'seed')}, each another machine and year."
    return Table(caption, columns, tuple(rows), simulated=True, notes=(note,))


FILES = ("values.parquet", "figures.csv", "orderings.csv", "reproduction.md", "reproduction.html")


def write_results(results: Sequence[StudyResult], folder: Path) -> Path:
    """Write all files or none; returns the page's path. Every table has a column that marks it as simulated.

    Raises:
        WorkError: the folder cannot be written.
    """
    page = reproduction_page(results)
    with staged(folder, FILES) as scratch:
        _together([r.table for r in results]).to_parquet(scratch / FILES[0], index=False)
        _together([r.figures() for r in results]).to_csv(scratch / FILES[1], index=False, lineterminator="\n")
        _together([r.orderings() for r in results]).to_csv(scratch / FILES[2], index=False, lineterminator="\n")
        for name in FILES[3:]:
            (scratch / name).write_text(rendered(page, Path(name).suffix), encoding="utf-8")
    return folder / FILES[-1]


def _together(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    return pd.concat(tables, ignore_index=True).assign(simulated=True)
