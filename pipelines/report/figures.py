"""The figures. Each takes data and returns a figure; none computes a result."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go

from pipelines.report.extracts import Frequency, LeftOut
from pipelines.report.layout import Scale
from pipelines.report.words import (
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

_FONT = "system-ui, -apple-system, 'Segoe UI', 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
_GRID, _MUTED = "#e4e8ec", "#5a6572"
_BLUES = [[0.0, "#084d7d"], [0.35, "#3d8bbd"], [0.7, "#a9cde3"], [1.0, "#f3f5f7"]]
_GREENS = [[0.0, "#ffffff"], [0.3, "#c9e6db"], [0.7, "#56ab8f"], [1.0, GREEN]]


def heat_map(best: pd.DataFrame, top_um: float, digits: int, simulated: bool) -> go.Figure:
    """Selector × family, best number of points of each pair.

    Args:
        best: selector, family, n_tsp, S_mean_um, S_std_um; the first rows are the best.
        top_um: where the colours end (no model).
    """
    families, selectors = list(dict.fromkeys(best["family"])), list(dict.fromkeys(best["selector"]))
    at = {(r.family, r.selector): r for r in best.itertuples()}
    rows = [[at.get((f, s)) for s in selectors] for f in families]
    low = math.log10(max(float(best["S_mean_um"].min()), 1e-3))
    high = max(math.log10(max(min(float(best["S_mean_um"].max()), top_um), 1e-3)), low + 0.1)
    ticks = Scale(10**low / 1.001, 10**high * 1.001).ticks
    values = [float(label) for _, label in ticks]
    figure = go.Figure(
        go.Heatmap(
            x=[selector_label(s).replace(" ", "<br>", 1) for s in selectors],
            y=[plain(family_label(f, short=True)) for f in families],
            z=[[math.log10(max(r.S_mean_um, 1e-3)) if r else None for r in row] for row in rows],
            text=[[f"{number(r.S_mean_um, digits)}<br>n = {r.n_tsp}" if r else "" for r in row] for row in rows],
            customdata=[[_heat_words(r, digits) if r else "not tried" for r in row] for row in rows],
            texttemplate="%{text}",
            hovertemplate="%{customdata}<extra></extra>",
            textfont={"size": 12},
            colorscale=_BLUES,
            zmin=low,
            zmax=high,
            xgap=2,
            ygap=2,
            colorbar={
                "title": {"text": "S_mean, µm", "side": "right"},
                "tickvals": [math.log10(v) for v in values],
                "ticktext": [f"{v:g}" for v in values],
                "thickness": 10,
                "outlinewidth": 0,
                "len": 0.9,
            },
        )
    )
    _dress(figure, 44 * len(families) + 90, simulated, below=True)
    figure.update_xaxes(side="top", showgrid=False, tickangle=0, fixedrange=True, ticks="")
    figure.update_yaxes(autorange="reversed", showgrid=False, fixedrange=True, ticks="", automargin=True)
    return figure


def _heat_words(row: Any, digits: int) -> str:
    words = f"{cell_label(row.selector, row.family, row.n_tsp)}<br>S_mean {number(row.S_mean_um, digits)} µm"
    return f"{words}, S_std {number(row.S_std_um, digits)} µm"


def against_points(
    lines: pd.DataFrame, flat: pd.DataFrame, column: str, title: str, chosen: str, simulated: bool
) -> go.Figure:
    """One score against the number of points, a line per family at its best selector.

    Args:
        lines: family, selector, n_tsp and `column` in µm.
        flat: families without inputs: a level each.
        chosen: the family of the promoted cell, drawn stronger.
    """
    figure = go.Figure()
    n_max = int(lines["n_tsp"].max()) if len(lines) else 1
    for row in flat.to_dict("records"):
        figure.add_scatter(
            x=[1, n_max],
            y=[row[column]] * 2,
            mode="lines",
            name=family_label(row["family"]),
            line={"color": _MUTED, "width": 1.2, "dash": flat_dash(row["family"])},
            hovertemplate=f"{family_label(row['family'])}: %{{y:.3g}} µm<extra></extra>",
        )
    for family, part in lines.groupby("family", sort=False):
        color, symbol = family_style(str(family))
        part = part.sort_values("n_tsp")
        figure.add_scatter(
            x=part["n_tsp"],
            y=part[column],
            mode="lines+markers",
            name=family_label(str(family)),
            line={"color": color, "width": 2.6 if family == chosen else 1.4},
            marker={"symbol": symbol, "size": 8 if family == chosen else 6},
            hovertemplate=f"{cell_label(part['selector'].iloc[0], str(family), -1).split(' on ')[0]}, "
            "%{x} points: %{y:.3g} µm<extra></extra>",
        )
    _dress(figure, 330, simulated)
    step = max(1, math.ceil(n_max / 12))
    figure.update_xaxes(title_text="number of points n", range=[0.6, n_max + 0.4], tick0=1, dtick=step)
    values = pd.concat([lines[column], flat[column]]).to_numpy(float)
    top = float(flat[column].max()) if len(flat) else math.inf
    scale = Scale.over(list(values), 1.2 * top)
    figure.update_yaxes(
        title_text=title,
        type="log",
        range=[math.log10(scale.low_um), math.log10(scale.high_um)],
        tickvals=[float(label) for _, label in scale.ticks],
        ticktext=[label for _, label in scale.ticks],
    )
    return figure


def flat_dash(family: str) -> str:
    """The dash of a level."""
    return {"zero": "dot", "mean_curve": "dash"}.get(family, "dashdot")


def point_frequency(found: Sequence[Frequency], most: int, simulated: bool) -> go.Figure:
    """How often each point was chosen (rows) per selector (columns), most often chosen first, at most `most` rows."""
    total: dict[str, float] = {}
    for f in found:
        for name, share in f.share.items():
            total[name] = total.get(name, 0.0) + share
    names = sorted(total, key=lambda n: (-total[n], n))[:most]
    z = [[f.share.get(n, 0.0) for f in found] for n in names]
    figure = go.Figure(
        go.Heatmap(
            x=[f"{selector_label(f.selector).replace(' ', '<br>', 1)}<br>n = {f.n_tsp}" for f in found],
            y=[plain(n) for n in names],
            z=z,
            text=[[percent(v) if v else "" for v in row] for row in z],
            texttemplate="%{text}",
            textfont={"size": 12},
            hovertemplate="%{y} in %{text} of the folds<extra></extra>",
            colorscale=_GREENS,
            zmin=0,
            zmax=1,
            showscale=False,
            xgap=2,
            ygap=2,
        )
    )
    _dress(figure, 26 * len(names) + 100, simulated, below=True)
    figure.update_xaxes(side="top", showgrid=False, fixedrange=True, tickangle=0, ticks="")
    figure.update_yaxes(autorange="reversed", showgrid=False, fixedrange=True, ticks="", automargin=True)
    return figure


def left_out(batch: LeftOut, target: str, residual_range_um: tuple[float, float], simulated: bool) -> go.Figure:
    """Recording and left-out prediction above, their difference below."""
    figure = go.Figure()
    figure.add_scatter(
        x=batch.time_h,
        y=batch.recorded_um,
        mode="lines",
        name="recorded",
        line={"color": INK, "width": 1.4},
        hovertemplate="recorded %{y:.1f} µm<extra></extra>",
    )
    figure.add_scatter(
        x=batch.time_h,
        y=batch.predicted_um,
        mode="lines",
        name="predicted",
        line={"color": BLUE, "width": 2.2},
        hovertemplate="predicted %{y:.1f} µm<extra></extra>",
    )
    figure.add_scatter(
        x=batch.time_h,
        y=batch.recorded_um - batch.predicted_um,
        mode="lines",
        name="residual",
        line={"color": ORANGE, "width": 1.4},
        yaxis="y2",
        hovertemplate="residual %{y:.1f} µm<extra></extra>",
    )
    _dress(figure, 340, simulated)
    figure.update_layout(
        xaxis={"title": {"text": "time since start, h"}, "anchor": "y2"},
        yaxis={"title": {"text": f"{plain(target)}, µm"}, "domain": [0.44, 1.0]},
        yaxis2={
            "title": {"text": "residual, µm"},
            "domain": [0.0, 0.34],
            "range": list(residual_range_um),
            "zeroline": True,
            "zerolinecolor": _MUTED,
            "zerolinewidth": 1,
            "anchor": "x",
        },
        hovermode="x unified",
    )
    _axes(figure)
    return figure


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
    x = [plain(b) for b in both["batch_id"]]
    figure = go.Figure()
    for old, new, name in zip(both["S_um_old"], both["S_um_new"], x, strict=True):
        figure.add_shape(type="line", x0=name, x1=name, y0=old, y1=new, line={"color": "#b5bec8", "width": 2})
    figure.add_scatter(
        x=x,
        y=both["S_um_old"],
        mode="markers",
        name="earlier",
        marker={"size": 8, "color": "white", "line": {"color": _MUTED, "width": 1.6}},
        hovertemplate="%{x}: earlier %{y:.2f} µm<extra></extra>",
    )
    figure.add_scatter(
        x=x,
        y=both["S_um_new"],
        mode="markers",
        name="newest",
        marker={"size": 8, "color": BLUE},
        hovertemplate="%{x}: newest %{y:.2f} µm<extra></extra>",
    )
    _dress(figure, 330, simulated)
    figure.update_xaxes(type="category", tickangle=-60, tickfont={"size": 10}, automargin=True)
    figure.update_yaxes(title_text="S on the left-out batch, µm", rangemode="tozero")
    return figure


def _dress(figure: go.Figure, height: int, simulated: bool, below: bool = False) -> None:
    figure.update_layout(
        template=None,
        height=height,
        autosize=True,
        margin={"l": 62, "r": 12, "t": 22, "b": 46},
        font={"family": _FONT, "size": 12, "color": INK},
        paper_bgcolor="white",
        plot_bgcolor="white",
        showlegend=False,
        hoverlabel={"bgcolor": "white", "font": {"family": _FONT, "size": 12}},
    )
    _axes(figure)
    if simulated:
        figure.add_annotation(
            text="SIMULATED",
            xref="paper",
            yref="paper",
            x=1,
            y=0 if below else 1,
            xanchor="right",
            yanchor="top" if below else "bottom",
            showarrow=False,
            yshift=-4 if below else 4,
            font={"size": 10, "color": ORANGE},
        )


def _axes(figure: go.Figure) -> None:
    look = {
        "gridcolor": _GRID,
        "zeroline": False,
        "ticks": "outside",
        "ticklen": 4,
        "tickcolor": "#b5bec8",
        "linecolor": "#b5bec8",
        "title_standoff": 8,
    }
    figure.update_xaxes(**look)
    figure.update_yaxes(**look)
    figure.update_layout(yaxis2={"zeroline": True}) if "yaxis2" in figure.layout else None
