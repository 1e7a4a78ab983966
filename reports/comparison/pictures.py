"""The three pictures of a training's page and its viewer: a plot for each error channel, largest error first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from models.selection.loss import BASELINES
from reports.comparison import figures
from reports.comparison.channel import Channel
from reports.comparison.tables import LeftOut, left_out_batches, scored
from reports.drawing import GREY, MUTED
from reports.labels import BLUE, INK, ORANGE, count, family_label, number
from reports.layout import Key, Panel, Plot, with_unit
from reports.viewer import Pane, Trace, Viewer, viewer

_TRAINED_ON = {"forward": "the runs before its block", "leave-batch-out": "all others"}
_NICE_H = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 24.0)
_MOST_KEYS = 6


def left_out_panels(channels: Sequence[Channel]) -> list[Panel]:
    """Recording and prediction of the median and the worst left-out run; along an axis a fan of sweeps."""
    kept = [(c, shown) for c in channels if (shown := [b for b in left_out_batches(c.result, c.choice) if b.place])]
    out = []
    for along_axis in (False, True):
        own = [(c, shown) for c, shown in kept if (shown[0].position_mm is not None) == along_axis]
        out += [_left_out(own, along_axis)] if own else []
    return out


def _left_out(kept: Sequence[tuple[Channel, list[LeftOut]]], along_axis: bool) -> Panel:
    draw, every = figures.fan if along_axis else figures.curves, [b for _, shown in kept for b in shown]
    plots = []
    for place in ("median", "worst"):
        for c, shown in kept:
            for b in (b for b in shown if b.place == place):
                figure = draw([b], shown, c.result.target, c.digits, c.result.simulated)
                title = f"{c.name}, {figures.place(b, c.digits, most=200)}"
                plots.append(with_unit(Plot(figure, title, "third"), c.unit))
    protocol = every[0].protocol
    which = "later runs" if protocol == "forward" else "batches"
    notes = f"Median and worst of the {which} by S, each by a model of {_TRAINED_ON[protocol]}. The residual axes of a "
    notes += "channel are equal."
    keys = [Key("recorded", INK), Key("predicted", BLUE), Key("residual", ORANGE)]
    if along_axis:
        keys, more = _fan_legend(every)
        notes += more
    if (thinned := max(b.every for b in every)) > 1:
        notes += f" Of long runs one sample in {thinned} is drawn."
    caption = f"Runs left out: recorded and predicted{' along the axis' if along_axis else ''}, {protocol}"
    return Panel(caption, tuple(plots), keys=tuple(keys), notes=(notes,))


def _fan_legend(shown: Sequence[LeftOut]) -> tuple[list[Key], str]:
    """The colours of the time, and what a fan's zero is."""
    last_h = figures.longest_h(shown)
    step_h = next((h for h in _NICE_H if last_h / h <= _MOST_KEYS), _NICE_H[-1])
    keys = [Key("recorded", INK, "circle", alone=True), Key("predicted", INK)]
    keys += [
        Key(f"{h:g} h", figures.time_colour(h / last_h), "circle", alone=True)
        for h in np.arange(0.0, last_h + 1e-9, step_h)
    ]
    note = " The error less that of the batch's first sweep, which is the line at zero. Colours: time since start."
    most, drawn = (max(len(of(b)) for b in shown) for of in (figures.sweeps, figures.drawn_sweeps))
    return keys, note + (f" Drawn: {drawn} of up to {most} sweeps." if most > drawn else "")


def tried_panel(channels: Sequence[Channel]) -> Panel:
    """S_mean of every selector × family, a mark for each number of points that was tried."""
    plots, counts = [], []
    for c in channels:
        cells, runs = _tried(c)
        nothing = cells.loc[cells["family"] == "zero", "S_mean_um"]
        curve = cells.loc[cells["family"] == "mean_curve", "S_mean_um"]
        levels = {family_label(k): float(v.iloc[0]) for k, v in (("zero", nothing), ("mean_curve", curve)) if len(v)}
        cells = cells[~cells["family"].isin(BASELINES)]
        if len(cells):
            figure = figures.tried(cells, c.choice.cell, c.name, levels, c.result.simulated)
            plots.append(with_unit(Plot(figure, f"{c.name}: S_mean by selector and family", "third"), c.unit))
            counts.append(f"{c.name} {count(len(cells), 'cell')} on {count(runs, 'run')}")
    keys = (
        Key("chosen", ORANGE, "diamond", alone=True), Key("all sensors", INK, "square", alone=True),
        Key("points by a selector", BLUE, "circle", alone=True), Key("no model", MUTED, "dot"),
        Key("mean curve", MUTED, "dash"),
    )  # fmt: skip
    note = (
        f"The best families; a mark is a cell, all judged on the same left-out runs: {'; '.join(counts)}. Right: "
        "selector and number of points of the least. The choice counts all left-out runs and the cost of choosing."
    )
    return Panel("Error by selector and family", tuple(plots), keys=keys, notes=(note,))


def _tried(c: Channel) -> tuple[pd.DataFrame, int]:
    """Cells that were judged on the same runs, and on how many: of the race's first rounds, else of the protocol."""
    race = c.result.race
    if len(race):
        same = race[race["n_runs"] == race["n_runs"].min()]
        return same.drop_duplicates(["selector", "family", "n_tsp"], keep="last"), int(same["n_runs"].iloc[0])
    cells = scored(c.result, c.protocol)
    return cells, int(cells["n_batches"].max())


def time_panel(channels: Sequence[Channel]) -> Panel:
    """S of every left-out run in the order of time."""
    plots = []
    for c in channels:
        if len(c.runs):
            figure = figures.in_order(c.runs, c.expected.bound_um, f"{c.name}: S of a run, µm", c.result.simulated)
            plots.append(with_unit(Plot(figure, f"{c.name}: S of left-out runs in the order of time", "third"), c.unit))
    forward = all(c.expected.protocol == "forward" for c in channels)
    keys = (
        Key("chosen model", BLUE, "circle", alone=True), Key("no model", GREY, "square", alone=True),
        Key("90 % bound of a run", INK, "dash"),
    )  # fmt: skip
    caption = "Forward in time: later runs, predicted from earlier ones"
    return Panel(caption if forward else "Left-out runs in the order of time", tuple(plots), keys=keys)


def runs_viewer(channels: Sequence[Channel]) -> Viewer | None:
    """Every left-out run, recorded and predicted; None where all are along an axis: such a run is no line over time."""
    panes = []
    for c in channels:
        for b in (b for b in left_out_batches(c.result, c.choice) if b.position_mm is None):
            traces = (Trace("recorded", b.recorded_um, "recorded"), Trace("predicted", b.predicted_um, "computed"))
            said = with_unit(f"S = {number(b.S_um, c.digits)} µm", c.unit)
            panes.append(Pane(b.batch_id, c.name, c.unit, b.time_h, traces, said))
    return viewer("Every left-out run", panes, simulated=False)
