"""Before and after: left-out rms by channel, and left-out batches. Each takes data and returns a figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pipelines.report.diagnosis_words import UNITS
from pipelines.report.twin_figures import _WIDTH_IN, SOFT, _calm, _head
from pipelines.report.words import BLUE, INK, ORANGE, number

FLOOR = "#cfd6dd"
_ROW_IN, _MOST_ROWS, _MOST_RUNS = 0.27, 12, 30
_NAMES_IN, _NUMBERS_IN = 1.15, 1.95


def before_after(channels: pd.DataFrame, changed: bool, simulated: bool) -> Figure:
    """A dumbbell per channel, displacements left and temperatures right, with the noise floor as a bar behind.

    Args:
        channels: `diagnosis_extracts.by_channel`, in the order to draw; at most 12 of a unit are drawn.
        changed: whether something was found; else there is one dot a channel.
    """
    groups = [part for _, part in channels.groupby(channels["unit"].isin(["K", "degC"]), sort=False)]
    left_over = [max(len(g) - _MOST_ROWS, 0) for g in groups]
    groups = [g[:_MOST_ROWS] for g in groups]
    high = _ROW_IN * max(len(g) for g in groups) + 1.3
    fig = Figure(figsize=(_WIDTH_IN, high))
    panel = _WIDTH_IN / len(groups)
    for k, part in enumerate(groups):
        left, wide, tall = k * panel + _NAMES_IN, panel - _NAMES_IN - _NUMBERS_IN, _ROW_IN * len(part)
        ax = fig.add_axes((left / _WIDTH_IN, 1 - (0.86 + tall) / high, wide / _WIDTH_IN, tall / high))
        _bells(ax, part, [str(c) for c in part["channel"]], changed)
        _numbers(ax, part, changed, wide)
        if left_over[k]:
            ax.set_xlabel(f"{ax.get_xlabel()}; {left_over[k]} more channels change less", fontsize=8, labelpad=1)
    _head(fig, "Error of left-out runs against the noise floor", simulated)
    _keys(fig, changed)
    return fig


def by_run(rms: pd.DataFrame, channels: Sequence[str], changed: bool, simulated: bool) -> Figure:
    """The same run by run (at most 30), a panel for each of the given channels."""
    every = list(dict.fromkeys(rms["batch"]))
    runs = every[:_MOST_RUNS]
    high = 0.2 * len(runs) + 1.35
    fig = Figure(figsize=(_WIDTH_IN, high))
    wide = (_WIDTH_IN - _NAMES_IN) / len(channels)
    for k, channel in enumerate(channels):
        own = rms[rms["channel"] == channel].drop_duplicates("batch").set_index("batch")
        part = own.reindex(runs)
        size = ((_NAMES_IN + k * wide) / _WIDTH_IN, 0.45 / high, (wide - 0.25) / _WIDTH_IN, 0.2 * len(runs) / high)
        ax = fig.add_axes(size)
        _bells(ax, part, [_shortened(str(r)) for r in runs] if k == 0 else [""] * len(runs), changed)
        ax.set_title(_free(channel), fontsize=9, loc="left", color=INK, pad=4)
        if changed:
            better = f"{int((own['after'] < own['before']).sum())} of {int(own['after'].notna().sum())} better"
            ax.set_title(better, fontsize=8, loc="right", color=SOFT, pad=4)
    first = f" (the first {len(runs)} of {len(every)})" if len(every) > len(runs) else ""
    _head(fig, f"Run by run, each predicted from the others{first}", simulated)
    _keys(fig, changed)
    return fig


def _bells(ax: Axes, part: pd.DataFrame, names: Sequence[str], changed: bool) -> None:
    """Floor, before and after of every row."""
    _calm(ax)
    top = float(np.nanmax(part[["before", "after", "floor"]].to_numpy(float), initial=0.0)) or 1.0
    units = part["unit"].dropna()
    at = np.arange(len(part))
    ax.barh(at, part["floor"], height=0.62, color=FLOOR, zorder=2)
    if changed:
        ax.hlines(at, part["before"], part["after"], color="#8593a1", lw=2.0, zorder=3)
        ax.plot(part["before"], at, "o", ms=7, mfc=ORANGE, mec="white", mew=0.9, zorder=4)
    ax.plot(part["after"], at, "o", ms=7, mfc=BLUE, mec="white", mew=0.9, zorder=5)
    ax.set(xlim=(0, 1.06 * top), ylim=(len(part) - 0.5, -0.5))
    ax.set_yticks(at, [_free(n) for n in names], fontsize=8.5)
    unit = UNITS.get(str(units.iloc[0]), str(units.iloc[0])) if len(units) else ""
    ax.set_xlabel(f"rms, {unit}", fontsize=8, labelpad=1)
    ax.grid(axis="y", visible=False)
    ax.tick_params(axis="y", length=0)
    ax.locator_params(axis="x", nbins=6)


def _numbers(ax: Axes, part: pd.DataFrame, changed: bool, wide_in: float) -> None:
    """Columns right of a panel: before → after, noise, runs that improve."""
    columns = [1 + x / wide_in for x in (0.8, 1.2, 1.9)]
    look: dict[str, Any] = {"transform": ax.get_yaxis_transform(), "va": "center", "ha": "right"}
    for x, words in zip(columns, ("rms", "noise", "runs better" if changed else ""), strict=True):
        ax.text(x, -0.86, words, fontsize=7.5, color=SOFT, **look)
    for i, r in enumerate(part.to_dict("records")):
        digits = _digits(max(r["before"], r["after"]))
        after = number(r["after"], digits)
        values = f"{number(r['before'], digits)} → {after}" if changed else after
        cells = (values, number(r["floor"], digits), f"{r['improved']} of {r['batches']}" if changed else "")
        for x, words, color in zip(columns, cells, (INK, SOFT, SOFT), strict=True):
            ax.text(x, i, words, fontsize=8.5, color=color, **look)


def _keys(fig: Figure, changed: bool) -> None:
    """What the marks mean, below the title."""
    entries = [("●", "before", ORANGE), ("●", "after", BLUE)] if changed else [("●", "simulation", BLUE)]
    x, y = _NAMES_IN / _WIDTH_IN, 1 - 0.5 / fig.get_figheight()
    for mark, words, color in (*entries, ("■", "noise floor", FLOOR)):
        fig.text(x, y, mark, fontsize=10, color=color, va="center")
        fig.text(x + 0.016, y, words, fontsize=8.5, color=SOFT if color == FLOOR else color, va="center")
        x += 0.034 + 0.0068 * len(words)


def left_out_batches(
    series: pd.DataFrame,
    rms: pd.DataFrame,
    batches: Sequence[tuple[str, str]],
    channels: Sequence[str],
    changed: bool,
    simulated: bool,
) -> Figure:
    """Small multiples: a row per left-out batch (with the reason why it is shown), a column per channel."""
    n, m = len(batches), max(len(channels), 1)
    cell, head = 1.75, 0.95
    high = cell * n + head + 0.35
    fig = Figure(figsize=(_WIDTH_IN, high))
    left, gap = 0.05, 0.04
    wide = (1 - left - 0.005 - gap * (m - 1)) / m
    for i, (batch, why) in enumerate(batches):
        y = 1 - (head + cell * i) / high
        fig.text(0.1 / _WIDTH_IN, y + 0.12 / high, _free(batch), fontsize=9, color=INK, fontweight="bold", va="center")
        x = 0.1 / _WIDTH_IN + 0.0086 * len(batch) + 0.012
        fig.text(x, y + 0.12 / high, why, fontsize=8.5, color=SOFT, va="center")
        for j, channel in enumerate(channels):
            bottom = y - (cell - 0.42) / high
            ax = fig.add_axes((left + j * (wide + gap), bottom, wide, (cell - 0.72) / high))
            own = series[(series["batch"] == batch) & (series["channel"] == channel)]
            told = rms[(rms["batch"] == batch) & (rms["channel"] == channel)]
            _run(ax, own, told, channel, changed)
            if i == n - 1:
                ax.set_xlabel("time, h", fontsize=8, labelpad=1)
            else:
                ax.tick_params(labelbottom=False)
    _head(fig, "Left-out runs, predicted without ever having been seen", simulated)
    entries = [("recording", INK)]
    entries += [("simulation before", ORANGE), ("simulation after", BLUE)] if changed else [("simulation", BLUE)]
    x = left
    for words, color in entries:
        fig.text(x, 1 - 0.5 / high, f"— {words}", fontsize=8.5, color=color, va="center")
        x += 0.034 + 0.0068 * len(words)
    return fig


def _run(ax: Axes, own: pd.DataFrame, told: pd.DataFrame, channel: str, changed: bool) -> None:
    _calm(ax)
    hours = own["time_s"].to_numpy(float) / 3600
    if changed:
        ax.plot(hours, own["before"], color=ORANGE, lw=1.5, label="before")
    ax.plot(hours, own["after"], color=BLUE, lw=1.9, label="after")
    ax.plot(hours, own["recorded"], color=INK, lw=0.9, label="recorded")
    unit = UNITS.get(str(own["unit"].iloc[0]), str(own["unit"].iloc[0])) if len(own) else ""
    ax.set_title(_free(f"{channel}, {unit}"), fontsize=8.5, loc="left", color=INK, pad=3)
    for r in told.to_dict("records"):
        digits = _digits(max(r["before"], r["after"]))
        after = f"rms {number(r['after'], digits)} {UNITS.get(r['unit'], r['unit'])}"
        words = after.replace("rms ", f"rms {number(r['before'], digits)} → ") if changed else after
        ax.set_title(words, fontsize=8, loc="right", color=BLUE, pad=3)
    ax.locator_params(axis="y", nbins=4)
    if len(hours) > 1:
        ax.set_xlim(hours[0], hours[-1])


def _shortened(name: str) -> str:
    """Both ends of a long name: what tells runs apart stands mostly last."""
    return name if len(name) <= 13 else f"{name[:4]}…{name[-8:]}"


def _digits(value: float) -> int:
    return 0 if value >= 99.5 else 1 if value >= 0.95 else 2


def _free(name: str) -> str:
    return name.replace("$", r"\$")
