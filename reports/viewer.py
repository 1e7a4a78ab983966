"""The viewer of runs that all pages share: choose run and channel, read values, zoom; data of a page's own figures."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from data.arrays import Array
from data.units import unit_label

_MOST_SAMPLES = 700  # of a line: as many as a screen shows in one view
_DIGITS = 4  # of a line's range that are kept


@dataclass(frozen=True)
class Trace:
    """A line (n,); NaN where there is no value. `look` is its colour, `lower` puts it on the lower axes."""

    label: str
    values: Array
    look: Literal["recorded", "computed", "before", "sent"]
    lower: bool = False


@dataclass(frozen=True)
class Pane:
    """One channel of one run: lines over the time (n,) in h since its start; `summary` is a short result of it.

    With `residual` the lower axes show the first line less each other one. Where the first line has no value the pane
    is shaded as masked.
    """

    run: str
    channel: str
    unit: str
    time_h: Array
    traces: tuple[Trace, ...]
    summary: str = ""
    residual: bool = True


@dataclass(frozen=True)
class Viewer:
    """Panes to choose from."""

    caption: str
    panes: tuple[Pane, ...]
    simulated: bool = False
    notes: tuple[str, ...] = ()

    @property
    def json(self) -> str:
        """The panes as JSON that can stand in a script element."""
        return json.dumps({"panes": [_plain(p) for p in self.panes]}, separators=(",", ":")).replace("<", "\\u003c")


def viewer(caption: str, panes: Sequence[Pane], simulated: bool) -> Viewer | None:
    """The viewer with a note on what is thinned; None without a pane."""
    if not panes:
        return None
    every = max(_every(p) for p in panes)
    notes = (
        "Drag to zoom, double-click to see the whole run. With the focus on a chart: arrow keys move the cursor, "
        "+ and − zoom, 0 shows the whole run. Masked samples are shaded.",
        *([f"Of long runs up to every {every}th sample is drawn."] if every > 1 else []),
    )
    return Viewer(caption, tuple(panes), simulated, (" ".join(notes),))


def _every(pane: Pane) -> int:
    return max(1, -(-len(pane.time_h) // _MOST_SAMPLES))


def _plain(pane: Pane) -> dict[str, Any]:
    every = _every(pane)
    lines = [
        {"label": t.label, "look": t.look, "lower": t.lower, **_steps(t.values[::every])} for t in pane.traces
    ]  # fmt: skip
    return {
        "run": pane.run, "channel": pane.channel, "unit": unit_label(pane.unit), "said": pane.summary,
        "residual": pane.residual, "time": _steps(pane.time_h[::every]), "lines": lines,
    }  # fmt: skip


def _steps(values: Array) -> dict[str, Any]:
    """Values as whole steps of size `q` from one finite value to the next, so that a long line stays short."""
    good = values[np.isfinite(values)]
    span = float(good.max() - good.min()) if len(good) else 0.0
    q = 10.0 ** (math.floor(math.log10(span)) - _DIGITS + 1) if span > 0 else 1e-3
    whole = np.round(good / q).astype(np.int64)
    steps: list[int | None] = [None] * len(values)
    for at, step in zip(np.flatnonzero(np.isfinite(values)), np.diff(whole, prepend=0), strict=True):
        steps[at] = int(step)
    return {"q": q, "v": steps}
