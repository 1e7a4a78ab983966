"""What a touch probe is worth: S of later runs against the number of readings in each."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from models.selection.result import GridResult
from models.selection.updating import COUNTS
from reports.comparison.figures import HALF_IN, axes_in, say_simulated
from reports.drawing import MUTED
from reports.labels import BLUE, NOTHING, count, percent, plus_minus
from reports.layout import Column, Key, Panel, Plot, Row, Table

_LABELS = {  # of `models.selection.updating.SCHEDULES`
    "one a shift": "one, after the first hour",
    "one reading an hour": "one an hour",
}


def readings_table(name: str, result: GridResult, digits: int) -> Table | None:
    """Without readings, with one a shift and with one an hour; None where it was not measured."""
    found = result.readings
    if found.empty:
        return None
    free = found[found["schedule"] == f"{COUNTS[0]} evenly"]
    rows = [_row("none, free-running", free, digits, stated=False)]
    rows += [_row(_LABELS[s], found[found["schedule"] == s], digits) for s in _LABELS]
    columns = (
        Column("readings of a run"),
        Column("updated by the filter", "S_mean ± S_std, µm", "number"),
        Column("last residual held", "S_mean ± S_std, µm", "number"),
        Column("inside the stated 90 %", "", "number"),
    )
    runs = count(free["batch_id"].nunique(), "later run")
    note = (
        f"{runs}, predicted from earlier ones. A Kalman filter learned from the training runs moves offset, gains and "
        "drift of the prediction at every reading; rows before a reading do not know it. The plain way holds the "
        "residual of the last reading."
    )
    caption = f"{name}: error with readings of a touch probe"
    return Table(caption, columns, tuple(rows), result.simulated, None, (note,))


def readings_panel(name: str, result: GridResult) -> Panel | None:
    """S_mean against the number of readings, spread evenly over a run."""
    found = result.readings
    if found.empty:
        return None
    means = found[found["schedule"].isin([f"{n} evenly" for n in COUNTS])].groupby("n_readings")
    lines = means[["S_um", "held_S_um"]].mean()
    keys = (Key("updated by the filter", BLUE, "circle"), Key("last residual held", MUTED, "square"))
    plot = Plot(_curve(lines, result.simulated), f"{name}: S against readings", "half")
    return Panel(f"{name}: what a reading is worth", (plot,), result.simulated, keys)


def _row(label: str, own: pd.DataFrame, digits: int, stated: bool = True) -> Row:
    scores = [plus_minus(float(own[c].mean()), float(own[c].std()), digits) for c in ("S_um", "held_S_um")]
    coverage = percent(float(own["coverage90"].mean())) if stated else NOTHING
    return Row.of(label, *scores, coverage)


def _curve(lines: pd.DataFrame, simulated: bool) -> Figure:
    """A line per way of using the readings; µm over readings per run."""
    fig = Figure(figsize=(HALF_IN, 2.6))
    ax = axes_in(fig, 0.25, 1.95, "S_mean of later runs, µm", "readings per run, evenly spread")
    say_simulated(ax, simulated)
    ax.plot(lines.index, lines["held_S_um"], color=MUTED, marker="s", lw=1.1, ms=3.5)
    ax.plot(lines.index, lines["S_um"], color=BLUE, marker="o", lw=2.0, ms=4.5)
    ax.set_xticks(lines.index)
    ax.set_ylim(0, None)
    return fig
