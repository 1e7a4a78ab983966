"""Simulated run plans side by side: every error channel, the temperatures' span and the drivers over one time axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from data.batch import Batch
from pipelines.report.iso_figure import _COLOURS, _canvas, _free, _legend, _plain, png
from pipelines.report.words import ORANGE, count

_MOST_PANELS = 8


def overview_png(plans: Sequence[tuple[str, Batch]]) -> bytes:
    """The overview of (name, batch) pairs as PNG."""
    return png(overview(plans))


def overview(plans: Sequence[tuple[str, Batch]]) -> Figure:
    """One panel per error channel, one for the warmest sensor, one per driver that moves; one line per plan."""
    first = plans[0][1]
    drivers = [n for n in first.names("driver", "position") if any(np.ptp(b.values(n)) > 0 for _, b in plans)]
    errors, sensors = first.names("error"), first.names("temperature")
    panels = [(1.9, n) for n in errors] + ([(1.9, "")] if sensors else []) + [(1.0, n) for n in drivers]
    if not panels:
        panels = [(1.9, n) for n in first.channels][:1]
    fig, axes = _canvas([height for height, _ in panels[:_MOST_PANELS]])
    for ax, (_, channel) in zip(axes, panels, strict=False):
        for k, (name, batch) in enumerate(plans):
            hours, colour = batch.time_s / 3600, _COLOURS[k % len(_COLOURS)]
            dash = ("-", "--", ":", "-.")[k // len(_COLOURS) % 4]
            if channel:
                how = "steps-post" if channel in drivers else "default"
                ax.plot(hours, batch.values(channel), lw=1.3, color=colour, ls=dash, drawstyle=how, label=_short(name))
            else:
                warmest = np.max([batch.values(n) for n in sensors], axis=0)
                ax.plot(hours, warmest, lw=1.3, color=colour, ls=dash, label=_short(name))
        unit = _plain(first.channels[channel].unit) if channel else "°C"
        ax.set_ylabel(f"{_free(channel) if channel else 'warmest sensor'}\n({unit})", fontsize=8)
        ax.margins(x=0, y=0.08)
        if channel in errors:
            ax.axhline(0, color="#5a6572", lw=0.6)
    _legend(axes[0])
    axes[-1].set_xlabel("time (h)", fontsize=9)
    height_in = fig.get_figheight()
    title = f"{_free(first.machine)}, {count(len(plans), 'run plan')}"
    fig.text(0.075, 1 - 0.24 / height_in, title, fontsize=11, fontweight="bold", va="center")
    fig.text(0.988, 1 - 0.24 / height_in, "SIMULATED", fontsize=11, color=ORANGE, fontweight="bold", ha="right",
             va="center")  # fmt: skip
    return fig


def _short(name: str, most: int = 20) -> str:
    text = name if len(name) <= most else name[: most - 1] + "…"
    return _free(text)
