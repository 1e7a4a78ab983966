"""Extracts of a training's result, and the tables that a laboratory checks: families, groups, bounds, batches."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import pandas as pd

from data.arrays import Array
from models.protocols import PROTOCOLS
from models.selection.conformal import RunBound
from models.selection.promotion import KEYS, Choice
from models.selection.result import GridResult
from models.selection.trust import SLACK
from models.selection.updating import COUNTS
from reports.labels import NOTHING, cell_label, count, number, percent, plus_minus
from reports.layout import Column, Row, Table

MAIN_PROTOCOL = "leave-batch-out"
_MOST_POINTS = 400


@dataclass(frozen=True)
class LeftOut:
    """One batch's left-out prediction under a protocol, thinned for drawing; arrays (n,) with NaN where masked.

    Of a channel along an axis only the readings, with their positions, all of them.
    """

    protocol: str
    batch_id: str
    place: str  # median, worst; "" for all others
    S_um: float
    time_h: Array
    recorded_um: Array
    predicted_um: Array
    every: int  # every how many samples are shown
    position_mm: Array | None = None


def protocols_of(result: GridResult) -> list[str]:
    """The protocols that were run, forward first."""
    run = set(result.cells["protocol"])
    return [p for p in PROTOCOLS if p in run] + sorted(run - set(PROTOCOLS))


def scored(result: GridResult, protocol: str) -> pd.DataFrame:
    """The protocol's cells with a finite S_mean, the least first."""
    cells = result.cells[result.cells["protocol"] == protocol]
    order = ["S_mean_um", "n_inputs", "rank", "selector", "family"]
    return cells[np.isfinite(cells["S_mean_um"])].sort_values(order, kind="stable").reset_index(drop=True)


def best_per(cells: pd.DataFrame, *keys: str) -> pd.DataFrame:
    """First, so least, row of every combination of keys of a table from `scored`."""
    return cells.drop_duplicates(list(keys)).reset_index(drop=True)


def left_out_batches(result: GridResult, choice: Choice) -> list[LeftOut]:
    """Every left-out batch of a cell by S, the median and the worst by name; empty where no prediction was kept.

    Of the later runs, predicted forward in time, where the training kept them, else of all, left out one by one.
    """
    table, protocol, column = result.predictions, MAIN_PROTOCOL, choice.cell
    if len(result.curves) and (result.distances["cell"] == choice.cell).all():
        later = result.curves[result.curves["protocol"] == "forward"]
        table, protocol, column = (later, "forward", "predicted_um") if len(later) else (table, protocol, column)
    if column not in table.columns:
        return []
    rows = scores_of(result, choice.selector, choice.family, choice.n_tsp, protocol)
    rows = rows[np.isfinite(rows["S_um"])].sort_values("S_um", kind="stable")
    ids, values = list(rows["batch_id"]), list(rows["S_um"])
    places = {len(ids) - 1: "worst", (len(ids) - 1) // 2: "median"}
    return [_left_out(table, protocol, column, ids[i], places.get(i, ""), float(values[i])) for i in range(len(ids))]


def _left_out(table: pd.DataFrame, protocol: str, column: str, batch_id: str, place: str, S_um: float) -> LeftOut:
    rows = table[table["batch_id"] == batch_id]
    along_axis = "position_mm" in table.columns
    if along_axis:
        rows = rows[np.isfinite(rows["position_mm"]) & np.isfinite(rows["recorded_um"])]
    every = 1 if along_axis else max(1, -(-len(rows) // _MOST_POINTS))
    shown = rows.iloc[::every]
    return LeftOut(
        protocol,
        batch_id,
        place,
        S_um,
        shown["time_s"].to_numpy(float) / 3600.0,
        shown["recorded_um"].to_numpy(float),
        shown[column].to_numpy(float),
        every,
        shown["position_mm"].to_numpy(float) if along_axis else None,
    )


def scores_of(result: GridResult, selector: str, family: str, n_tsp: int, protocol: str = "") -> pd.DataFrame:
    """The scores of a cell, of one protocol or of all."""
    s = result.scores
    own = s[(s["selector"] == selector) & (s["family"] == family) & (s["n_tsp"] == n_tsp)]
    return own[own["protocol"] == protocol] if protocol else own


_STABLE = 0.7  # mean Jaccard similarity of the points that the folds choose
_MAX = "max\u00a0|e|"
_ROUNDS = {"families": 1, "points": 2, "runs": 3}  # of `models.selection.race`


def families(name: str, result: GridResult, choice: Choice, digits: int, mark: str = "chosen") -> Table:
    """A row per family: its best cell by the first protocol, of the chosen family the chosen one, under all protocols.

    Notes name the families that the race dropped.
    """
    protocols = protocols_of(result)
    cells = scored(result, protocols[0])
    own = (cells[KEYS] == [choice.selector, choice.family, choice.n_tsp]).all(axis=1)
    best = best_per(pd.concat([cells[own], cells]), "family").sort_values("S_mean_um", kind="stable")
    at = {tuple(r[k] for k in ("protocol", *KEYS)): r for r in result.cells.to_dict("records")}
    rows = []
    for r in best.to_dict("records"):
        under = [at.get((p, *(r[k] for k in KEYS))) for p in protocols]
        stable = number(r["tsp_stability"], 2) + (" †" if r["tsp_stability"] < _STABLE else "")
        rows.append(
            Row.of(
                cell_label(r["selector"], r["family"], r["n_tsp"]),
                *(NOTHING if u is None else plus_minus(u["S_mean_um"], u["S_std_um"], digits) for u in under),
                number(r["max_abs_um"], 1),
                number(r["fit_S_um"], digits),
                stable if r["n_tsp"] else NOTHING,
                mark=mark if r["family"] == choice.family else "",
            )
        )
    columns = (
        Column("cell"), *(Column(p, "S_mean ± S_std, µm", "number") for p in protocols), Column(_MAX, "µm", "number"),
        Column("fitted S", "µm", "number"), Column("stability", "of points", "number"),
    )  # fmt: skip
    notes = ["Numbers of different protocols are not comparable."]
    if any("†" in str(r.cells[-1]) for r in rows):
        notes.append(f"† The folds choose different points (stability below {_STABLE:g}): another run may move them.")
    notes += _dropped(result, set(best["family"]), digits)
    return Table(f"{name}: best cell of every family", columns, tuple(rows), notes=tuple(notes))


def _dropped(result: GridResult, known: set[str], digits: int) -> list[str]:
    """Of every other family in the race its best cell in the last round that it was in, and why it went no further."""
    if result.race.empty:
        return []
    race = result.race[~result.race["family"].isin(known)]
    race = race.assign(place=race["round"].map(_ROUNDS))
    order = race.sort_values(["place", "S_mean_um"], ascending=[False, True], kind="stable").drop_duplicates("family")
    notes = []
    for _, own in order.sort_values("S_mean_um", kind="stable").groupby(["place", "why", "n_runs"]):
        first = own.iloc[0]
        cells = (
            f"{cell_label(r['selector'], r['family'], r['n_tsp'])} {number(r['S_mean_um'], digits)} µm"
            for r in own.to_dict("records")
        )
        head = f"Dropped in round {first['place']} of the race, {first['why']}"
        notes.append(f"{head} (S_mean over {count(int(first['n_runs']), 'run')}): {', '.join(cells)}.")
    return notes


_GROUPS = {"season": "leave-season-out", "speed": "leave-speed-out"}


def groups(name: str, result: GridResult, choice: Choice, protocol: str, digits: int) -> Table | None:
    """Every season and speed: S of the model by a protocol, with the group left out, without a model; worst marked."""
    own = scores_of(result, choice.selector, choice.family, choice.n_tsp)
    nothing = scores_of(result, "none", "zero", 0)
    rows: list[tuple[float, Row]] = []
    for kind, group_protocol in _GROUPS.items():
        if kind not in result.batches or result.batches[kind].nunique() < 2:
            continue
        label = result.batches.set_index(result.batches["batch_id"].astype(str))[kind].astype(str)
        means = [
            _means(part, p, label)
            for part, p in ((own, protocol), (own, group_protocol), (nothing, MAIN_PROTOCOL))
        ]  # fmt: skip
        counts = label.value_counts()
        for group in sorted(counts.index, key=group_order):
            shown = [float(m.get(group, math.nan)) for m in means]
            worst = max((v for v in shown[:2] if math.isfinite(v)), default=math.nan)
            rows.append((worst, Row.of(f"{kind} {group}", str(counts[group]), *(number(v, digits) for v in shown))))
    if not rows:
        return None
    top = max((v for v, _ in rows if math.isfinite(v)), default=math.nan)
    columns = (
        Column("group"), Column("runs", "", "number"), Column(protocol, "µm", "number"),
        Column("whole group left out", "µm", "number"), Column("no model", "µm", "number"),
    )  # fmt: skip
    marked = tuple(Row(r.cells, "worst" if v == top else "") for v, r in rows)
    return Table(f"{name}: S_mean by season and speed", columns, marked)


def _means(scores: pd.DataFrame, protocol: str, label: pd.Series) -> pd.Series:
    own = scores[scores["protocol"] == protocol]
    return own["S_um"].groupby(own["batch_id"].astype(str).map(label)).mean()


def group_order(name: str) -> tuple[int, float, str]:
    """Seasons from cold to warm, speeds from slow to fast, other names last."""
    found = re.search(r"[\d.]+", name)
    side = {"below": -1, "above": 1}.get(name.split(" ")[0], 0)
    return (side if found else 2, float(found[0]) if found else 0.0, name)


_BOUNDED = ("forward", "leave-season-out", "leave-speed-out", MAIN_PROTOCOL)


def bounds(name: str, left_out: pd.DataFrame, digits: int) -> Table | None:
    """A row per protocol: its left-out runs against the S expected from their inputs and against the 90 % bound.

    Args:
        left_out: of `models.selection.trust.left_out_runs`; None comes of one without a measured run.
    """
    if left_out.empty or not (known := left_out["protocol"].isin(_BOUNDED) & (left_out["S_um"] > 0)).any():
        return None
    runs, bound = left_out[known], RunBound.of(left_out[known])
    apart = runs["disagreement_um"] if "disagreement_um" in runs else [math.nan] * len(runs)
    factor = np.array([bound.factor(*pair) for pair in zip(apart, runs["distance"], strict=True)])
    runs = runs.assign(expected_um=bound.expected_um * factor, most_um=bound.bound_um * factor)
    rows = []
    for protocol in [p for p in _BOUNDED if (runs["protocol"] == p).any()]:
        own = runs[runs["protocol"] == protocol]
        values = (number(own[c].mean(), digits) for c in ("S_um", "expected_um", "most_um"))
        below = percent(float((own["S_um"] <= own["most_um"]).mean()))
        rows.append(Row.of(protocol, str(len(own)), *values, below))
    columns = (
        Column("protocol"), Column("left-out runs", "", "number"), Column("S_mean", "µm", "number"),
        Column("expected", "µm", "number"), Column("90 % bound", "µm", "number"),
        Column("below the bound", "", "number"),
    )  # fmt: skip
    notes = [
        f"S grows with the disagreement of the best of other families to the power {number(bound.slopes[0], 2)} and "
        f"with (1 + distance from the trained region) to the power {number(bound.slopes[1], 2)}. A run is flagged "
        f"where they disagree by more than {number(bound.usual_um, digits)} µm, or its distance is above "
        f"{number(bound.tested, 2)} trained widths. The bound comes from these runs: its share below is no test of it."
    ]
    far = left_out.loc[(left_out["protocol"] == "forward") & (left_out["distance"] > SLACK), "farthest"].value_counts()
    if len(far):
        common = ", ".join(f"{q} ({n})" for q, n in far.head(3).items())
        notes.append(f"Later runs left the trained region most often in {common}.")
    return Table(f"{name}: error to expect of a run", columns, tuple(rows), notes=tuple(notes))


_READINGS = {  # of `models.selection.updating.SCHEDULES`
    f"{COUNTS[0]} evenly": "none, free-running",
    "one a shift": "one, after the first hour",
    "one reading an hour": "one an hour",
}


def readings(name: str, result: GridResult, digits: int) -> Table | None:
    """What readings of a touch probe are worth: none, one a shift, one an hour; None where it was not measured."""
    found = result.readings
    if found.empty:
        return None
    rows = []
    for schedule, label in _READINGS.items():
        own = found[found["schedule"] == schedule]
        scores = (plus_minus(float(own[c].mean()), float(own[c].std()), digits) for c in ("S_um", "held_S_um"))
        stated = NOTHING if label.startswith("none") else percent(float(own["coverage90"].mean()))
        rows.append(Row.of(label, *scores, stated))
    columns = (
        Column("readings of a run"), Column("updated by the filter", "S_mean ± S_std, µm", "number"),
        Column("last residual held", "S_mean ± S_std, µm", "number"), Column("inside the stated 90 %", "", "number"),
    )  # fmt: skip
    note = (
        f"{count(found['batch_id'].nunique(), 'later run')}, predicted from earlier ones. A Kalman filter learned from "
        "the training runs moves offset, gains and drift of the prediction at every reading; rows before a reading do "
        "not know it. The plain way holds the residual of the last reading."
    )
    return Table(f"{name}: error with readings of a touch probe", columns, tuple(rows), notes=(note,))


def batches(name: str, result: GridResult, choice: Choice, digits: int) -> Table:
    """Every batch: when, how it ran, and its S without a model and left out by the promoted one."""
    own = scores_of(result, choice.selector, choice.family, choice.n_tsp, MAIN_PROTOCOL)
    own = own.drop_duplicates("batch_id").set_index("batch_id")
    s = result.scores[result.scores["protocol"] == MAIN_PROTOCOL]
    zero = s[s["family"] == "zero"].drop_duplicates("batch_id").set_index("batch_id")
    rows = []
    for row in result.batches.to_dict("records"):
        b = row["batch_id"]
        rows.append(
            Row.of(
                str(b),
                str(row.get("start") or NOTHING).replace("T", " ")[:16].removesuffix(" 00:00"),
                str(row.get("speed", NOTHING)),
                number(float(row.get("start_ambient_degC", math.nan)), 1),
                f"{row['n_rows']}",
                number(_at(zero, b, "S_um"), digits),
                number(_at(own, b, "S_um"), digits),
                number(_at(own, b, "max_abs_um"), 1),
                number(_at(own, b, "bias_um"), 1, sign=True),
            )
        )
    columns = (
        Column("batch"), Column("start"), Column("speed"), Column("start ambient", "°C", "number"),
        Column("samples", "", "number"), Column("S, no model", "µm", "number"), Column("S, left out", "µm", "number"),
        Column(_MAX, "µm", "number"), Column("mean e", "µm", "number"),
    )  # fmt: skip
    label = cell_label(choice.selector, choice.family, choice.n_tsp)
    return Table(f"{name}: every batch, left out by {label}", columns, tuple(rows))


def _at(table: pd.DataFrame, batch_id: str, column: str) -> float:
    return float(table[column].get(batch_id, math.nan)) if column in table else math.nan
