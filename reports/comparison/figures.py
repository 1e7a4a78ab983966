"""The figures of the comparison report. Each takes data and returns a figure; none computes a result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from data.arrays import Array
from data.sweeps import sweep_numbers
from reports.comparison.tables import LeftOut, is_baseline
from reports.drawing import GREY, MUTED, panel
from reports.labels import (
    BLUE,
    INK,
    ORANGE,
    cell_label,
    family_label,
    number,
    selector_label,
    styles,
    tex_escaped,
)
from reports.layout import Key, Scale

THIRD_IN, HALF_IN = 3.35, 5.15  # 360 and 560 px on the page
MARKS = {"circle": "o", "square": "s", "diamond": "D", "triangle-up": "^"}
_DASHES = {"dot": ":", "dash": "--", "dashdot": "-."}
_LEVELS = {"zero": "dot", "mean_curve": "dash"}
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


def logarithmic(ax: Axes, scale: Scale, axis: str = "y") -> None:
    """A logarithmic axis with round ticks, at most as many as it holds."""
    ticks = [float(label) for _, label in scale.ticks]
    ax.set(**{f"{axis}scale": "log", f"{axis}lim": (scale.low_um, scale.high_um)})
    ax.set(**{f"{axis}ticks": ticks, f"{axis}ticklabels": [f"{v:g}" for v in ticks]})
    ax.minorticks_off()


def best_cells(best: pd.DataFrame, nothing_um: float, title: str, simulated: bool) -> Figure:
    """A bar per row, S_mean with S_std; baselines grey.

    Args:
        best: selector, family, n_tsp, S_mean_um, S_std_um, best first.
        nothing_um: S_mean without a model; the axis ends at twice this.
    """
    names = [cell_label(str(r["selector"]), str(r["family"]), int(r["n_tsp"])) for r in best.to_dict("records")]
    tall_in = 0.26 * len(best)
    fig = Figure(figsize=(7.0, tall_in + 0.8))
    ax = panel(fig, 2.8, 0.3, 4.0, tall_in)
    spread = best["S_std_um"].fillna(0.0)
    colors = np.where(is_baseline(best), GREY, BLUE)
    ax.barh(names, best["S_mean_um"], xerr=spread, color=colors, ecolor=INK, error_kw={"lw": 1}, height=0.62)
    widest = float((best["S_mean_um"] + spread).max())
    ax.set_xlim(0, 1.05 * (min(widest, 2 * nothing_um) if nothing_um > 0 else widest) or 1.0)
    ax.set_ylim(len(best) - 0.5, -0.5)
    ax.set_title(tex_escaped(title), loc="left", fontsize=8, color=MUTED)
    ax.set_xlabel("S_mean ± S_std, µm", fontsize=8, color=MUTED)
    say_simulated(ax, simulated)
    return fig


def against_points(
    lines: pd.DataFrame, flat: pd.DataFrame, column: str, title: str, chosen: str, simulated: bool
) -> Figure:
    """One score against the number of points, a line per family at its best selector.

    Args:
        lines: family, selector, n_tsp and `column` in µm.
        flat: families without inputs: a level each.
        chosen: the family of the promoted cell, drawn stronger.
    """
    fig = Figure(figsize=(HALF_IN, 3.0))
    ax = axes_in(fig, 0.25, 2.35, title, "number of points n")
    n_max = int(lines["n_tsp"].max()) if len(lines) else 1
    for row in flat.to_dict("records"):
        ax.axhline(row[column], color=MUTED, lw=1.1, ls=_DASHES[flat_dash(row["family"])],
                   label=family_label(row["family"]))  # fmt: skip
    looks = styles(lines["family"].tolist())
    for (family, selector), own in lines.groupby(["family", "selector"], sort=False):
        own, (color, symbol) = own.sort_values("n_tsp"), looks[str(family)]
        strong = family == chosen
        ax.plot(own["n_tsp"], own[column], color=color, marker=MARKS[symbol], lw=2.2 if strong else 1.0,
                ms=4.5 if strong else 3.2, zorder=3 if strong else 2,
                label=f"{family_label(str(family))}, {selector_label(str(selector))}")  # fmt: skip
    ax.set_xlim(0.6, n_max + 0.4)
    ax.xaxis.set_major_locator(MaxNLocator(12, integer=True, min_n_ticks=1))
    top = float(flat[column].max()) if len(flat) else math.inf
    logarithmic(ax, Scale.over([*lines[column], *flat[column]], 1.2 * top))
    say_simulated(ax, simulated)
    return fig


def flat_dash(family: str) -> str:
    """The dash of a level."""
    return _LEVELS.get(family, "dashdot")


@dataclass(frozen=True)
class Cloud:
    """Points (n,) of one kind, S in µm on both axes."""

    x_um: Array
    y_um: Array
    key: Key


def S_against_S(
    clouds: Sequence[Cloud], lines: Sequence[tuple[float, str]], x: str, y: str, simulated: bool, equal: bool = True
) -> Figure:
    """A mark per batch on two logarithmic axes, equal ones by default; a line (factor, colour) is y = factor · x."""
    fig = Figure(figsize=(HALF_IN * 0.8, HALF_IN * 0.8))
    ax = axes_in(fig, 0.25, HALF_IN * 0.8 - 0.7, f"{y}, µm", f"{x}, µm")
    values = [np.concatenate([of(c) for c in clouds]) for of in (lambda c: c.x_um, lambda c: c.y_um)]
    values = [np.concatenate(values)] * 2 if equal else values
    scales = [Scale.over(v.tolist(), math.inf) for v in values]
    for axis, scale in zip("xy", scales, strict=True):
        logarithmic(ax, scale, axis)
    for c in clouds:
        at = [np.maximum(v, scale.low_um) for v, scale in zip((c.x_um, c.y_um), scales, strict=True)]
        ax.plot(*at, color=c.key.color, marker=MARKS[c.key.symbol], ls="", ms=4.5, mec="white", mew=0.4)
    ends = np.array([scales[0].low_um, scales[0].high_um])
    for factor, color in lines:
        ax.plot(ends, factor * ends, color=color, lw=1.3, zorder=1)
    say_simulated(ax, simulated)
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
