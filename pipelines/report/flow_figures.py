"""Where the watts go, drawn: stacked areas over time, and the network at one moment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pipelines.report.twin_figures import _WIDTH_IN, SOFT, _calm, _head
from pipelines.report.words import INK, number
from twin.views.heat_flows import HeatFlows

Array = NDArray[np.float64]

_HEATS = LinearSegmentedColormap.from_list("heats", ["#7a2e00", "#d55e00", "#f0a35e", "#f8d9b8"])
_STORES = LinearSegmentedColormap.from_list("stores", ["#0b4f7d", "#3b8cc4", "#8fc1e3", "#d3e6f3"])
_LOSSES = LinearSegmentedColormap.from_list("losses", ["#00553f", "#3a9c7f", "#a5d3c3"])
_MOST_STORES = 6


def heat_stack(flows: HeatFlows) -> Figure:
    """Heat put in above zero; what bodies store and what surroundings take below. Both sides are equal at all times.

    What gives heat back (a body that cools, a surrounding warmer than the machine) stands on the other side.
    """
    fig = Figure(figsize=(_WIDTH_IN, 5.4))
    ax = fig.add_axes((0.07, 0.10, 0.66, 0.80))
    _calm(ax)
    hours = np.repeat(flows.time_s / 3600, 2)[1:-1]
    groups: list[tuple[str, Mapping[str, Array], LinearSegmentedColormap, float]] = [
        ("heat", flows.heat_W, _HEATS, 1.0),
        ("taken by", flows.loss_W, _LOSSES, -1.0),
        ("stored in", _greatest(flows.storage_W, flows.dt_s, _MOST_STORES), _STORES, -1.0),
    ]
    up, down = np.zeros(len(flows.dt_s)), np.zeros(len(flows.dt_s))
    entries: list[tuple[str, str, float]] = []
    duration_s = float(flows.dt_s.sum())
    for title, series, colors, sign in groups:
        entries.append((title, "", float("nan")))
        for k, (name, watts) in enumerate(series.items()):
            color = to_hex(colors(k / max(len(series) - 1, 1)))
            up, down = _area(ax, hours, sign * watts, up, down, color, f"{title} {name}")
            entries.append((name, color, float(watts @ flows.dt_s) / duration_s))
    ax.axhline(0, color=INK, lw=0.9)
    ax.set_xlim(hours[0], hours[-1])
    ax.set_xlabel("time, h", fontsize=9)
    ax.set_ylabel("W, put in above, stored and given off below", fontsize=9)
    _entries(fig, entries)
    _head(fig, f"{flows.batch_id}: where the watts go", flows.simulated)
    return fig


def _greatest(series: Mapping[str, Array], dt_s: Array, most: int) -> dict[str, Array]:
    """The greatest by the energy that moves; the others as one."""
    order = sorted(series, key=lambda n: -float(np.abs(series[n]) @ dt_s))
    out = {n: series[n] for n in order[:most]}
    rest = order[most:]
    if len(rest) == 1:
        out[rest[0]] = series[rest[0]]
    elif rest:
        out[f"{len(rest)} others"] = np.sum([series[n] for n in rest], axis=0)
    return out


def _area(ax: Axes, hours: Array, watts: Array, up: Array, down: Array, color: str, label: str) -> tuple[Array, Array]:
    """Stack a series: its positive part on what is above, its negative part below; steps, as means of intervals are."""
    for part, base in ((np.maximum(watts, 0.0), up), (np.minimum(watts, 0.0), down)):
        if np.any(part):
            ax.fill_between(
                hours, np.repeat(base, 2), np.repeat(base + part, 2), color=color, lw=0.3, ec="white", label=label
            )
    return up + np.maximum(watts, 0.0), down + np.minimum(watts, 0.0)


def _entries(fig: Figure, entries: Sequence[tuple[str, str, float]]) -> None:
    y = 0.89
    fig.text(0.985, y + 0.005, "mean W", fontsize=8, color=SOFT, ha="right", va="center")
    for name, color, mean in entries:
        if not color:
            y -= 0.012
            fig.text(0.75, y, name, fontsize=8.5, color=INK, va="center", fontweight="bold")
        else:
            fig.text(0.755, y, "■", fontsize=10, color=color, va="center")
            fig.text(0.777, y, name.replace("$", r"\$"), fontsize=8.5, color=INK, va="center")
            fig.text(
                0.985, y, number(mean, 0 if abs(mean) >= 9.95 else 1), fontsize=8.5, color=INK, ha="right", va="center"
            )
        y -= 0.036
