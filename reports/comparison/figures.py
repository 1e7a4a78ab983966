"""The figures of the comparison report. Each takes data and returns a figure; none computes a result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from matplotlib import colormaps
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from data.sweeps import sweep_numbers
from reports.comparison.tables import Frequency, LeftOut
from reports.labels import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    cell_label,
    family_label,
    family_style,
    number,
    percent,
    plain,
    selector_label,
)
from reports.layout import Key, Panel, Plot, Scale

_FONT = "system-ui, -apple-system, 'Segoe UI', 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
_GRID, _RULE, _MUTED = "#e4e8ec", "#b5bec8", "#5a6572"
_BLUES = [[0.0, "#0b5a8f"], [0.45, "#6fabd0"], [1.0, "#f1f4f6"]]
_GREENS = [[0.0, "#ffffff"], [0.5, "#8ecab4"], [1.0, GREEN]]
_DASHES = {"zero": "dot", "mean_curve": "dash"}


def heat_map(best: pd.DataFrame, top_um: float, digits: int, simulated: bool) -> go.Figure:
    """Selector × family, the best number of points of each pair; the colour is the logarithm of S_mean.

    Args:
        best: selector, family, n_tsp, S_mean_um, S_std_um; the order of appearance is the order shown.
        top_um: where the colours end (no model).
    """
    rows = best.to_dict("records")
    x = [selector_label(str(r["selector"])).replace(" ", "<br>", 1) for r in rows]
    y = [plain(family_label(str(r["family"]))) for r in rows]
    z = np.log10(np.maximum(best["S_mean_um"].to_numpy(float), 1e-3))
    low = float(z.min())
    high = max(min(float(z.max()), math.log10(max(top_um, 1e-3))), low + 0.1)
    ticks = [float(label) for _, label in Scale(10**low / 1.001, 10**high * 1.001).ticks]
    bar = {"title": {"text": "S_mean, µm", "side": "right"}, "tickvals": [math.log10(v) for v in ticks],
           "ticktext": [f"{v:g}" for v in ticks], "thickness": 10, "outlinewidth": 0, "len": 1.0}  # fmt: skip
    colored = {"type": "heatmap", "x": x, "y": y, "z": z, "colorscale": _BLUES, "zmin": low, "zmax": high,
               "colorbar": bar, "customdata": [_heat_label(r, digits) for r in rows],
               "hovertemplate": "%{customdata}<extra></extra>"}  # fmt: skip
    text = [f"{number(r['S_mean_um'], digits)}<br>n = {r['n_tsp']}" for r in rows]
    dark = (z - low) / (high - low) < 0.3
    return _matrix(colored, text, dark, 44 * len(set(y)) + 84, 52, simulated)


def _heat_label(row: dict[Any, Any], digits: int) -> str:
    texts = f"{cell_label(row['selector'], row['family'], row['n_tsp'])}<br>S_mean {number(row['S_mean_um'], digits)}"
    return f"{texts} µm, S_std {number(row['S_std_um'], digits)} µm"


def point_frequency(found: Sequence[Frequency], most: int, simulated: bool) -> go.Figure:
    """How often each point was chosen (rows) per selector (columns), most often chosen first, at most `most` rows."""
    total: dict[str, float] = {}
    for f in found:
        for name, share in f.share.items():
            total[name] = total.get(name, 0.0) + share
    names = sorted(total, key=lambda n: (-total[n], n))[:most]
    x = [f"{selector_label(f.selector).replace(' ', '<br>', 1)}<br>n = {f.n_tsp}" for _ in names for f in found]
    y = [plain(n) for n in names for _ in found]
    z = np.array([f.share.get(n, 0.0) for n in names for f in found])
    text = [percent(v) if v else "" for v in z]
    colored = {"type": "heatmap", "x": x, "y": y, "z": z, "colorscale": _GREENS, "zmin": 0, "zmax": 1,
               "showscale": False, "customdata": [percent(v) for v in z],
               "hovertemplate": "%{y}: %{customdata} of the folds<extra></extra>"}  # fmt: skip
    return _matrix(colored, text, z > 0.75, 27 * len(names) + 100, 68, simulated)


def _matrix(colored: dict[str, Any], text: list[str], dark: Any, height: int, top: int, simulated: bool) -> go.Figure:
    """A heat map with text in its cells, white on dark ones."""
    texts = {"type": "scatter", "mode": "text", "x": colored["x"], "y": colored["y"], "text": text, "hoverinfo": "skip",
             "textfont": {"size": 12, "color": ["#ffffff" if d else INK for d in dark]}}  # fmt: skip
    still = {"showgrid": False, "fixedrange": True, "ticks": "", "showline": False, "type": "category"}
    layout = base_layout(height, simulated, below=True, top=top)
    layout["xaxis"] |= {**still, "side": "top", "tickangle": 0}
    layout["yaxis"] |= {**still, "autorange": "reversed", "automargin": True}
    layout["margin"] |= {"l": 20, "b": 28}
    return go.Figure({"data": [{**colored, "xgap": 2, "ygap": 2}, texts], "layout": layout})


def against_points(
    lines: pd.DataFrame, flat: pd.DataFrame, column: str, title: str, chosen: str, simulated: bool
) -> go.Figure:
    """One score against the number of points, a line per family at its best selector.

    Args:
        lines: family, selector, n_tsp and `column` in µm.
        flat: families without inputs: a level each.
        chosen: the family of the promoted cell, drawn stronger.
    """
    n_max = int(lines["n_tsp"].max()) if len(lines) else 1
    data: list[dict[str, Any]] = []
    for row in flat.to_dict("records"):
        family = str(row["family"])
        data.append({
            "type": "scatter", "mode": "lines", "x": [1, n_max], "y": [row[column]] * 2, "name": family_label(family),
            "line": {"color": _MUTED, "width": 1.3, "dash": flat_dash(family)},
            "hovertemplate": f"{family_label(family)}: %{{y:.3g}} µm<extra></extra>",
        })  # fmt: skip
    for key, part in lines.groupby("family", sort=False):
        family, part = str(key), part.sort_values("n_tsp")
        color, symbol = family_style(family)
        label = f"{family_label(family)}, {selector_label(str(part['selector'].iloc[0]))}"
        strong = family == chosen
        data.append({
            "type": "scatter", "mode": "lines+markers", "x": part["n_tsp"], "y": part[column], "name": label,
            "line": {"color": color, "width": 2.8 if strong else 1.4},
            "marker": {"symbol": symbol, "size": 9 if strong else 6, "color": color},
            "hovertemplate": f"{label}, %{{x}} points: %{{y:.3g}} µm<extra></extra>",
        })  # fmt: skip
    layout = base_layout(330, simulated)
    layout["xaxis"] |= {"title": {"text": "number of points n"}, "range": [0.6, n_max + 0.4], "tick0": 1,
                        "dtick": max(1, math.ceil(n_max / 12))}  # fmt: skip
    top = float(flat[column].max()) if len(flat) else math.inf
    layout["yaxis"] |= _log_axis(Scale.over([*lines[column], *flat[column]], 1.2 * top), title)
    return go.Figure({"data": data, "layout": layout})


def _log_axis(scale: Scale, title: str) -> dict[str, Any]:
    values = [float(label) for _, label in scale.ticks]
    return {"title": {"text": title}, "type": "log", "range": [math.log10(scale.low_um), math.log10(scale.high_um)],
            "tickvals": values, "ticktext": [f"{v:g}" for v in values]}  # fmt: skip


def flat_dash(family: str) -> str:
    """The dash of a level."""
    return _DASHES.get(family, "dashdot")


def left_out(batch: LeftOut, target: str, residual_range_um: tuple[float, float], simulated: bool) -> go.Figure:
    """Recording and left-out prediction above, their difference below."""
    residual_um = batch.recorded_um - batch.predicted_um
    lines = [
        ("recorded", batch.recorded_um, INK, 1.3, "y"),
        ("predicted", batch.predicted_um, BLUE, 2.2, "y"),
        ("residual", residual_um, ORANGE, 1.3, "y2"),
    ]
    if batch.position_mm is not None:  # readings along an axis: points, the recorded ones on top
        lines = [lines[1], lines[0], lines[2]]
    mode = "lines" if batch.position_mm is None else "markers"
    data = [
        {"type": "scatter", "mode": mode, "x": batch.time_h, "y": y, "name": name, "yaxis": axis,
         "line": {"color": color, "width": width}, "marker": {"color": color, "size": 3 * width},
         "hovertemplate": f"{name} %{{y:.1f}} µm<extra></extra>"}
        for name, y, color, width, axis in lines
    ]  # fmt: skip
    layout = base_layout(350, simulated)
    layout["xaxis"] |= {"title": {"text": "time since start, h"}, "anchor": "y2"}
    layout["yaxis2"] = dict(layout["yaxis"]) | {
        "title": {"text": "residual, µm"}, "domain": [0.0, 0.36], "range": list(residual_range_um), "nticks": 5,
        "zeroline": True, "zerolinecolor": _MUTED, "zerolinewidth": 1, "anchor": "x",
    }  # fmt: skip
    layout["yaxis"] |= {"title": {"text": f"{plain(target)}, µm"}, "domain": [0.44, 1.0]}
    return go.Figure({"data": data, "layout": {**layout, "hovermode": "x"}})


def residual_range_um(batches: Sequence[LeftOut]) -> tuple[float, float]:
    """One symmetric range for the residuals of all shown batches."""
    values = [np.abs(b.recorded_um - b.predicted_um) for b in batches]
    finite = [float(np.nanmax(v)) for v in values if np.isfinite(v).any()]
    top = 1.08 * max(finite, default=1.0) or 1.0
    return -top, top


def before_and_after(both: pd.DataFrame, simulated: bool) -> go.Figure:
    """S of every shared batch in the earlier and the newest training.

    Args:
        both: batch_id, S_um_old, S_um_new in the batches' order.
    """
    x = [plain(str(b)) for b in both["batch_id"]]
    old, new = both["S_um_old"].to_numpy(float), both["S_um_new"].to_numpy(float)
    ring = {"size": 9, "color": "white", "line": {"color": _MUTED, "width": 1.6}}
    markers = [("earlier", old, ring), ("newest", new, {"size": 9, "color": BLUE})]
    data: list[dict[str, Any]] = [
        {"type": "scatter", "mode": "lines", "x": np.repeat(x, 3), "hoverinfo": "skip", "connectgaps": False,
         "y": np.column_stack([old, new, np.full(len(x), np.nan)]).ravel(), "line": {"color": _RULE, "width": 2}}
    ]  # fmt: skip
    data += [
        {"type": "scatter", "mode": "markers", "x": x, "y": y, "name": name, "marker": marker,
         "hovertemplate": f"%{{x}}: {name} %{{y:.2f}} µm<extra></extra>"}
        for name, y, marker in markers
    ]  # fmt: skip
    layout = base_layout(340, simulated)
    layout["xaxis"] |= {"type": "category", "tickangle": -60, "tickfont": {"size": 10}, "automargin": True}
    layout["yaxis"] |= {"title": {"text": "S on the left-out batch, µm"}, "rangemode": "tozero"}
    return go.Figure({"data": data, "layout": layout})


def base_layout(height: int, simulated: bool, below: bool = False, top: int = 22) -> dict[str, Any]:
    """The look that all figures share; simulated data are called so inside the picture."""
    axis = {"gridcolor": _GRID, "zeroline": False, "ticks": "outside", "ticklen": 4, "tickcolor": _RULE,
            "showline": True, "linecolor": _RULE}  # fmt: skip
    label = {"text": "SIMULATED", "xref": "paper", "yref": "paper", "showarrow": False,
             "font": {"size": 10, "color": ORANGE}, "x": 1 if below else 0, "xanchor": "right" if below else "left",
             "y": 0 if below else 1, "yanchor": "top" if below else "bottom", "yshift": -4 if below else 3}  # fmt: skip
    return {
        "template": None,
        "height": height,
        "autosize": True,
        "margin": {"l": 58, "r": 14, "t": top, "b": 46},
        "font": {"family": _FONT, "size": 12, "color": INK},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "showlegend": False,
        "hoverlabel": {"bgcolor": "white", "font": {"family": _FONT, "size": 12}},
        "xaxis": dict(axis),
        "yaxis": dict(axis),
        "annotations": [label] if simulated else [],
    }


_MOST_SWEEPS = 12
_MOST_KEYS = 6
_COLOURS = colormaps["plasma"]  # even to the eye and safe for the colour-blind
_LAST = 0.84  # of its range: the yellow behind it is unreadable on white
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
    """Readings and predicted lines of a batch's sweeps above, the residual below; colours run from 0 to `last_h`."""
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
    texts = [f"{h:.2g} h" for h in batch.time_h[rows]]
    colour = [_colour(h / last_h) for h in batch.time_h[rows]]
    for what, y, axis in (
        ("recorded", batch.recorded_um[rows], "y"),
        ("residual", (batch.recorded_um - batch.predicted_um)[rows], "y2"),
    ):
        data.append({
            "type": "scatter", "mode": "markers", "x": batch.position_mm[rows], "y": y, "yaxis": axis, "name": what,
            "marker": {"size": 6 if axis == "y" else 5, "color": colour, "line": {"color": "white", "width": 0.6}},
            "text": texts, "hovertemplate": f"%{{text}}, %{{x:.4g}} mm: {what} %{{y:.1f}} µm<extra></extra>",
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
