"""The page of a rehearsal: error with and without compensation, what was sent, and what failed, along one time axis."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from compensation.rehearsal import GAP_S, Rehearsal
from reports.drawing import LINES, MUTED, WIDTH_IN, Picture, head, legend_row, panel, picture
from reports.labels import GREEN, ORANGE
from reports.layout import Column, Page, Row, Section, Table, Text, given
from reports.rendering import write_page
from reports.viewer import Pane, Trace, viewer

_MOST_POINTS = 1500  # of a line: more than there are pixels
_TALL_IN, _GAP_IN = 2.1, 0.55
_STATES = {"off": "#d9dee3", "warm-up": "#cfe3f2", "active": GREEN, "hold": "#e9b44c", "fade-out": ORANGE}


def write_rehearsal(path: Path, r: Rehearsal, model: str, used: str) -> None:
    """Write the page; `model` names what ran, `used` is the account of the recordings in one line.

    Raises:
        InputError: another suffix than .html, or no place to write.
    """
    write_page(path, rehearsal_page(r, model, used), (".html",))


def rehearsal_page(r: Rehearsal, model: str, used: str) -> Page:
    """The page."""
    axes = list(r.before_um)
    parts = []
    for a in axes:
        before, after = r.band_um(a)
        parts.append(f"{a}: {before:.1f} to {after:.1f} µm")
    failed = f", {len(r.failures)} failing sensor{'s' if len(r.failures) > 1 else ''}" if r.failures else ""
    summary = (
        f"Width of the band that holds 95 % of the rows, without and with compensation: {'; '.join(parts)}. "
        f"{model} answered {len(r.time_s)} samples of {len(r.starts_s)} recordings{failed}. Of the recordings: {used}."
    )
    every = viewer("Error and correction, run by run", [p for a in axes for p in _panes(r, a)], r.simulated)
    blocks = given(*(_picture(r, a) for a in axes), _table(r), every, _events(r).folded())
    footer = (
        "The correction never acts on the temperatures, so the recorded error plus the correction is what a "
        "compensated machine would have shown.",
    )
    title = f"{r.machine}: rehearsal of the compensation"
    sections = (Section("rehearsal", "", blocks),)
    return Page("thermodrift compensation", title, (Text(summary),), sections, footer, r.simulated)


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


def _table(r: Rehearsal) -> Table:
    columns = (
        Column("axis"), Column("band before", "µm", "number"), Column("band after", "µm", "number"),
        Column("rms before", "µm", "number"), Column("rms after", "µm", "number"), Column("active", "%", "number"),
        Column("fastest change sent", "µm/s", "number"),
    )  # fmt: skip
    rows = []
    for a in r.before_um:
        apart_s = np.diff(r.time_s)
        within = apart_s < GAP_S  # a night between two recordings is no change
        rates = np.abs(np.diff(r.sent_um[a]))[within] / apart_s[within]
        band, rms, fastest = r.band_um(a), r.rms_um(a), rates.max(initial=0.0)
        active = 100 * np.mean([s == "active" for s in r.state[a]])
        cells = (*(f"{v:.2f}" for v in (*band, *rms)), f"{active:.0f}", f"{fastest:.2f}")
        rows.append(Row.of(a, *cells))
    note = "The band holds 95 % of the rows; rms is about 0, the error at each recording's start."
    return Table("Error without and with compensation", columns, tuple(rows), r.simulated, notes=(note,))


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
    return Table("Changes of state", columns, tuple(rows), r.simulated, notes=notes)


def _picture(r: Rehearsal, axis: str) -> Picture:
    tall = 0.95 + 2 * _TALL_IN + _GAP_IN
    fig = Figure(figsize=(WIDTH_IN, tall + 0.3))
    head(fig, f"{axis}: error and correction", r.simulated)
    entries = [("—", "without compensation", MUTED), ("—", "with compensation", LINES[0]), ("—", "sent", LINES[2])]
    if r.readings_s:
        entries.append(("▲", "reading", LINES[1]))
    if r.failures:
        entries.append(("■", "sensor fails", ORANGE))
    legend_row(fig, entries, 0.12, 0.48)
    upper = panel(fig, 0.75, 0.75, WIDTH_IN - 0.95, _TALL_IN)
    lower = panel(fig, 0.75, 0.75 + _TALL_IN + _GAP_IN, WIDTH_IN - 0.95, _TALL_IN)
    _lines(upper, r, [(r.before_um[axis], MUTED, 1.0), (r.after_um[axis], LINES[0], 1.3)])
    _lines(lower, r, [(r.sent_um[axis], LINES[2], 1.3)])
    upper.set_ylabel("error, µm", fontsize=8.5, color=MUTED)
    lower.set_ylabel("sent, µm", fontsize=8.5, color=MUTED)
    lower.set_xlabel("time, h (nights are cut to one hour)", fontsize=8.5, color=MUTED)
    low = upper.get_ylim()[0]
    upper.plot(np.array(r.readings_s) / 3600, np.full(len(r.readings_s), low), "^", color=LINES[1], ms=4, clip_on=False)
    for f in r.failures:
        for ax in (upper, lower):
            ax.axvspan(f.start_s / 3600, f.end_s / 3600, color=ORANGE, alpha=0.16, lw=0)
        upper.annotate(f"{f.channel} {f.how}", (f.start_s / 3600, 1.0), xycoords=("data", "axes fraction"),
                       fontsize=7.5, color=ORANGE, va="bottom")  # fmt: skip
    _states(lower, r, axis)
    return picture(fig, f"Error and correction of {axis} in the rehearsal", r.simulated, look="full")


def _lines(ax: Axes, r: Rehearsal, lines: list[tuple[NDArray[np.float64], str, float]]) -> None:
    """Lines that break between the recordings."""
    every = max(1, len(r.time_s) // _MOST_POINTS)
    time_h = r.time_s / 3600
    breaks = np.flatnonzero(np.diff(time_h) > 0.5) + 1
    for values, color, width in lines:
        for rows in np.split(np.arange(len(time_h)), breaks):
            ax.plot(time_h[rows][::every], values[rows][::every], color=color, lw=width)
    ax.set_xlim(0, float(time_h[-1]))
    ax.axhline(0.0, color=MUTED, lw=0.6)


def _states(ax: Axes, r: Rehearsal, axis: str) -> None:
    """A strip above the axes that shows the state, with each state's name where it is wide enough."""
    time_h, states = r.time_s / 3600, np.array(r.state[axis])
    changes = [0, *(np.flatnonzero((states[1:] != states[:-1]) | (np.diff(time_h) > 0.5)) + 1), len(states)]
    whole = float(time_h[-1])
    for a, b in pairwise(changes):
        begin, end = time_h[a] / whole, time_h[b - 1] / whole
        ax.add_patch(_patch(ax, begin, end - begin, _STATES[str(states[a])]))
        if end - begin > 0.06:
            ax.text((begin + end) / 2, 1.075, str(states[a]), transform=ax.transAxes, fontsize=7, ha="center",
                    va="center", color="white" if states[a] == "active" else MUTED)  # fmt: skip


def _patch(ax: Axes, left: float, wide: float, color: str) -> Rectangle:
    return Rectangle((left, 1.03), wide, 0.09, transform=ax.transAxes, color=color, clip_on=False, lw=0)
