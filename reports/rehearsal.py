"""The page of a rehearsal: error with and without compensation, what was sent, and what failed, along one time axis."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from compensation.rehearsal import GAP_S, Rehearsal
from reports.drawing import LINES, MUTED, THIRD_IN, headed, panel
from reports.labels import GREEN, ORANGE, count, listed
from reports.layout import Column, Key, Page, Panel, Plot, Row, Section, Table, Text, given
from reports.rendering import write_page
from reports.viewer import Pane, Trace, viewer

_MOST_POINTS = 1500  # of a line: more than there are pixels
_HALF_IN = 5.15  # of the page's width
_STATES = {"off": "#d9dee3", "warm-up": "#cfe3f2", "active": GREEN, "hold": "#e9b44c", "fade-out": ORANGE}


def write_rehearsal(path: Path, r: Rehearsal, model: str, used: str) -> None:
    """Write the page; `model` names what ran, `used` is the account of the recordings in one line.

    Raises:
        InputError: another suffix than .html, or no place to write.
    """
    write_page(path, rehearsal_page(r, model, used), (".html",))


def rehearsal_page(r: Rehearsal, model: str, used: str) -> Page:
    """The page, the axis with the largest error first."""
    axes = sorted(r.before_um, key=lambda a: -r.band_um(a)[0])
    bands = ((a, *r.band_um(a)) for a in axes)
    said = listed([f"{after:.1f} µm in {a} ({before:.1f} µm without)" for a, before, after in bands])
    failed = f", {count(len(r.failures), 'failing sensor')}" if r.failures else ""
    note = f"{len(r.time_s)} samples of {count(len(r.starts_s), 'recording')}{failed}; {used}. Answered by {model}."
    top = (Text(f"With compensation 95 % of the rows lie in a band of {said}.", "lead"), Text(note, "note"))
    every = viewer("Error and correction, run by run", [p for a in axes for p in _panes(r, a)], simulated=False)
    blocks = given(_table(r, axes), _pictures(r, axes), every, _events(r).folded())
    footer = (
        "The correction never acts on the temperatures, so the recorded error plus the correction is what a "
        "compensated machine would have shown.",
    )
    title = f"{r.machine}: rehearsal of the compensation"
    sections = (Section("rehearsal", "", blocks),)
    return Page("thermodrift compensation", title, top, sections, footer, r.simulated)


def _panes(r: Rehearsal, axis: str) -> list[Pane]:
    """A pane per recording, its time from its start."""
    starts = sorted(r.starts_s.items(), key=lambda item: item[1])
    edges = np.searchsorted(r.time_s, [*(s - 1e-6 for _, s in starts), np.inf])
    panes = []
    for (name, start_s), (a, b) in zip(starts, pairwise(edges), strict=True):
        traces = (
            Trace("without compensation", r.before_um[axis][a:b], "before"),
            Trace("with compensation", r.after_um[axis][a:b], "computed"),
            Trace("sent", r.sent_um[axis][a:b], "sent", lower=True),
        )
        panes.append(Pane(name, axis, "um", (r.time_s[a:b] - start_s) / 3600, traces, residual=False))
    return panes


def _table(r: Rehearsal, axes: Sequence[str]) -> Table:
    columns = (
        Column("axis"), Column("band before", "µm", "number"), Column("band after", "µm", "number"),
        Column("rms before", "µm", "number"), Column("rms after", "µm", "number"), Column("active", "%", "number"),
        Column("fastest change sent", "µm/s", "number"),
    )  # fmt: skip
    rows = []
    for a in axes:
        apart_s = np.diff(r.time_s)
        within = apart_s < GAP_S  # a night between two recordings is no change
        rates = np.abs(np.diff(r.sent_um[a]))[within] / apart_s[within]
        band, rms, fastest = r.band_um(a), r.rms_um(a), rates.max(initial=0.0)
        active = 100 * np.mean([s == "active" for s in r.state[a]])
        cells = (*(f"{v:.2f}" for v in (*band, *rms)), f"{active:.0f}", f"{fastest:.2f}")
        rows.append(Row.of(a, *cells))
    note = "The band holds 95 % of the rows; rms is about 0, the error at each recording's start."
    return Table("Error without and with compensation", columns, tuple(rows), notes=(note,), look="stacked")


def _events(r: Rehearsal) -> Table:
    """Changes of state with their reason, an axis after the other; readings are counted."""
    rows = []
    for a in r.state:
        was = ""
        for t, state, reason in zip(r.time_s, r.state[a], r.reason[a], strict=True):
            if state != was:
                rows.append(Row.of(f"{t / 3600:.2f}", a, state, reason))
                was = state
    columns = (Column("time", "h", "number"), Column("axis"), Column("state"), Column("reason", kind="wide"))
    notes = (f"{len(r.readings_s)} readings of a probe.",) if r.readings_s else ()
    return Table("Changes of state", columns, tuple(rows), notes=notes)


def _pictures(r: Rehearsal, axes: Sequence[str]) -> Panel:
    """Error and correction of every axis, with the states of the compensation between."""
    wide_in = THIRD_IN if len(axes) > 2 else _HALF_IN
    plots = [Plot(_figure(r, a, wide_in), f"Error and correction of {a} in the rehearsal", "third") for a in axes]
    keys = [Key("without compensation", MUTED), Key("with compensation", LINES[0]), Key("sent", LINES[2])]
    keys += [Key("reading", LINES[1], "triangle-up", alone=True)] if r.readings_s else []
    keys += [Key("sensor fails", _FAILING, "square", alone=True)] if r.failures else []
    seen = {state for a in axes for state in r.state[a]}
    keys += [Key(state, color, "square", alone=True) for state, color in _STATES.items() if state in seen]
    return Panel("Error and correction; nights are cut to one hour", tuple(plots), keys=tuple(keys))


_FAILING = "#fadfd0"


def _figure(r: Rehearsal, axis: str, wide_in: float) -> Figure:
    fig = Figure(figsize=(wide_in, 3.0))
    headed(fig, axis, r.simulated)
    upper = panel(fig, 0.52, 0.32, wide_in - 0.6, 1.2)
    lower = panel(fig, 0.52, 1.85, wide_in - 0.6, 0.75)
    _lines(upper, r, [(r.before_um[axis], MUTED, 0.9), (r.after_um[axis], LINES[0], 1.2)])
    _lines(lower, r, [(r.sent_um[axis], LINES[2], 1.2)])
    upper.tick_params(labelbottom=False)
    upper.set_ylabel("error, µm", fontsize=8, color=MUTED)
    lower.set_ylabel("sent, µm", fontsize=8, color=MUTED)
    lower.set_xlabel("time, h", fontsize=8, color=MUTED, labelpad=2)
    fig.align_ylabels()
    low = upper.get_ylim()[0]
    upper.plot(np.array(r.readings_s) / 3600, np.full(len(r.readings_s), low), "^", color=LINES[1], ms=3, clip_on=False)
    for f in r.failures:
        for ax in (upper, lower):
            ax.axvspan(f.start_s / 3600, f.end_s / 3600, color=_FAILING, lw=0, zorder=0)
        upper.text(f.start_s / 3600, -0.05, f"{f.channel} {f.how}", transform=upper.get_xaxis_transform(),
                   fontsize=6.5, color=ORANGE, va="top")  # fmt: skip
    _states(lower, r, axis)
    return fig


def _lines(ax: Axes, r: Rehearsal, lines: list[tuple[NDArray[np.float64], str, float]]) -> None:
    """Lines that break between the recordings."""
    every = max(1, len(r.time_s) // _MOST_POINTS)
    time_h = r.time_s / 3600
    breaks = np.flatnonzero(np.diff(time_h) > 0.5) + 1
    for values, color, width in lines:
        for rows in np.split(np.arange(len(time_h)), breaks):
            ax.plot(time_h[rows][::every], values[rows][::every], color=color, lw=width)
    ax.set_xlim(0, float(time_h[-1]))
    ax.locator_params(axis="y", nbins=5)
    ax.axhline(0.0, color=MUTED, lw=0.6)


def _states(ax: Axes, r: Rehearsal, axis: str) -> None:
    """A strip above the axes in the colours of the states."""
    time_h, states = r.time_s / 3600, np.array(r.state[axis])
    changes = [0, *(np.flatnonzero((states[1:] != states[:-1]) | (np.diff(time_h) > 0.5)) + 1), len(states)]
    for a, b in pairwise(changes):
        ax.axvspan(time_h[a], time_h[b - 1], 1.08, 1.17, color=_STATES[str(states[a])], lw=0, clip_on=False)
