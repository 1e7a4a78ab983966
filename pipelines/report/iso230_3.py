"""The report of one thermal test "in the style of ISO 230-3": header, picture over one time axis, table."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from data.atomic_file import write_atomic
from data.batch import Batch
from data.errors import InputError
from pipelines.report.iso_figure import iso_figure, png
from pipelines.report.layout import Column, Row, Table
from pipelines.report.words import listed, number
from pipelines.report.write import template_environment
from twin.iso230_3 import ProbePair, ThermalTest, thermal_test
from twin.iso230_3.kind import clock

NOT_STATED = "not stated"
STYLE = "in the style of ISO 230-3"
FILES = ("report.html", "report.md", "thermal_test.png", "quantities.csv")
_UNITS = {"um": "µm", "um/m": "µm/m", "degC": "°C"}


class Tilt(BaseModel):
    """Two probes, by channel or label, and their distance along the spindle in mm."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    first: str
    second: str
    distance_mm: float = Field(gt=0)


class TestSheet(BaseModel):
    """What only the person at the machine knows; every field may be left out and is then "not stated".

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


@dataclass(frozen=True)
class IsoPage:
    """Everything that the templates show."""

    title: str
    simulated: bool
    words: str
    facts: tuple[tuple[str, str], ...]
    quantities: Table
    temperatures: Table | None
    notes: tuple[str, ...]
    figure_words: str


def write_iso_report(
    batch: Batch,
    folder: Path | str,
    sheet: TestSheet | None = None,
    kind: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> Path:
    """Judge the batch and write report.html, report.md, thermal_test.png and quantities.csv; returns the HTML's path.

    The HTML page holds its picture and asks no network. Each file appears whole or not at all. `kind`, `start_s` and
    `end_s` as in `twin.iso230_3.thermal_test`.

    Raises:
        InputError: as `thermal_test`, or the folder cannot be written.
    """
    folder = Path(folder)
    sheet = sheet or TestSheet()
    test = thermal_test(batch, sheet.pairs, sheet.axes, kind, start_s, end_s)
    picture = png(iso_figure(batch, test))
    shown = iso_page(batch, test, sheet)
    written = f"{pd.Timestamp.now('UTC'):%Y-%m-%d %H:%M} UTC"
    embedded = base64.b64encode(picture).decode("ascii")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / FILES[2], picture)
        write_atomic(folder / FILES[3], test.quantities.to_csv(index=False, lineterminator="\n"))
        for name in FILES[:2]:
            template = template_environment(name.endswith(".html")).get_template(f"iso230_3{Path(name).suffix}.j2")
            write_atomic(folder / name, template.render(page=shown, written=written, picture=embedded, file=FILES[2]))
    except OSError as error:
        raise InputError(f"report {folder}: cannot be written ({error.strerror}); give another folder") from None
    return folder / FILES[0]


def iso_page(batch: Batch, test: ThermalTest, sheet: TestSheet) -> IsoPage:
    """Collect the page: what is not known is said to be not stated."""
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
    return IsoPage(
        title=test.title.removesuffix(" (SIMULATED)"),
        simulated=test.simulated,
        words=test.words,
        facts=tuple((k, v or NOT_STATED) for k, v in facts),
        quantities=_quantities(test),
        temperatures=_temperatures(test) if len(test.temperatures) else None,
        notes=test.notes,
        figure_words=_figure_words(test),
    )


def _start(batch: Batch) -> str:
    """Date and time; midnight sharp is a date whose time nobody noted."""
    if batch.start is None:
        return ""
    return f"{batch.start:%Y-%m-%d}" if batch.start == batch.start.normalize() else f"{batch.start:%Y-%m-%d %H:%M}"


def _figure_words(test: ThermalTest) -> str:
    shown = {"tilt": test.pairs, "temperatures": len(test.temperatures), "speed": test.speed, "feed": test.feed}
    names = ["displacement", *(n for n, there in shown.items() if there)] + (["position"] if test.position else [])
    words = listed(names)
    return f"{words[0].upper()}{words[1:]} over one time axis"


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
            unit = _UNITS.get(trace.unit, trace.unit)
            rows.append(Row((period.name, trace.name, unit, *cells, clock(period.length_s))))
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
        rows.append(Row((str(record["channel"]), str(record["role"]), *numbers, number(end - begin, sign=True))))
    return Table("Temperatures over the stated period", columns, tuple(rows), test.simulated)
