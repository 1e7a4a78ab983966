"""The figures of a diagnosis but for the map. Each takes data and returns a figure; none computes a result."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
from matplotlib.figure import Figure

from data.units import unit_label
from reports.drawing import GRID, LINES, MUTED, THIRD_IN, headed, panel
from reports.labels import BLUE, INK, ORANGE, digits_of, number, tex_escaped

_ROW_IN, _MOST_LETTERS = 0.36, 58


def left_out_run(own: pd.DataFrame, scores: pd.DataFrame, channel: str, changed: bool, simulated: bool) -> Figure:
    """One channel of a left-out run: recording, simulation before and after, and the rms of both.

    Args:
        own: time_s, recorded, before, after and unit of this run and channel.
        scores: its row of the left-out rms.
        changed: whether something was found; else there is one simulation.
    """
    fig = Figure(figsize=(THIRD_IN, 2.2))
    ax = panel(fig, 0.45, 0.52, THIRD_IN - 0.55, 1.2)
    hours = own["time_s"].to_numpy(float) / 3600
    if changed:
        ax.plot(hours, own["before"], color=ORANGE, lw=1.5)
    ax.plot(hours, own["after"], color=BLUE, lw=1.9)
    ax.plot(hours, own["recorded"], color=INK, lw=0.9)
    ax.set_xlabel("time since start, h", fontsize=8, color=MUTED, labelpad=2)
    ax.locator_params(axis="y", nbins=5)
    for r in scores.to_dict("records"):
        digits = digits_of(r["before"], r["after"])
        before = f"{number(r['before'], digits)} → " if changed else ""
        said = f"rms {before}{number(r['after'], digits)} {unit_label(r['unit'])}"
        ax.set_title(said, loc="left", fontsize=8, color=MUTED, pad=3)
    unit = unit_label(str(own["unit"].iloc[0])) if len(own) else ""
    headed(fig, f"{channel}, {unit}", simulated)
    return fig


def probabilities(rows: Sequence[tuple[str, float, str]], title: str, simulated: bool) -> Figure:
    """A bar for each explanation, its name above it.

    Args:
        rows: name, probability, its label.
    """
    tall_in = _ROW_IN * len(rows)
    fig = Figure(figsize=(THIRD_IN, tall_in + 0.42))
    ax = fig.add_axes((0.02, 0.06 / (tall_in + 0.42), 0.82, tall_in / (tall_in + 0.42)))
    ax.set(xlim=(0, 1), ylim=(len(rows) - 0.35, -0.65))
    ax.axis("off")
    for k, (name, p, label) in enumerate(rows):
        cut = name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS - 1]}…"
        ax.text(0, k - 0.22, tex_escaped(cut), fontsize=7.5, color=INK, va="center")
        ax.barh(k + 0.16, 1, height=0.22, color=GRID)
        ax.barh(k + 0.16, p, height=0.22, color=BLUE if k == 0 else LINES[5])
        ax.text(1.03, k + 0.16, label, fontsize=8, color=INK, va="center")
    headed(fig, title, simulated)
    return fig
