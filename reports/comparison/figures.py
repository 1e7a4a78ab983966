"""The figures of the comparison report. Each takes data and returns a figure; none computes a result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray

from data.arrays import Array
from data.sweeps import sweep_numbers
from reports.comparison.tables import LeftOut
from reports.drawing import GREY, MUTED, THIRD_IN, headed, panel
from reports.labels import BLUE, INK, ORANGE, family_label, number, selector_label, tex_escaped

_LEFT_IN, _RIGHT_IN = 0.42, 0.08  # room for tick labels


def axes_in(fig: Figure, top_in: float, tall_in: float, title: str, x: str, column: int = 0, columns: int = 1) -> Axes:
    """Axes in one of the figure's columns, with what they show above."""
    wide_in = fig.get_figwidth() / columns
    ax = panel(fig, column * wide_in + _LEFT_IN, top_in, wide_in - _LEFT_IN - _RIGHT_IN, tall_in)
    ax.set_title(tex_escaped(title), loc="left", fontsize=8, color=MUTED, pad=3)
    ax.set_xlabel(x, fontsize=8, color=MUTED, labelpad=2)
    return ax


def say_simulated(ax: Axes, simulated: bool) -> None:
    if simulated:
        ax.set_title("SIMULATED", loc="right", fontsize=7.5, color=ORANGE, fontweight="bold", pad=3)


def logarithmic(ax: Axes, values_um: Sequence[float], axis: str = "y") -> None:
    """A logarithmic axis over the finite values above zero, with a few round ticks."""
    good = [v for v in values_um if math.isfinite(v) and v > 0] or [1.0]
    own = ax.yaxis if axis == "y" else ax.xaxis
    low, high = min(good), max(*good, 2 * min(good))
    margin = (high / low) ** 0.05
    ax.set(**{f"{axis}scale": "log", f"{axis}lim": (low / margin, high * margin)})
    own.set_major_locator(LogLocator(subs=(1, 2, 5), numticks=6))
    own.set_major_formatter("{x:g}")
    ax.minorticks_off()


_ROW_IN, _NAME_IN, _CELL_IN = 0.17, 1.15, 1.05
_MOST_ROWS = 12


def tried(cells: pd.DataFrame, chosen: str, title: str, levels_um: Mapping[str, float], simulated: bool) -> Figure:
    """A row per family, least S first, a mark for each of its cells; right of it selector and points of the least.

    Args:
        cells: selector, family, n_tsp, S_mean_um of all that were judged on the same runs.
        chosen: the chosen cell, as ``selector|family|n_tsp``.
        levels_um: S of the baselines by name, a line each.
    """
    least = cells.sort_values("S_mean_um", kind="stable").drop_duplicates("family")[:_MOST_ROWS]
    tall_in = _ROW_IN * len(least)
    fig = Figure(figsize=(THIRD_IN, tall_in + 0.8))
    ax = panel(fig, _NAME_IN, 0.36, THIRD_IN - _NAME_IN - _CELL_IN, tall_in)
    labels = cells["selector"] + "|" + cells["family"] + "|" + cells["n_tsp"].astype(str)
    for i, row in enumerate(least.to_dict("records")):
        own = cells[cells["family"] == row["family"]]
        every = own["selector"] == "none"
        by_selector = own.loc[~every, "S_mean_um"]
        ax.plot(by_selector, [i] * len(by_selector), "o", color=BLUE, ms=3.6, alpha=0.45, mec="none")
        ax.plot(own.loc[every, "S_mean_um"], [i] * int(every.sum()), "s", color=INK, ms=3.8)
        mine = own.loc[labels[own.index] == chosen, "S_mean_um"]
        ax.plot(mine, [i] * len(mine), "D", color=ORANGE, ms=5.5)
        chosen_by = f"{selector_label(row['selector'])}, {row['n_tsp']}" if row["n_tsp"] else ""
        ax.text(1.04, i, chosen_by, transform=ax.get_yaxis_transform(), fontsize=7, color=MUTED, va="center")
    for name, level in levels_um.items():
        ax.axvline(level, color=MUTED, lw=1.0, ls=LEVELS[name])
    values = [*cells["S_mean_um"], *levels_um.values()]
    logarithmic(ax, values, "x")
    ax.set_yticks(range(len(least)), [family_label(f) for f in least["family"]], fontsize=7.5)
    ax.set_ylim(len(least) - 0.4, -0.6)
    ax.set_xlabel("S_mean, µm", fontsize=8, color=MUTED, labelpad=2)
    headed(fig, title, simulated)
    return fig


LEVELS = {"no model": ":", "mean curve": "--"}


def in_order(runs: pd.DataFrame, bound_um: float, title: str, simulated: bool) -> Figure:
    """S of every left-out run in the order of time, with the model and without one, and the bound of any run.

    Args:
        runs: start, S_um, none_um.
    """
    fig = Figure(figsize=(THIRD_IN, 2.3))
    ax = axes_in(fig, 0.36, 1.5, "", "run, in order of time")
    at = np.arange(len(runs))
    ax.plot(at, runs["none_um"], "s", color=GREY, ms=4, mec=MUTED, mew=0.5)
    ax.plot(at, runs["S_um"], "o", color=BLUE, ms=4.5)
    if math.isfinite(bound_um):
        ax.axhline(bound_um, color=INK, lw=1.0, ls="--")
    logarithmic(ax, [*runs["none_um"], *(0.85 * runs["S_um"]), 1.1 * bound_um])
    ends = sorted({0, len(runs) - 1})
    ticks = ax.set_xticks(ends, [str(runs["start"].iloc[k])[:10] for k in ends], fontsize=7, ha="left")
    if len(ticks) > 1:
        ticks[-1].label1.set_horizontalalignment("right")
    ax.set_xlim(-0.9, len(runs) - 0.1)
    headed(fig, title, simulated)
    return fig


def curves(shown: Sequence[LeftOut], among: Sequence[LeftOut], target: str, digits: int, simulated: bool) -> Figure:
    """Recording and left-out prediction above, their difference below; a column per batch.

    Args:
        among: the batches whose figures have equal residual axes.
    """
    fig = Figure(figsize=(THIRD_IN * len(shown), 2.85))
    for k, b in enumerate(shown):
        upper, lower = _with_residual(fig, k, shown, f"{target}, µm", "time since start, h", digits)
        _end(upper, lower, among, simulated)
        upper.plot(b.time_h, b.recorded_um, color=INK, lw=0.9, label="recorded")
        upper.plot(b.time_h, b.predicted_um, color=BLUE, lw=1.5, label="predicted")
        lower.plot(b.time_h, b.recorded_um - b.predicted_um, color=ORANGE, lw=0.9)
    return fig


def _with_residual(fig: Figure, k: int, shown: Sequence[LeftOut], title: str, x: str, digits: int) -> tuple[Axes, Axes]:
    """Axes for the values and for the residual of one of the figure's columns, below the batch's name."""
    high_in, n = fig.get_figheight(), len(shown)
    upper = axes_in(fig, 0.42, high_in - 1.67, title, "", k, n)
    lower = axes_in(fig, high_in - 0.95, 0.52, "residual, µm", x, k, n)
    upper.tick_params(axis="x", length=0, labelbottom=False)
    upper.sharex(lower)
    fig.text(k / n + 0.04 / fig.get_figwidth(), 1 - 0.12 / high_in, tex_escaped(place(shown[k], digits)), fontsize=8.5,
             color=INK, va="center")  # fmt: skip
    return upper, lower


def _end(upper: Axes, lower: Axes, among: Sequence[LeftOut], simulated: bool) -> None:
    """Ticks, and one symmetric residual range for all batches."""
    upper.yaxis.set_major_locator(MaxNLocator(5))
    lower.yaxis.set_major_locator(MaxNLocator(3))
    lower.axhline(0, color=MUTED, lw=0.6)
    most_um = most_residual_um(among)
    lower.set_ylim(-most_um, most_um)
    say_simulated(upper, simulated)


def place(batch: LeftOut, digits: int, most: int = 24) -> str:
    """``best: b07, S = 2.0 µm``; a long name loses its middle."""
    name = batch.batch_id
    short = name if len(name) <= most else f"{name[: most // 2 - 1]}…{name[-most // 2 :]}"
    return f"{batch.place}: {short}, S = {number(batch.S_um, digits)} µm"


def most_residual_um(batches: Sequence[LeftOut]) -> float:
    """Where the residual axes of all shown batches end."""
    values = [np.abs(b.recorded_um - b.predicted_um) for b in batches]
    finite = [float(np.nanmax(v)) for v in values if np.isfinite(v).any()]
    return 1.08 * max(finite, default=1.0) or 1.0


_MOST_SWEEPS = 12
_COLOURS = colormaps["plasma"]  # even to the eye and safe for the colour-blind
_LAST = 0.84  # of its range: the yellow behind it is unreadable on white


def fan(shown: Sequence[LeftOut], among: Sequence[LeftOut], target: str, digits: int, simulated: bool) -> Figure:
    """Readings and predicted lines of every sweep over the position, the residual below; a column per batch.

    Args:
        among: the batches whose figures have equal residual axes and colours of the time.
    """
    fig, last_h = Figure(figsize=(THIRD_IN * len(shown), 3.3)), longest_h(among)
    for k, b in enumerate(shown):
        upper, lower = _with_residual(fig, k, shown, f"{target}, µm", "position, mm", digits)
        upper.axhline(0, color=MUTED, lw=0.6)
        for rows in drawn_sweeps(b):
            color = time_colour(float(b.time_h[rows].mean()) / last_h)
            rows = rows[np.argsort(positions(b)[rows], kind="stable")]
            at, recorded, predicted = positions(b)[rows], b.recorded_um[rows], b.predicted_um[rows]
            upper.plot(at, predicted, color=color, lw=1.1)
            upper.plot(at, recorded, color=color, marker="o", ls="", ms=3.6, mec="white", mew=0.3)
            lower.plot(at, recorded - predicted, color=color, marker="o", ls="", ms=3.0, mec="white", mew=0.3)
        _end(upper, lower, among, simulated)
    return fig


def positions(batch: LeftOut) -> Array:
    """Positions in mm of a channel along an axis."""
    assert batch.position_mm is not None
    return batch.position_mm


def longest_h(batches: Sequence[LeftOut]) -> float:
    """The longest batch, h."""
    return max(float(b.time_h.max(initial=0.0)) for b in batches) or 1.0


def drawn_sweeps(batch: LeftOut) -> list[NDArray[np.int64]]:
    """Rows of the sweeps behind the first, which is zero; of many, evenly spaced ones."""
    every = sweeps(batch)
    at = np.unique(np.linspace(0, len(every) - 1, _MOST_SWEEPS).round().astype(int))
    return [every[i] for i in at] if every else []


def sweeps(batch: LeftOut) -> list[NDArray[np.int64]]:
    """Rows of every sweep behind the first."""
    number_of = sweep_numbers(batch.time_h * 3600.0, positions(batch))
    return [np.flatnonzero(number_of == k) for k in range(1, int(number_of.max(initial=0)) + 1)]


def time_colour(share: float) -> str:
    """The colour of a time, as a share 0..1 of the longest."""
    return to_hex(_COLOURS(_LAST * min(max(share, 0.0), 1.0)))
