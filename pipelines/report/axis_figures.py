"""The fan of an axis: the error against the position, sweep after sweep, and the straight lines that were predicted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from matplotlib import colormaps
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from data.sweeps import sweep_numbers
from pipelines.report.extracts import LeftOut
from pipelines.report.figures import base_layout, residual_range_um
from pipelines.report.layout import Key, Panel, Plot
from pipelines.report.words import INK, number, plain

Array = NDArray[np.float64]
_MOST_SWEEPS = 12
_MOST_KEYS = 6
_COLOURS = colormaps["plasma"]  # even to the eye and safe for the colour-blind
_LAST = 0.84  # of its range: the yellow behind it is unreadable on white
_MUTED = "#5a6572"
_NICE_H = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 24.0)


def fan_panel(name: str, shown: Sequence[LeftOut], target: str, digits: int, simulated: bool) -> Panel | None:
    """Fans of the batches that are shown, with one scale of colours for the time; None for a channel without axis."""
    batches = [b for b in shown if b.position_mm is not None]
    if not batches:
        return None
    last_h = max(float(b.time_h.max(initial=0.0)) for b in batches) or 1.0
    limits = residual_range_um(batches)
    plots = tuple(
        Plot(
            fan(b, target, last_h, limits, simulated),
            f"{b.place}: {b.batch_id}, S = {number(b.S_um, digits)} µm",
            "third",
        )
        for b in batches
    )
    step_h = next((h for h in _NICE_H if last_h / h <= _MOST_KEYS), _NICE_H[-1])
    hours = np.arange(0.0, last_h + 1e-9, step_h)
    keys = [Key("recorded", INK, "disc"), Key("predicted, batch left out", INK)]
    keys += [Key(f"{h:g} h", _colour(h / last_h), "disc") for h in hours]
    notes = [
        "The error less that of the batch's first sweep, which is the line at zero. Colours: time since the start."
    ]
    most = max(len(_sweeps(b)) for b in batches)
    if most > _MOST_SWEEPS:
        notes.append(f"Drawn: {_MOST_SWEEPS} of up to {most} sweeps.")
    return Panel(f"{name}: error against position, sweep after sweep", plots, simulated, tuple(keys), tuple(notes))


def fan(batch: LeftOut, target: str, last_h: float, residual_range: tuple[float, float], simulated: bool) -> go.Figure:
    """Readings and predicted lines of a batch's sweeps above, what is left below; colours run from 0 to `last_h`."""
    assert batch.position_mm is not None
    sweeps = _sweeps(batch)
    picked = (
        [sweeps[i] for i in np.unique(np.linspace(0, len(sweeps) - 1, _MOST_SWEEPS).round().astype(int))]
        if sweeps
        else []
    )
    data = []
    for rows in picked:
        at_mm, hour = batch.position_mm[rows], float(batch.time_h[rows].mean())
        order = np.argsort(at_mm, kind="stable")
        data.append({
            "type": "scatter", "mode": "lines", "x": at_mm[order], "y": batch.predicted_um[rows][order],
            "name": "predicted", "line": {"color": _colour(hour / last_h), "width": 1.6},
            "hovertemplate": f"{hour:.2g} h, %{{x:.4g}} mm: predicted %{{y:.1f}} µm<extra></extra>",
        })  # fmt: skip
    rows = np.concatenate([np.zeros(0, int), *picked])
    words = [f"{h:.2g} h" for h in batch.time_h[rows]]
    colour = [_colour(h / last_h) for h in batch.time_h[rows]]
    for what, y, axis in (
        ("recorded", batch.recorded_um[rows], "y"),
        ("residual", (batch.recorded_um - batch.predicted_um)[rows], "y2"),
    ):
        data.append({
            "type": "scatter", "mode": "markers", "x": batch.position_mm[rows], "y": y, "yaxis": axis, "name": what,
            "marker": {"size": 6 if axis == "y" else 5, "color": colour, "line": {"color": "white", "width": 0.6}},
            "text": words, "hovertemplate": f"%{{text}}, %{{x:.4g}} mm: {what} %{{y:.1f}} µm<extra></extra>",
        })  # fmt: skip
    layout = base_layout(400, simulated)
    layout["xaxis"] |= {"title": {"text": "position, mm"}, "anchor": "y2"}
    zero = {"zeroline": True, "zerolinecolor": _MUTED, "zerolinewidth": 1}
    layout["yaxis2"] = dict(layout["yaxis"]) | zero | {
        "title": {"text": "residual, µm"}, "domain": [0.0, 0.28], "range": list(residual_range), "nticks": 5,
        "anchor": "x",
    }  # fmt: skip
    layout["yaxis"] |= zero | {"title": {"text": f"{plain(target)}, µm"}, "domain": [0.36, 1.0]}
    return go.Figure({"data": data, "layout": {**layout, "hovermode": "closest"}})


def _sweeps(batch: LeftOut) -> list[NDArray[np.int64]]:
    """Rows of every sweep behind the first, which is zero."""
    assert batch.position_mm is not None
    number_of = sweep_numbers(batch.time_h * 3600.0, batch.position_mm)
    return [np.flatnonzero(number_of == k) for k in range(1, int(number_of.max(initial=0)) + 1)]


def _colour(share: float) -> str:
    return to_hex(_COLOURS(_LAST * min(max(share, 0.0), 1.0)))
