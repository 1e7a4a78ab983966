"""The tables of a twin: bodies, parameters, modes, heat."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import pandas as pd

from data.units import unit_label
from reports.labels import NOTHING, count, number, percent, three_digits
from reports.layout import Column, Row, Table
from twin.quantity import Parameter
from twin.views.heat_flows import HeatFlows
from twin.views.overview import BodyView, ModeView, Overview, time_words

if TYPE_CHECKING:
    from twin.calibration.identifiability import Interval

_KINDS = {"heat": "put in", "storage": "stored in", "loss": "taken by", "link": "through"}
_KNOWN = 0.5  # posterior sd by prior sd, below which the recordings say more than the prior


def counted(view: Overview) -> str:
    """What the network consists of, in a line."""
    n, links = len(view.bodies), sum(not t.ground for t in view.ties)
    parts = [f"{n} {'body' if n == 1 else 'bodies'}", count(links, "link"), count(len(view.ties) - links, "exposure")]
    parts.append(count(len(view.sensors), "sensor"))
    return f"{', '.join(parts)}; {view.free} free and {view.fixed} fixed parameters"


def capacity_label(b: BodyView) -> str:
    """``6.6 kJ/K``, with the number of cells where a body has several."""
    joules = b.capacity_J_per_K
    label = f"{number(joules / 1e3, 1 if joules < 1e5 else 0)} kJ/K" if joules >= 1e3 else f"{joules:.3g} J/K"
    return label + (f", {b.n_cells} cells" if b.n_cells > 1 else "")


def bodies(view: Overview) -> Table:
    """Bodies, capacities, time constants, counts of parameters."""
    rows = [
        Row.of(b.name, b.label or NOTHING, capacity_label(b), time_words(b.time_constant_s), f"{b.free}", f"{b.fixed}")
        for b in view.bodies
    ]
    columns = (
        Column("body"), Column("what it is", kind="wide"), Column("heat capacity", kind="number"),
        Column("time constant", kind="number"), Column("free", "parameters", "number"),
        Column("fixed", "parameters", "number"),
    )  # fmt: skip
    notes = (
        "Time constant: the body's capacity by all conductances that touch it, its neighbours held.",
        f"A link's parameters count for both ends; the whole twin has {view.free} free and {view.fixed} fixed ones.",
    )
    return Table("Bodies", columns, tuple(rows), view.simulated, notes=notes)


def parameters(given: Sequence[Parameter], intervals: Mapping[str, Interval], free: bool, simulated: bool) -> Table:
    """Every free (or fixed) parameter: value, prior and, when calibrated, its 90 % interval and what it rests on."""
    rows, sourced = [], any(p.source for p in given if p.free == free)
    for p in given:
        if p.free != free:
            continue
        cells = [p.name, p.words, quantity(p.value, p.unit)]
        found = intervals.get(p.name)
        if free:
            cells.append(prior_label(p))
        if intervals and free:
            cells.append(interval_label(found, p.unit))
            cells.append(NOTHING if found is None else "recordings" if found.prior_shrinkage < _KNOWN else "prior")
        cells += [p.source or NOTHING] if sourced else []
        rows.append(Row(tuple(cells)))
    columns = [Column("parameter"), Column("what it is", kind="wide"), Column("value", kind="number")]
    columns += [Column("prior", kind="number")] if free else []
    columns += [Column("90 % interval", kind="number"), Column("rests on")] if intervals and free else []
    columns += [Column("source", kind="wide")] if sourced else []
    notes = []
    if free:
        notes.append("Prior: centre ×/÷ one standard deviation of the logarithm, or centre ± one standard deviation.")
    if intervals and free:
        notes.append("Rests on: the recordings where they halve the prior's standard deviation, else the prior.")
    caption = "Free parameters" if free else "Fixed parameters"
    return Table(caption, tuple(columns), tuple(rows), simulated, notes=tuple(notes))


def prior_label(p: Parameter) -> str:
    """``14 W/K ×/÷ 1.65``, ``0 ± 0.2 K`` or, of a share, its range of one standard deviation."""
    if not math.isfinite(p.spread):
        return NOTHING
    if p.scale == "log":
        return f"{quantity(p.prior_value, p.unit)} ×/÷ {math.exp(p.spread):.2f}"
    if p.scale == "linear":
        return f"{p.prior_value:.4g} ± {quantity(p.spread, 'K' if p.unit == 'degC' else p.unit)}"
    x = float(p.to_x(p.prior_value))
    return f"{float(p.from_x(x - p.spread)):.2f} to {float(p.from_x(x + p.spread)):.2f}"


def interval_label(found: Interval | None, unit: str) -> str:
    if found is None:
        return NOTHING
    scale, shown = _scale(max(abs(found.low), abs(found.high)), unit)
    return f"{three_digits(found.low / scale)} to {three_digits(found.high / scale)} {shown}".strip()


def quantity(value: float, unit: str) -> str:
    """``165 kJ/K``: four digits and the unit as people write it."""
    scale, shown = _scale(abs(value), unit)
    return f"{value / scale:.4g} {shown}".strip().replace("-", "−")


def _scale(size: float, unit: str) -> tuple[float, str]:
    if unit in ("J/K", "W", "N") and size >= 1e3:
        return 1e3, f"k{unit}"
    return 1.0, unit_label(unit)


def modes(views: Sequence[ModeView], view: Overview, most: int = 10) -> Table:
    """Time constants, what moves against what, and how much of each displacement comes with that time constant."""
    channels = list(views[0].error) if views else []
    units = {c.channel: unit_label(c.unit) for c in view.chains}
    rows = [
        Row.of(time_words(v.time_constant_s), v.label, *(x for c in channels for x in _brought(v, c)))
        for v in views[:most]
    ]
    columns = [Column("time constant"), Column("what moves", kind="wide")]
    for c in channels:
        columns += [Column(c, units[c], "number"), Column(c, "share", "number")]
    notes = (
        "What the mode brings to the displacement of the steady state, arriving as 1 − exp(−t / time constant). "
        "Share: its magnitude by the sum of all magnitudes; modes of opposite sign cancel.",
    )
    return Table("Time constants", tuple(columns), tuple(rows), view.simulated, notes=notes if channels else ())


def _brought(v: ModeView, channel: str) -> tuple[str, str]:
    return number(v.error[channel], 1, sign=True), percent(v.share[channel])


def heat(flows: HeatFlows) -> Table:
    """Where a batch's energy went, and whether it adds up."""
    totals: pd.DataFrame = flows.totals()
    totals = totals[totals["kind"] != "link"]
    rows = []
    for r in totals.to_dict("records"):
        share = percent(r["share"]).replace("-", "−")
        rows.append(
            Row.of(_KINDS[str(r["kind"])], str(r["name"]), number(r["energy_kJ"], 0), number(r["mean_W"], 1), share)
        )
    columns = (
        Column(""), Column("where"), Column("energy", "kJ", "number"), Column("mean", "W", "number"),
        Column("of the heat put in", kind="number"),
    )  # fmt: skip
    gap_J = float(abs(flows.gap_W @ flows.dt_s))
    note = f"Put in less stored less taken: {gap_J:.1g} J. Negative: a body that cooled, a surrounding that gave heat."
    return Table(f"{flows.batch_id}: where the energy went", columns, tuple(rows), flows.simulated, notes=(note,))


def left_out(table: pd.DataFrame, simulated: bool) -> Table:
    """The error on batches that a calibration never saw, by channel."""
    rows = []
    for r in table.to_dict("records"):
        unit = unit_label(str(r["unit"]))
        numbers = [number(float(r[k]), 2) for k in ("left_out", "left_out_sd", "before", "zero")]
        rows.append(Row.of(str(r["channel"]), unit, f"{r['batches']}", *numbers))
    columns = (
        Column("channel"), Column("unit"), Column("batches", kind="number"), Column("left out", "rms", "number"),
        Column("its spread", "sd", "number"), Column("as before", "rms", "number"),
        Column("if nothing moved", "rms", "number"),
    )  # fmt: skip
    return Table("Batches left out of the calibration, predicted", columns, tuple(rows), simulated)


def rms(table: pd.DataFrame, simulated: bool) -> Table:
    """The rms of the residual of every batch and channel.

    Args:
        table: batch, channel, unit, rms, as `twin.views.compared.rms_table` gives it.
    """
    units = table.drop_duplicates("channel").set_index("channel")["unit"]
    wide = table.pivot(index="batch", columns="channel", values="rms")[list(units.index)]
    wide = wide.loc[list(dict.fromkeys(table["batch"]))]
    rows = tuple(
        Row.of(str(batch), *(number(v, 2 if v < 9.95 else 1) for v in values))
        for batch, values in zip(wide.index, wide.to_numpy(float), strict=True)
    )
    columns = (Column("batch"), *(Column(str(c), unit_label(str(u)), "number") for c, u in units.items()))
    return Table("Residual rms of every batch and channel", columns, rows, simulated)
