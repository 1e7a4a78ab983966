"""The report of one thermal test "in the style of ISO 230-3": figure over one time axis, test sheet, page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from data.batch import Batch
from data.errors import InputError
from data.files import write_atomic
from data.units import unit_label
from features.iso230_3 import HOUR_S, ProbePair, ThermalTest, Trace, clock, thermal_test
from reports.drawing import GREY, LINES, MUTED, Picture, data_address, picture_bytes
from reports.labels import INK, ORANGE, count, listed, number, tex_escaped
from reports.layout import Column, Page, Pairs, Row, Section, Table, Text, given
from reports.rendering import rendered

_WIDTH_IN, _LEFT_IN, _RIGHT_IN, _TOP_IN, _BOTTOM_IN, _GAP_IN = 10.0, 0.75, 1.75, 0.62, 0.5, 0.16
_MOST_NAMED = 6
_DPI = 150


def iso_figure(batch: Batch, test: ThermalTest) -> Figure:
    """Stacked panels. Simulated data are stamped next to the title and across the displacement."""
    displacement = [t for t in test.traces if t.unit != "um/m"]
    tilts = [t for t in test.traces if t.unit == "um/m"]
    panels: list[tuple[float, str]] = [(2.5, "displacement")]
    panels += [(1.6, "tilt")] if tilts else []
    panels += [(2.3, "temperatures")] if len(test.temperatures) else []
    panels += [(1.0, name) for name in (test.speed, test.feed, test.position) if name]
    fig, axes = stacked([height for height, _ in panels])
    rows = (batch.time_s >= test.start_s - 1e-6) & (batch.time_s <= test.end_s + 1e-6)
    hours = batch.time_s[rows] / 3600
    for ax, (_, name) in zip(axes, panels, strict=True):
        if name == "displacement":
            units = sorted({t.unit for t in displacement}) or ["um"]
            _traces(ax, displacement, f"displacement ({', '.join(map(unit_label, units))})")
        elif name == "tilt":
            _traces(ax, tilts, "tilt (µm/m)")
        elif name == "temperatures":
            _draw_temperatures(ax, batch, test, rows)
        else:
            unit = unit_label(batch.channels[name].unit)
            values = batch.values(name)[rows]
            ax.step(hours, values, where="post", color=INK, lw=1.2)
            if np.nanmin(values) == np.nanmax(values):
                ax.set_yticks([float(np.nanmin(values))])
            ax.set_ylabel(f"{tex_escaped(name)}\n({unit})", fontsize=8)
            ax.margins(y=0.15)
        ax.set_xlim(test.start_s / 3600, test.end_s / 3600)
    _periods(axes, test)
    axes[-1].set_xlabel("time (h)", fontsize=9)
    height_in = fig.get_figheight()
    title = f"{test.title.removesuffix(' (SIMULATED)')}, {tex_escaped(test.machine)}, {tex_escaped(test.batch_id)}"
    fig.text(_LEFT_IN / _WIDTH_IN, 1 - 0.24 / height_in, title, fontsize=11, color=INK, fontweight="bold", va="center")
    if test.simulated:
        stamp: dict[str, Any] = {"color": ORANGE, "fontweight": "bold", "va": "center"}
        fig.text(1 - 0.12 / _WIDTH_IN, 1 - 0.24 / height_in, "SIMULATED", fontsize=11, ha="right", **stamp)
        axes[0].text(
            0.5, 0.5, "SIMULATED", transform=axes[0].transAxes, fontsize=40, alpha=0.10, ha="center", zorder=0, **stamp
        )
    return fig


def stacked(heights_in: Sequence[float]) -> tuple[Figure, list[Axes]]:
    """Stacked axes of given heights in inches, one time axis."""
    total = _TOP_IN + sum(heights_in) + _GAP_IN * (len(heights_in) - 1) + _BOTTOM_IN
    fig = Figure(figsize=(_WIDTH_IN, total))
    axes: list[Axes] = []
    top = total - _TOP_IN
    for height in heights_in:
        box = (_LEFT_IN / _WIDTH_IN, (top - height) / total, 1 - (_LEFT_IN + _RIGHT_IN) / _WIDTH_IN, height / total)
        ax = fig.add_axes(box, sharex=axes[0] if axes else None)
        ax.tick_params(labelsize=8, labelbottom=False, color=MUTED)
        ax.spines[["top", "right"]].set_visible(False)
        ax.grid(axis="y", color="#eef1f4", lw=0.8)
        ax.set_axisbelow(True)
        axes.append(ax)
        top -= height + _GAP_IN
    axes[-1].tick_params(labelbottom=True)
    fig.align_ylabels(axes)
    return fig, axes


def _traces(ax: Axes, traces: Sequence[Trace], label: str) -> None:
    for k, t in enumerate(traces):
        look: dict[str, Any] = {"color": LINES[k % len(LINES)], "lw": 1.4, "marker": "o" if t.every_stay else None}
        ax.plot(t.time_s / 3600, t.value, ms=2.5, label=tex_escaped(t.name), **look)
    ax.axhline(0, color=MUTED, lw=0.6)
    ax.set_ylabel(label, fontsize=8)
    side_legend(ax)


def _draw_temperatures(ax: Axes, batch: Batch, test: ThermalTest, rows: NDArray[np.bool_]) -> None:
    """The channels that move most and the surroundings by name, the rest in grey."""
    table: pd.DataFrame = test.temperatures.assign(swing=test.temperatures.greatest_degC - test.temperatures.least_degC)
    table = table.dropna(subset="swing")
    ambient = [str(n) for n in table.loc[table.role == "ambient", "channel"]]
    sensors = table[table.role != "ambient"].sort_values("swing", ascending=False, kind="stable")["channel"]
    named, rest = [str(n) for n in sensors[:_MOST_NAMED]], [str(n) for n in sensors[_MOST_NAMED:]]
    hours = batch.time_s[rows] / 3600
    for k, name in enumerate(named):
        ax.plot(hours, batch.masked(name)[rows], color=LINES[k], lw=1.2, label=tex_escaped(name))
    for name, dash in zip(ambient, ("--", ":", "-.") * len(ambient), strict=False):
        ax.plot(hours, batch.masked(name)[rows], color=INK, lw=1.1, ls=dash, label=f"{tex_escaped(name)} (ambient)")
    for k, name in enumerate(rest):  # last in the legend, behind the others in the picture
        label = count(len(rest), "other") if k == 0 else None
        ax.plot(hours, batch.masked(name)[rows], color=GREY, lw=0.8, zorder=1.5, label=label)
    ax.set_ylabel("temperature (°C)", fontsize=8)
    side_legend(ax)


def _periods(axes: Sequence[Axes], test: ThermalTest) -> None:
    """A line where a period starts, a dotted one 60 min later; names above the first panel."""
    for k, period in enumerate(test.periods):
        begin, end = period.start_s / 3600, period.end_s / 3600
        hour = begin + 1 if period.length_s >= HOUR_S else None
        for ax in axes:
            if k or period.start_s > test.start_s:
                ax.axvline(begin, color=MUTED, lw=0.9)
            if hour is not None:
                ax.axvline(hour, color=MUTED, lw=0.8, ls=(0, (1, 3)))
        text: dict[str, Any] = {
            "transform": axes[0].get_xaxis_transform(),
            "fontsize": 8,
            "color": MUTED,
            "va": "bottom",
        }
        axes[0].text((begin + end) / 2, 1.02, period.name, ha="center", **text)
        if hour is not None and end - begin > 2.5:
            axes[0].text(hour, 1.02, "60 min", ha="center", **text)


def side_legend(ax: Axes) -> None:
    """A legend right of the axes."""
    if not ax.get_legend_handles_labels()[0]:
        return  # every channel is masked
    ax.legend(
        loc="upper left", bbox_to_anchor=(1.01, 1.02), fontsize=8, frameon=False, handlelength=1.6, borderaxespad=0
    )


NOT_STATED = "not stated"
FILES = ("report.html", "report.md", "thermal_test.png", "quantities.csv")


class Tilt(BaseModel):
    """Two probes, by channel or label, and their distance along the spindle in mm."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    first: str
    second: str
    distance_mm: float = Field(gt=0)


class TestSheet(BaseModel):
    """What only the person at the machine knows; a field that is left out is "not stated" on the page.

    Reads as YAML by `data.yaml_file.load_yaml(path, TestSheet, "test sheet")`.
    """

    __test__ = False  # pytest would take the name for a test
    model_config = ConfigDict(extra="forbid", frozen=True)

    position: str = ""  # of the axes, and where the probes stand in the workspace
    tool_stick_out: str = ""
    warm_up_history: str = ""
    compensation: str = ""
    probes: str = ""
    uncertainty: str = ""
    axes: dict[str, str] | None = None  # label -> error channel
    tilts: dict[str, Tilt] = {}

    @property
    def pairs(self) -> tuple[ProbePair, ...]:
        """The tilts as the evaluation takes them."""
        return tuple(ProbePair(n, t.first, t.second, t.distance_mm) for n, t in self.tilts.items())


def write_iso_report(
    batch: Batch, folder: Path | str, sheet: TestSheet | None = None, kind: str | None = None,
    start_s: float | None = None, end_s: float | None = None,
) -> Path:  # fmt: skip
    """Judge the batch and write report.html, report.md, thermal_test.png and quantities.csv; returns the HTML's path.

    The HTML page is self-contained. Each file appears whole or not at all. `kind`, `start_s` and
    `end_s` as in `features.iso230_3.thermal_test`.

    Raises:
        InputError: as `thermal_test`, or the folder cannot be written.
    """
    folder = Path(folder)
    sheet = sheet or TestSheet()
    test = thermal_test(batch, sheet.pairs, sheet.axes, kind, start_s, end_s)
    drawn = picture_bytes(iso_figure(batch, test), "png", _DPI)
    page = iso_page(batch, test, sheet, drawn)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / FILES[2], drawn)
        write_atomic(folder / FILES[3], test.quantities.to_csv(index=False, lineterminator="\n"))
        for name in FILES[:2]:
            write_atomic(folder / name, rendered(page, Path(name).suffix))
    except OSError as error:
        raise InputError(f"report {folder}: cannot be written ({error.strerror}); give another folder") from None
    return folder / FILES[0]


def iso_page(batch: Batch, test: ThermalTest, sheet: TestSheet, drawn: bytes) -> Page:
    """The page with its figure `drawn` as PNG: what is not known appears as not stated."""
    pairs = "; ".join(f"{p.name} = ({p.first} − {p.second}) / {p.distance_mm:g} mm" for p in test.pairs)
    probes = "; ".join(p for p in (sheet.probes, pairs) if p)
    length = f"{clock(test.end_s - test.start_s)} h, a reading every {batch.step_s:g} s"
    period = length if test.start_s == 0 else f"from {clock(test.start_s)} h, {length}"
    facts = [
        ("Machine", test.machine),
        ("Recording", f"{test.batch_id} (simulated)" if test.simulated else test.batch_id),
        ("Start", _start(batch)),
        ("Stated period", period),
        ("Position", sheet.position),
        ("Tool stick-out", sheet.tool_stick_out),
        ("Warm-up history", sheet.warm_up_history),
        ("Compensation", sheet.compensation),
        ("Probes", probes),
        ("Uncertainty", sheet.uncertainty),
    ]
    figure = Picture(_figure_label(test), data_address(drawn, "png"), test.simulated, "full", True, FILES[2])
    blocks = given(
        _quantities(test),
        *(Text(n, "note") for n in test.notes),
        figure,
        _temperatures(test) if len(test.temperatures) else None,
    )
    return Page(
        "thermodrift thermal test, in the style of ISO 230-3",
        test.title.removesuffix(" (SIMULATED)"),
        (Text(test.explanation), Pairs(tuple((k, v or NOT_STATED) for k, v in facts))),
        (
            Section("test", "", blocks, "Test"),
            Section("terms", "What the numbers mean", (Pairs(_TERMS, "glossary"),)),
        ),
        ("In the style of ISO 230-3. The numbers are also in quantities.csv.",),
        test.simulated,
    )


_TERMS = (
    ("range", "Greatest minus least reading of the period, the last reading before its start included, where there is "
     "one."),
    ("range in 60 min", "The same over the first 60 min of the period."),
    ("d(60 min)", "Change, with sign, from the last reading before the period's start to 60 min after the start."),
    ("d(t)", "The same to the last reading of the period, whose length is t."),
    ("at, span", "Where an axis cycles: the mean reading of every stay at a target, and the difference of the two "
     "targets. d(t) is their shift and the change of span."),
    ("A, B", "Tilt (Y1 − Y2) / l and (X1 − X2) / l from two probes at the distance l. 1 µm/m = 1 µrad = 0.206″."),
    ("readings", "As recorded, not smoothed; what the checks of the recording mask is left out."),
    ("style", "The quantities and plots are in the style of ISO 230-3. The text of the standard was not at hand, so "
     "this page is no statement that the test followed it."),
)  # fmt: skip


def _start(batch: Batch) -> str:
    """Date and time; midnight sharp is a date whose time nobody noted."""
    if batch.start is None:
        return ""
    return f"{batch.start:%Y-%m-%d}" if batch.start == batch.start.normalize() else f"{batch.start:%Y-%m-%d %H:%M}"


def _figure_label(test: ThermalTest) -> str:
    shown = {"tilt": test.pairs, "temperatures": len(test.temperatures), "speed": test.speed, "feed": test.feed}
    names = ["displacement", *(n for n, there in shown.items() if there)] + (["position"] if test.position else [])
    text = listed(names)
    return f"{text[0].upper()}{text[1:]} over one time axis"


def _quantities(test: ThermalTest) -> Table:
    columns = (
        Column("Period"), Column("Channel"), Column("Unit"), Column("range", kind="number"),
        Column("range in 60 min", kind="number"), Column("d(60 min)", kind="number"), Column("d(t)", kind="number"),
        Column("t", "h:min", "number"),
    )  # fmt: skip
    rows = []
    for period in test.periods:
        for trace in test.traces:
            values: Mapping[str, float] = {
                q: test.value(trace.name, q, period.name) for q in ("range", "range in 60 min", "d(60 min)", "d(t)")
            }
            cells = [number(v, trace.digits, sign=q.startswith("d(")) for q, v in values.items()]
            unit = unit_label(trace.unit)
            rows.append(Row.of(period.name, trace.name, unit, *cells, clock(period.length_s)))
    return Table("Ranges and changes", columns, tuple(rows), test.simulated)


def _temperatures(test: ThermalTest) -> Table:
    columns = (
        Column("Channel"), Column("Role"), Column("at the start", "°C", "number"), Column("at the end", "°C", "number"),
        Column("least", "°C", "number"), Column("greatest", "°C", "number"), Column("change", "K", "number"),
    )  # fmt: skip
    rows = []
    for record in test.temperatures.to_dict("records"):
        begin, end, least, greatest = (float(record[f"{k}_degC"]) for k in ("start", "end", "least", "greatest"))
        numbers = [number(v) for v in (begin, end, least, greatest)]
        rows.append(Row.of(str(record["channel"]), str(record["role"]), *numbers, number(end - begin, sign=True)))
    return Table("Temperatures over the stated period", columns, tuple(rows), test.simulated)
