"""How far from its training a model may be trusted: the measured rise of its error with the distance."""

from __future__ import annotations

import numpy as np
import pandas as pd
import plotly.graph_objects as go

from models.trust import EDGES, Rise
from pipelines.report.figures import base_layout
from pipelines.report.layout import Column, Key, Panel, Plot, Row, Table
from pipelines.report.words import BLUE, GREEN, INK, ORANGE, number, plain

_MARKERS = {
    "leave-season-out": ("season left out", BLUE, "circle"),
    "leave-speed-out": ("speed left out", ORANGE, "square"),
    "train-on-one": ("trained on one batch", "#b5bec8", "diamond"),
}
_TIMES = {0.25: "¼", 0.5: "½", 1: "1", 2: "2", 4: "4", 8: "8", 16: "16", 32: "32"}


def rise_panel(name: str, distances: pd.DataFrame, simulated: bool) -> Panel | None:
    """Every left-out batch by its distance, S against S predicted by its neighbours; None where nobody measured it."""
    if distances.empty or not len(factors := _factors(distances)):
        return None
    rise = Rise.of(distances)
    shown = [p for p in _MARKERS if (factors["protocol"] == p).any()]
    figure = rise_figure(factors, rise, shown, simulated)
    keys = [Key(_MARKERS[p][0], _MARKERS[p][1], _MARKERS[p][2]) for p in shown]
    if rise.edge:
        keys.append(Key("median of a band (seasons and speeds left out)", INK))
    notes = (
        "Distance 1 is as far outside the trained range as that range is wide (at least 5 K, 1000 rpm or 1000 mm/min), "
        "in the quantity that is farthest out. Factor 1 is the error that the same batch has when its neighbours are "
        "in the training. A model of one batch is far from all others and knows little: it is shown, not counted.",
    )
    return Panel(f"{name}: how the error rises with the distance from the training", (Plot(figure, name),),
                 simulated, tuple(keys), notes)  # fmt: skip


def rise_table(name: str, distances: pd.DataFrame, digits: int, simulated: bool) -> Table | None:
    """The bands of distance: batches, factor, expected S."""
    if distances.empty or not (rise := Rise.of(distances)).edge:
        return None
    rows = []
    for edge, count, factor, high in zip(rise.edge, rise.count, rise.factor, rise.high, strict=True):
        inner = [e for e in EDGES if e < edge]
        words = "inside" if not inner else f"{inner[-1]:g} to {edge:g}" if np.isfinite(edge) else f"above {inner[-1]:g}"
        expected = float(rise.expected_um(np.array([inner[-1] * 1.0001 if inner else 0.0]))[0])
        rows.append(Row((words, str(count), number(factor, 2), number(high, 2), number(expected, digits))))
    far = distances[
        distances["protocol"].isin(("leave-season-out", "leave-speed-out")) & (distances["distance"] > 0.05)
    ]
    common = far["farthest"].value_counts()
    notes = [f"Inside, by leave-batch-out, S is {number(rise.inside_um, digits)} µm in the median."]
    if len(common):
        notes.append("Farthest out most often: " + ", ".join(f"{q} ({n})" for q, n in common.head(3).items()) + ".")
    columns = (
        Column("distance", "trained widths"),
        Column("left-out batches", "", "number"),
        Column("error grows", "times", "number"),
        Column("one in ten more than", "times", "number"),
        Column("S to expect", "µm", "number"),
    )
    return Table(
        f"{name}: error to expect outside the trained region", columns, tuple(rows), simulated, None, tuple(notes)
    )


def rise_figure(factors: pd.DataFrame, rise: Rise, shown: list[str], simulated: bool) -> go.Figure:
    """A marker per left-out batch, factor over distance (both logarithmic, the inside at the left edge).

    Args:
        factors: protocol, batch_id, distance, farthest, factor.
    """
    data = []
    for protocol in reversed(shown):
        own = factors[factors["protocol"] == protocol]
        words, color, symbol = _MARKERS[protocol]
        data.append({
            "type": "scatter", "mode": "markers", "x": _at(own["distance"].to_numpy(float)),
            "y": own["factor"].to_numpy(float), "name": words,
            "marker": {"color": color, "symbol": symbol, "size": 7,
                       "opacity": 0.45 if protocol == "train-on-one" else 0.85},
            "customdata": [f"{plain(b)}: {d:.2f} widths{f' in {plain(q)}' if q else ''}" for b, d, q in
                           zip(own["batch_id"], own["distance"], own["farthest"], strict=True)],
            "hovertemplate": "%{customdata}<br>%{y:.2f} times<extra></extra>",
        })  # fmt: skip
    low = [0.0, *EDGES]
    for edge, factor in zip(rise.edge, rise.factor, strict=True):
        start = max(low[low.index(edge) - 1], 0.0)
        ends = _at(np.array([start * 1.001 if start else 0.0, min(edge, 8.0)]))
        data.append({"type": "scatter", "mode": "lines", "x": ends, "y": [factor, factor], "hoverinfo": "skip",
                     "line": {"color": INK, "width": 3}})  # fmt: skip
    layout = base_layout(360, simulated)
    ticks = [0.05, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0]
    layout["xaxis"] |= {"title": {"text": "distance from the training, trained widths"}, "type": "log",
                        "tickvals": [0.03, *ticks], "ticktext": ["inside", *(f"{t:g}" for t in ticks)]}  # fmt: skip
    layout["yaxis"] |= {"title": {"text": "S, times its S by leave-batch-out"}, "type": "log",
                        "tickvals": list(_TIMES), "ticktext": list(_TIMES.values())}  # fmt: skip
    layout["shapes"] = [{"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": 1, "y1": 1,
                         "line": {"color": GREEN, "width": 1, "dash": "dot"}}]  # fmt: skip
    return go.Figure({"data": data, "layout": layout})


def _factors(distances: pd.DataFrame) -> pd.DataFrame:
    near = distances[distances["protocol"] == "leave-batch-out"].set_index("batch_id")["S_um"]
    far = distances[distances["protocol"].isin(_MARKERS)]
    far = far.assign(factor=far["S_um"].to_numpy(float) / far["batch_id"].map(near).to_numpy(float))
    return far[np.isfinite(far["factor"]) & np.isfinite(far["distance"])]


def _at(distance: np.ndarray) -> np.ndarray:
    """Where a distance stands on the logarithmic axis: all that is inside at its left edge."""
    return np.maximum(distance, 0.03)
