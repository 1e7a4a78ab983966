"""The figures of a twin and of simulated run plans. Each takes data and returns a figure; none computes a result."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from data.arrays import Array
from data.batch import Batch
from data.units import unit_label
from reports.drawing import LINES, MUTED, SIGNED, WIDTH_IN, calm, head, picture_bytes
from reports.labels import BLUE, INK, ORANGE, count, tex_escaped
from reports.twin.iso230_3 import side_legend, stacked
from twin.views.compared import Compared
from twin.views.overview import ModeView, time_words


def residual_map(shown: Compared) -> Figure:
    """Channel × time: recorded less simulated; temperatures and displacements each on their own colours."""
    groups = _byunit_label(shown.units)
    heights = [0.26 * len(g) + 0.05 for g in groups.values()]
    high = sum(heights) + 0.62 * len(heights) + 0.55
    fig = Figure(figsize=(WIDTH_IN, high))
    y = high - 0.55
    hours = shown.time_s / 3600
    for (unit, at), h in zip(groups.items(), heights, strict=True):
        ax = fig.add_axes((0.12, (y - h) / high, 0.76, h / high))
        values = shown.residual[at]
        top = _top(values)
        step = (hours[-1] - hours[0]) / max(len(hours) - 1, 1) or 1.0
        extent = (hours[0] - step / 2, hours[-1] + step / 2, len(at) - 0.5, -0.5)
        image = ax.imshow(
            values, aspect="auto", cmap=SIGNED, vmin=-top, vmax=top, extent=extent, interpolation="nearest"
        )
        ax.set_yticks(range(len(at)), [tex_escaped(shown.channels[i]) for i in at], fontsize=8)
        ax.tick_params(labelsize=8, length=2, color=MUTED)
        ax.set_facecolor("#d5dbe1")  # nothing usable recorded
        ax.spines[:].set_visible(False)
        bar = fig.colorbar(image, cax=fig.add_axes((0.895, (y - h) / high, 0.012, h / high)))
        bar.set_label(unit_label(unit), fontsize=8)
        bar.ax.tick_params(labelsize=7.5, length=2)
        bar.outline.set_visible(False)
        y -= h + 0.62
        ax.set_xlabel("time, h", fontsize=8, labelpad=1)
    head(fig, f"{shown.batch_id}: residual, recorded − simulated", shown.simulated)
    return fig


def mode_shapes(views: Sequence[ModeView], simulated: bool, most: int = 6) -> Figure:
    """The slowest modes: a panel each, a bar per body, the greatest amplitude 1; darker bars store more of the heat."""
    shown = views[:most]
    bodies = list(shown[0].shape)
    high = 0.2 * len(bodies) + 1.6
    fig = Figure(figsize=(WIDTH_IN, high))
    for k, v in enumerate(shown):
        width = 0.875 / len(shown)
        ax = fig.add_axes((0.115 + k * width, 0.30 / high, width - 0.012, 0.2 * len(bodies) / high))
        calm(ax)
        size = [v.shape[b] for b in bodies]
        strong = max(v.weight.values())
        for i, b in enumerate(bodies):
            color = BLUE if size[i] >= 0 else ORANGE
            ax.barh(i, size[i], height=0.72, color=color, alpha=0.25 + 0.75 * math.sqrt(v.weight[b] / strong))
        ax.axvline(0, color=INK, lw=0.8)
        ax.set(xlim=(-1.08, 1.08), ylim=(len(bodies) - 0.4, -0.6))
        ax.set_xticks([-1, 0, 1], ["−1", "0", "1"])
        ax.set_yticks(range(len(bodies)), [tex_escaped(b) for b in bodies] if k == 0 else [""] * len(bodies))
        ax.set_title(time_words(v.time_constant_s), fontsize=11, color=INK, loc="left", pad=40, fontweight="bold")
        ax.annotate(
            _wrapped(v.label, 23), (0, 1), (0, 37), xycoords="axes fraction", textcoords="offset points",
            fontsize=7.2, color=MUTED, va="top",
        )  # fmt: skip
    head(fig, "Slowest thermal modes", simulated)
    return fig


def _wrapped(text: str, most: int) -> str:
    lines = textwrap.wrap(text, most)
    return "\n".join(lines if len(lines) <= 3 else [*lines[:2], lines[2][: most - 1] + "…"]).replace("$", r"\$")


def _byunit_label(units: Sequence[str]) -> dict[str, list[int]]:
    out: dict[str, list[int]] = {}
    for i, u in enumerate(units):
        out.setdefault(u, []).append(i)
    return out


def _top(values: Array) -> float:
    good = np.abs(values[np.isfinite(values)])
    return float(np.quantile(good, 0.995)) or 1.0 if len(good) else 1.0


_MOST_PANELS = 8


def overview_png(plans: Sequence[tuple[str, Batch]]) -> bytes:
    """The overview of (name, batch) pairs as PNG."""
    return picture_bytes(overview(plans), "png", 150)


def overview(plans: Sequence[tuple[str, Batch]]) -> Figure:
    """One panel per error channel, one for the warmest sensor, one per driver that moves; one line per plan."""
    first = plans[0][1]
    drivers = [n for n in first.names("driver", "position") if any(np.ptp(b.values(n)) > 0 for _, b in plans)]
    errors, sensors = first.names("error"), first.names("temperature")
    panels = [(1.9, n) for n in errors] + ([(1.9, "")] if sensors else []) + [(1.0, n) for n in drivers]
    if not panels:
        panels = [(1.9, n) for n in first.channels][:1]
    fig, axes = stacked([height for height, _ in panels[:_MOST_PANELS]])
    for ax, (_, channel) in zip(axes, panels, strict=False):
        for k, (name, batch) in enumerate(plans):
            hours, colour = batch.time_s / 3600, LINES[k % len(LINES)]
            dash = ("-", "--", ":", "-.")[k // len(LINES) % 4]
            if channel:
                how = "steps-post" if channel in drivers else "default"
                ax.plot(hours, batch.values(channel), lw=1.3, color=colour, ls=dash, drawstyle=how, label=_short(name))
            else:
                warmest = np.max([batch.values(n) for n in sensors], axis=0)
                ax.plot(hours, warmest, lw=1.3, color=colour, ls=dash, label=_short(name))
        unit = unit_label(first.channels[channel].unit) if channel else "°C"
        ax.set_ylabel(f"{tex_escaped(channel) if channel else 'warmest sensor'}\n({unit})", fontsize=8)
        ax.margins(x=0, y=0.08)
        if channel in errors:
            ax.axhline(0, color=MUTED, lw=0.6)
    side_legend(axes[0])
    axes[-1].set_xlabel("time (h)", fontsize=9)
    height_in = fig.get_figheight()
    title = f"{tex_escaped(first.machine)}, {count(len(plans), 'run plan')}"
    fig.text(0.075, 1 - 0.24 / height_in, title, fontsize=11, fontweight="bold", va="center")
    fig.text(0.988, 1 - 0.24 / height_in, "SIMULATED", fontsize=11, color=ORANGE, fontweight="bold", ha="right",
             va="center")  # fmt: skip
    return fig


def _short(name: str, most: int = 20) -> str:
    text = name if len(name) <= most else name[: most - 1] + "…"
    return tex_escaped(text)
