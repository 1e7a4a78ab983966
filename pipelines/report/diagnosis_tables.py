"""The tables of a diagnosis: candidates, steps, refinements, limits, parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from pipelines.report.diagnosis_words import UNITS, probability_words
from pipelines.report.layout import Column, Row, Table
from pipelines.report.twin_tables import quantity
from pipelines.report.words import NOTHING, between, number, percent
from twin.diagnosis.telling.findings import Finding, FoundParameter

_MOST_CANDIDATES, _MOST_CHANNELS = 12, 10


def candidates(table: pd.DataFrame, simulated: bool, accepted: frozenset[tuple[str, str]] = frozenset()) -> Table:
    """The best of everything that was tried; those accepted are marked.

    Args:
        table: the diagnosis' table of candidates.
        accepted: mechanism and place of what became a finding.
    """
    shown = table.sort_values("rank", kind="stable")[:_MOST_CANDIDATES]
    rows = [
        Row(
            (
                str(r["words"]),
                number(float(r["gain"]), 0 if abs(float(r["gain"])) >= 9.95 else 1, sign=True),
                f"{int(r['improved'])} of {int(r['batches'])}",
                _amplitude(float(r["amplitude"]), str(r["unit"])),
                percent(float(r["absorbed"])),
                _chance(float(r["probability"])),
                f"{int(r['cluster'])}",
            ),
            "found" if (str(r["mechanism"]), place(r)) in accepted else "",
        )
        for r in shown.to_dict("records")
    ]
    columns = (
        Column("what may be missing", kind="wide"), Column("gain", "nats, left out", "number"),
        Column("runs better", "left out", "number"), Column("size", kind="number"),
        Column("absorbed", "by recalibrating", "number"), Column("probability", kind="number"),
        Column("cluster", kind="number"),
    )  # fmt: skip
    notes = ["Candidates of one cluster look the same in these recordings."]
    if len(table) > len(shown):
        notes.append(f"Shown: the best {len(shown)} of {len(table)} that were refitted.")
    return Table("Candidates, best first", columns, tuple(rows), simulated, notes=tuple(notes))


def place(row: Mapping[Any, Any]) -> str:
    """The place by its name, or what follows the mechanism's key in a candidate's unique name."""
    return str(row["name"]).removeprefix(f"{row['mechanism']}_")


def _amplitude(value: float, unit: str) -> str:
    return quantity(float(f"{value:.3g}"), unit) if math.isfinite(value) else NOTHING


def _chance(p: float) -> str:
    return probability_words(p) if math.isfinite(p) else NOTHING


def runs(rms: pd.DataFrame, channels: Sequence[str], changed: bool, simulated: bool) -> Table:
    """Left-out rms of every run (rows) and channel (columns, at most 10), before → after."""
    shown = list(channels[:_MOST_CHANNELS])
    unit = rms.drop_duplicates("channel").set_index("channel")["unit"]
    at = {(r["batch"], r["channel"]): (float(r["before"]), float(r["after"])) for r in rms.to_dict("records")}
    rows = []
    for batch in dict.fromkeys(rms["batch"]):
        cells = []
        for c in shown:
            before, after = at.get((batch, c), (math.nan, math.nan))
            digits = 1 if max(before, after) >= 0.95 else 2
            cells.append(f"{number(before, digits)} → {number(after, digits)}" if changed else number(after, digits))
        rows.append(Row((str(batch), *cells)))
    columns = (Column("run"), *(Column(c, UNITS.get(unit[c], unit[c]), "number") for c in shown))
    left = len(channels) - len(shown)
    notes = (f"Without {left} more channels, which change less.",) if left > 0 else ()
    return Table("Left-out rms of every run", columns, tuple(rows), simulated, notes=notes)


def steps(table: pd.DataFrame, simulated: bool) -> Table:
    """The search, step by step."""
    rows = [
        Row(
            (
                f"{r['step']}",
                str(r["words"]),
                number(float(r["gain"]), 0 if abs(float(r["gain"])) >= 9.95 else 1, sign=True),
                number(float(r["threshold"]), 0 if abs(float(r["threshold"])) >= 9.95 else 1),
                f"{int(r['improved'])}",
                "accepted" if r["accepted"] else "rejected",
            )
        )
        for r in table.to_dict("records")
    ]
    columns = (
        Column("step"), Column("tried", kind="wide"), Column("gain", "nats", "number"),
        Column("threshold", "nats", "number"), Column("runs better", kind="number"), Column("verdict"),
    )  # fmt: skip
    return Table("Steps of the search", columns, tuple(rows), simulated)


def refinements(table: pd.DataFrame, simulated: bool) -> Table:
    """What was made finer before any physics was named."""
    rows = [
        Row((str(r["what"]), str(r["why"]), _figure(r["before"]), _figure(r["after"])))
        for r in table.to_dict("records")
    ]
    columns = (
        Column("refined", kind="wide"), Column("why", kind="wide"), Column("left-out error before", kind="number"),
        Column("after", kind="number"),
    )  # fmt: skip
    notes = ("A network that is too coarse looks like missing physics, so it is refined first.",)
    return Table("Refinements of the baseline", columns, tuple(rows), simulated, notes=notes)


def _figure(value: Any) -> str:
    return number(float(value), 2) if isinstance(value, int | float) else str(value)


def limits(table: pd.DataFrame, simulated: bool) -> Table:
    """The least effect that would have been seen, per candidate, and what hides it."""
    rows = [
        Row(
            (
                str(r["words"]),
                _amplitude(float(r["limit"]), str(r["unit"])),
                percent(float(r["absorbed"])),
                str(r["absorbed_by"] or NOTHING),
            )
        )
        for r in table.to_dict("records")
    ]
    columns = (
        Column("effect", kind="wide"), Column("least that would be seen", kind="number"),
        Column("absorbed", "by recalibrating", "number"), Column("mostly by"),
    )  # fmt: skip
    return Table("Detection limits", columns, tuple(rows), simulated)


def parameters(given: Mapping[str, FoundParameter], simulated: bool, caption: str) -> Table:
    """Fitted values with their 90 % intervals."""
    rows = []
    for name, p in given.items():
        unit = UNITS.get(p.unit, p.unit)
        low, high = p.interval90 or (None, None)
        interval = NOTHING if low is None or high is None else f"{_three(low)} to {_three(high)} {unit}".strip()
        value = NOTHING if p.value is None else f"{_three(p.value)} {unit}".strip()
        rows.append(Row((name.replace("_", " "), value, interval)))
    columns = (Column("parameter"), Column("value", kind="number"), Column("90 % interval", kind="number"))
    return Table(caption, columns, tuple(rows), simulated)


def _three(value: float) -> str:
    """Three digits, without a power of ten up to a million."""
    text = f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
    return text.replace("-", "−")


def windows(finding: Finding, label: str, simulated: bool) -> Table:
    """In which stretches of which runs a finding shows."""
    rows = [Row((batch, between(start_s, end_s))) for batch, start_s, end_s in finding.when.windows]
    return Table(f"{label}: windows", (Column("run"), Column("from, to", "h:min of the run")), tuple(rows), simulated)
