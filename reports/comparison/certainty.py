"""Certainty of the models: stated intervals, errors outside the trained region, weaknesses of the selectors."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import plotly.graph_objects as go

from models.promotion import Choice
from models.result import CELL_KEYS, GridResult
from models.trust import EDGES, Rise
from reports.comparison.figures import base_layout
from reports.comparison.tables import S_by_batch, best_per
from reports.labels import (
    BLUE,
    GREEN,
    INK,
    NOTHING,
    ORANGE,
    family_label,
    number,
    percent,
    plain,
    plus_minus,
    selector_label,
)
from reports.layout import Column, Key, Panel, Plot, Row, Table

_MEANT, _TOLERATED = 0.90, 0.05
_BEYOND_CHANCE = 1.6449  # standard errors of a mean over batches
_SEASON = "leave-season-out"


def certainty_table(
    name: str, result: GridResult, cells: pd.DataFrame, choice: Choice, digits: int, mark: str = "chosen"
) -> Table | None:
    """A row for the best cell of every family that states a standard deviation, and for the promoted one.

    Args:
        cells: one protocol's cells from `scored`.

    Returns:
        None where no family states one.
    """
    stated = cells[np.isfinite(cells["coverage90"])] if "coverage90" in cells else cells.iloc[:0]
    if stated.empty:
        return None
    promoted = [choice.selector, choice.family, choice.n_tsp]
    own = stated[(stated[["selector", "family", "n_tsp"]] == promoted).all(axis=1)]
    rows = pd.concat([best_per(stated, "family"), own]).drop_duplicates(CELL_KEYS)
    rows = rows.sort_values("score_um", kind="stable").reset_index(drop=True)
    seasons = _inside_of_seasons(result, rows)
    columns = [
        Column("family"),
        Column("selector"),
        Column("points", "n", "number"),
        Column("stated sd", "µm", "number"),
        Column("S_mean", "µm", "number"),
        Column("inside the 90 % interval", "mean ± std of batches", "number", "inside"),
        Column("season left out", "", "number", "season"),
        Column("it is"),
    ]
    columns = [c for c in columns if c.key != "season" or any(map(math.isfinite, seasons))]
    body = []
    for row, batches, season in zip(rows.to_dict("records"), S_by_batch(result, rows), seasons, strict=True):
        inside = batches["coverage90"].dropna().to_numpy(float)
        mean = float(np.mean(inside)) if len(inside) else math.nan
        spread = float(np.std(inside, ddof=1)) if len(inside) > 1 else math.nan
        shown = {
            "family": family_label(row["family"]),
            "selector": selector_label(row["selector"]) if row["n_tsp"] else NOTHING,
            "points": str(row["n_tsp"]) if row["n_tsp"] else NOTHING,
            "stated sd": number(row["sd_um"], digits),
            "S_mean": number(row["S_mean_um"], digits),
            "inside": f"{plus_minus(100 * mean, 100 * spread, 0)} %",
            "season": percent(season),
            "it is": verdict(mean, spread, len(inside), season),
        }
        promoted_row = [row[k] for k in ("selector", "family", "n_tsp")] == promoted
        body.append(Row(tuple(shown[c.key] for c in columns), mark if promoted_row else ""))
    notes = (
        "Prediction ± 1.645 stated standard deviations should hold nine tenths of the samples of a batch that the "
        "model never saw. The samples of a batch go astray together, so single batches differ widely.",
    )
    return Table(
        f"{name}: how sure the models say they are", tuple(columns), tuple(body), result.simulated, None, notes
    )


def verdict(mean: float, spread: float, n_batches: int, season: float = math.nan) -> str:
    """A verdict on a mean share inside the 90 % interval, with its spread over batches.

    Within five per cent of nine tenths it is honest; beyond that "perhaps", unless the mean lies further off than
    chance would put it (one-sided 95 % of a mean over batches). `season`: the share where whole seasons are left out.
    """
    if not math.isfinite(mean):
        return NOTHING
    if abs(mean - _MEANT) <= _TOLERATED:
        return "honest, but too sure of a new season" if season < _MEANT - _TOLERATED else "honest"
    label = "too sure" if mean < _MEANT else "too careful"
    if math.isfinite(spread) and abs(mean - _MEANT) > _BEYOND_CHANCE * spread / math.sqrt(n_batches):
        return label
    return f"perhaps {label}"


def _inside_of_seasons(result: GridResult, rows: pd.DataFrame) -> list[float]:
    """Share inside for the same cells where whole seasons are left out; NaN where that was not run."""
    cells = result.cells[result.cells["protocol"] == _SEASON]
    if rows["protocol"].iloc[0] == _SEASON or cells.empty:
        return [math.nan] * len(rows)
    joined = rows[CELL_KEYS[1:]].merge(cells[[*CELL_KEYS[1:], "coverage90"]], on=CELL_KEYS[1:], how="left")
    return [float(v) for v in joined["coverage90"]]


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
        label = "inside" if not inner else f"{inner[-1]:g} to {edge:g}" if np.isfinite(edge) else f"above {inner[-1]:g}"
        expected = float(rise.expected_um(np.array([inner[-1] * 1.0001 if inner else 0.0]))[0])
        rows.append(Row.of(label, str(count), number(factor, 2), number(high, 2), number(expected, digits)))
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
        label, color, symbol = _MARKERS[protocol]
        data.append({
            "type": "scatter", "mode": "markers", "x": _at(own["distance"].to_numpy(float)),
            "y": own["factor"].to_numpy(float), "name": label,
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


_STABILITY = "stability over batches"
MEANINGS = {
    "largest |corr| among the chosen": "two chosen points carry the same information",
    "chaining in the largest cluster": "sensors share a cluster only over others",
    "share of inputs in the largest cluster": "nearly all sensors in one cluster",
    "gap of the smallest eigenvalues": "a step of the elimination was chance",
    "spread of the sensitivity over starts": "weights of the nets are chance",
    "first of a group changes": "another start ranks a group otherwise",
    "clusters without a member": "clusters fell together",
    "selection frequency at the cut": "the last point is picked rarely",
    "largest VIF left": "chosen points repeat each other",
    "mean silhouette": "sensors do not fall into so many groups",
    "gap to the runner-up": "another set is as good",
    "inputs": "too many sensors to try all sets",
}


def diagnostics_table(name: str, result: GridResult) -> Table | None:
    """Per selector its stability and a row for every weakness of its own; None where nothing was measured.

    A row is marked where its own value or the selector's stability is beyond the limit.
    """
    found = result.selector_diagnostics
    if found.empty:
        return None
    rows = [row for _, own in found.groupby("selector", sort=False) for row in _rows(own)]
    columns = (
        Column("selector"),
        Column("points", "n", "number"),
        Column("stability", "", "number"),
        Column("what may go wrong", "", "wide"),
        Column("value", "", "number"),
        Column("usual limit"),
        Column("here", "", "wide"),
    )
    note = (
        "Each selector on all batches, at the number of points of its best cell short of all. Stability: mean Jaccard "
        "similarity of the folds' choices. A marked row is a warning: the points may be right, yet another recording "
        "could change them."
    )
    return Table(f"{name}: known weaknesses of the selectors", columns, tuple(rows), result.simulated, None, (note,))


def _rows(own: pd.DataFrame) -> list[Row]:
    """Of one selector: its weaknesses, each with its stability."""
    stability, others = own[own["statistic"] == _STABILITY], own[own["statistic"] != _STABILITY]
    stable = number(float(stability["value"].iloc[0]), 2) if len(stability) else NOTHING
    first = (selector_label(own["selector"].iloc[0]), str(own["n_tsp"].iloc[0]), stable)
    unstable = not stability["ok"].all()
    if others.empty:
        return [
            Row.of(
                *first, "no measure of its own", NOTHING, NOTHING, stability["comment"].iloc[0], mark=_mark(unstable)
            )
        ]
    rows = []
    for statistic, value, limit, ok, comment in zip(
        others["statistic"], others["value"], others["threshold"], others["ok"], others["comment"], strict=True
    ):
        label = f"{MEANINGS[statistic]}: {statistic}" if statistic in MEANINGS else statistic
        side = "at most" if ok == (value <= limit) else "at least"
        cells = (*first, label, number(value, 2), f"{side} {number(limit, 2)}", comment)
        rows.append(Row(cells, _mark(unstable or not ok)))
    return rows


def _mark(warns: bool) -> str:
    return "look" if warns else ""
