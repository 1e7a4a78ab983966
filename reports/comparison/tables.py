"""Extracts of a training's result, and tables of scores: leaderboards, one per protocol, batches."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from data.arrays import Array
from features.stability import tsp_frequency
from models.protocols import PROTOCOLS
from models.selection.promotion import BASELINES, Choice
from models.selection.result import CELL_KEYS, GridResult
from reports.labels import NOTHING, cell_label, count, family_label, listed, number, percent, selector_label
from reports.layout import Column, Row, Scale, Shade, Strip, Table

MAIN_PROTOCOL = "leave-batch-out"
_MOST_POINTS = 400


@dataclass(frozen=True)
class LeftOut:
    """One batch's left-out prediction under a protocol, thinned for drawing; arrays (n,) with NaN where masked.

    Of a channel along an axis only the readings, with their positions, all of them.
    """

    protocol: str
    batch_id: str
    place: str  # best, median, worst; "" for all others
    S_um: float
    time_h: Array
    recorded_um: Array
    predicted_um: Array
    every: int  # every how many samples are shown
    position_mm: Array | None = None


@dataclass(frozen=True)
class Frequency:
    """How often a selector's folds chose each point, 0..1, at its best number of points short of all."""

    selector: str
    n_tsp: int
    stability: float
    share: dict[str, float]


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


def paths(cells: pd.DataFrame) -> pd.DataFrame:
    """Rows of the selectors that were tried with several numbers of points; all with inputs where none was."""
    with_inputs = cells[cells["n_tsp"] > 0]
    several = with_inputs.groupby(["family", "selector"])["n_tsp"].transform("nunique") > 1
    return with_inputs[several] if several.any() else with_inputs


def is_baseline(cells: pd.DataFrame) -> pd.Series:
    """Rows of the families that every table must hold."""
    return cells["family"].isin(BASELINES)


def zero_um(cells: pd.DataFrame) -> float:
    """S_mean without a model, NaN where it was not run."""
    zero = cells.loc[cells["family"] == "zero", "S_mean_um"]
    return float(zero.iloc[0]) if len(zero) else float("nan")


def S_by_batch(result: GridResult, cells: pd.DataFrame) -> list[pd.DataFrame]:
    """Per row of `cells` its scores per fold and batch."""
    wanted = cells[CELL_KEYS].assign(row=range(len(cells)))
    rows = result.scores.merge(wanted, on=CELL_KEYS)
    groups = dict(list(rows.groupby("row")))
    return [groups.get(i, rows.iloc[:0]) for i in range(len(cells))]


def frequencies(result: GridResult, cells: pd.DataFrame, protocol: str) -> list[Frequency]:
    """Per selector that chooses, at the number of points of its best cell: how often each point was chosen.

    Where all points are taken there is no choice, so the best cell with fewer represents it.
    """
    out = []
    with_inputs = cells[(cells["n_tsp"] > 0) & ~is_baseline(cells)]
    fewer = with_inputs[with_inputs["n_inputs"] < with_inputs["n_inputs"].max()]
    for row in best_per(fewer if len(fewer) else with_inputs, "selector").to_dict("records"):
        s = result.subsets
        picks = s[(s["protocol"] == protocol) & (s["selector"] == row["selector"]) & (s["n_tsp"] == row["n_tsp"])]
        sets = [tuple(i for i in str(v).split("|") if i) for v in picks["inputs"]]
        if row["selector"] != "none" and sets:
            share = tsp_frequency(sets)
            out.append(Frequency(row["selector"], int(row["n_tsp"]), float(row["tsp_stability"]), share))
    return out


def left_out_batches(result: GridResult, choice: Choice) -> list[LeftOut]:
    """Every left-out batch of a cell by S, the best, median and worst by name; empty where no prediction was kept.

    Of the later runs, predicted forward in time, where the training kept them, else of all, left out one by one.
    """
    table, protocol, column = result.predictions, MAIN_PROTOCOL, choice.cell
    if len(result.curves) and (result.distances["cell"] == choice.cell).all():
        later = result.curves[result.curves["protocol"] == "forward"]
        table, protocol, column = (later, "forward", "predicted_um") if len(later) else (table, protocol, column)
    if column not in table.columns:
        return []
    s = result.scores
    rows = s[(s["protocol"] == protocol) & (s["selector"] == choice.selector) & (s["family"] == choice.family)]
    rows = rows[(rows["n_tsp"] == choice.n_tsp) & np.isfinite(rows["S_um"])].sort_values("S_um", kind="stable")
    ids, values = list(rows["batch_id"]), list(rows["S_um"])
    places = dict(zip(_three(len(ids)), ("best", "median", "worst"), strict=False))
    return [_left_out(table, protocol, column, ids[i], places.get(i, ""), float(values[i])) for i in range(len(ids))]


def _three(n: int) -> Sequence[int]:
    return list(dict.fromkeys([0, (n - 1) // 2, n - 1])) if n else []


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


_MOST_GROUPS = 6
_STABLE = 0.7  # mean Jaccard similarity of the points that the folds choose
_MAX = "max\u00a0|e|"
_WHAT_A_DOT_IS = {"train-on-one": "the model of one batch, mean over the batches it predicts"}


@dataclass(frozen=True)
class Promoted:
    """The promoted cell with its `mark` in tables, and the decimals of a score."""

    choice: Choice
    digits: int
    mark: str = "chosen"


def leaderboard(result: GridResult, cells: pd.DataFrame, key: str, promoted: Promoted, caption: str) -> Table:
    """The best cell of every family or selector under one protocol, least score first; baselines always in it.

    Args:
        cells: one protocol's cells from `scored`.
        key: family or selector.
        promoted: its cell gets a row of its own where it is no row's best.
    """
    choice, digits = promoted.choice, promoted.digits
    base = is_baseline(cells)
    rows = best_per(cells[~base], key)
    own = _row_of(cells, choice)
    if own is not None and not (rows[CELL_KEYS] == own[CELL_KEYS]).all(axis=1).any():
        rows = pd.concat([rows, own.to_frame().T.astype(cells.dtypes)], ignore_index=True)
    rows = pd.concat([rows, cells[base]], ignore_index=True).drop_duplicates(CELL_KEYS)
    rows = rows.sort_values("S_mean_um", kind="stable").reset_index(drop=True)
    protocol = str(rows["protocol"].iloc[0])
    per_batch = [part["S_um"].to_numpy(float) for part in S_by_batch(result, rows)]
    nothing = zero_um(cells)
    scale = Scale.over(np.concatenate(per_batch).tolist(), 2.5 * nothing if nothing > 0 else math.inf)
    groups = _groups(result, rows, protocol)
    names = sorted({g for row in groups for g in row}, key=group_order)
    columns = _columns(key, protocol, names)
    body = []
    for row, values, group in zip(rows.to_dict("records"), per_batch, groups, strict=True):
        chosen = own is not None and all(row[k] == own[k] for k in CELL_KEYS)
        unstable = row["tsp_stability"] < _STABLE
        cells_of: dict[str, str | Strip] = {
            "family": family_label(row["family"]),
            "selector": selector_label(row["selector"]) if row["n_tsp"] else NOTHING,
            "points": str(row["n_tsp"]) if row["n_tsp"] else NOTHING,
            "S_mean": number(row["S_mean_um"], digits),
            "S_std": number(row["S_std_um"], digits),
            _MAX: number(row["max_abs_um"], 1),
            "strip": _strip(values, float(row["S_mean_um"]), scale, digits),
            "of no model": percent(row["S_mean_um"] / nothing) if nothing else NOTHING,
            "fitted S": number(row["fit_S_um"], digits),
            "stability": number(row["tsp_stability"], 2) + (" †" if unstable else "") if row["n_tsp"] else NOTHING,
            **{n: number(group.get(n, math.nan), digits) for n in names},
        }
        body.append(Row(tuple(cells_of[c.key] for c in columns), promoted.mark if chosen else ""))
    dots = _WHAT_A_DOT_IS.get(protocol, "a left-out batch")
    notes = [f"Every dot is {dots} (log scale), the bar is S_mean; {_rests_on(result, protocol)}."]
    if any(isinstance(cell, Strip) and cell.beyond for row in body for cell in row.cells):
        notes.append("A number with › counts the dots beyond the axis.")
    if any("†" in str(cell) for row in body for cell in row.cells):
        notes.append(f"† Below {_STABLE:g}: another training would choose other points.")
    return Table(caption, columns, tuple(body), result.simulated, scale, tuple(notes))


def _columns(key: str, protocol: str, groups: Sequence[str]) -> tuple[Column, ...]:
    """The columns of a leaderboard; those of left-out groups take the place of the last three."""
    first = [Column("family"), Column("selector")]
    last = (
        [Column(n, "µm", "number") for n in groups]
        or [
            Column("of no model", "", "number"),
            Column("fitted S", "µm", "number"),
            Column("stability of points", "", "number", "stability"),
        ]
    )  # fmt: skip
    return (
        *(first if key == "family" else reversed(first)),
        Column("points", "n", "number"),
        Column("S_mean", "µm", "number"),
        Column("S_std", "µm", "number"),
        Column(_MAX, "µm", "number"),
        Column("S per model" if protocol == "train-on-one" else "S per batch", "µm", "strip", "strip"),
        *last,
    )


def heat_map(name: str, result: GridResult, cells: pd.DataFrame, digits: int) -> Table | None:
    """S_mean of every family and selector at the best number of points; the darker, the smaller (logarithmic)."""
    best = best_per(cells[~is_baseline(cells) & (cells["n_tsp"] > 0)], "family", "selector")
    if best.empty:
        return None
    log_um = np.log10(np.maximum(best["S_mean_um"].to_numpy(float), 1e-3))
    nothing = zero_um(cells)
    low = float(log_um.min())
    high = max(min(float(log_um.max()), math.log10(nothing) if nothing > 0 else math.inf), low + 0.1)
    share = np.clip((high - log_um) / (high - low), 0.0, 1.0)
    shades = {
        (r["family"], r["selector"]): Shade(number(r["S_mean_um"], digits), f"n = {r['n_tsp']}", float(v))
        for r, v in zip(best.to_dict("records"), share, strict=True)
    }
    families, selectors = (list(dict.fromkeys(best[k])) for k in ("family", "selector"))
    rows = [Row((family_label(f), *(shades.get((f, s), NOTHING) for s in selectors))) for f in families]
    columns = (Column("family"), *(Column(selector_label(s), "", "shade") for s in selectors))
    levels = [
        f"{family_label(r['family'])} {number(r['S_mean_um'], digits)} µm"
        for r in best_per(cells[cells["n_tsp"] == 0], "family").to_dict("records")
    ]
    notes = ["For each pair the number of points n with the least score. The darker, the smaller the error left."]
    notes += [f"Without temperature points: {listed(levels)}."] if levels else []
    caption = f"{name}: S_mean of every family and selector, µm"
    return Table(caption, columns, tuple(rows), result.simulated, None, tuple(notes))


_MOST_POINTS_SHOWN = 24


def point_frequency(name: str, result: GridResult, cells: pd.DataFrame, protocol: str) -> Table | None:
    """How often the folds of each selector chose each point, most often chosen first; None where there is no choice."""
    found = frequencies(result, cells, protocol)
    if not found:
        return None
    total = {point: sum(f.share.get(point, 0.0) for f in found) for f in found for point in f.share}
    points = sorted(total, key=lambda p: (-total[p], p))
    rows = [
        Row((p, *(Shade(percent(v) if v else "", "", v) for f in found for v in [f.share.get(p, 0.0)])))
        for p in points[:_MOST_POINTS_SHOWN]
    ]
    columns = (Column("point"), *(Column(selector_label(f.selector), f"n = {f.n_tsp}", "shade") for f in found))
    stable = [f"{selector_label(f.selector)} {number(f.stability, 2)}" for f in found]
    notes = [f"Share of the folds, at each selector's best n short of all. Mean Jaccard similarity: {listed(stable)}."]
    if len(points) > _MOST_POINTS_SHOWN:
        notes.append(f"The {_MOST_POINTS_SHOWN} most often chosen of {len(points)} points.")
    caption = f"{name}: how often each point is chosen"
    return Table(caption, columns, tuple(rows), result.simulated, None, tuple(notes))


def batches(result: GridResult, choice: Choice, digits: int) -> Table:
    """Every batch: when, how it ran, and its S without a model and left out by the promoted one."""
    s = result.scores[result.scores["protocol"] == MAIN_PROTOCOL]
    own = s[(s["selector"] == choice.selector) & (s["family"] == choice.family) & (s["n_tsp"] == choice.n_tsp)]
    own = own.drop_duplicates("batch_id").set_index("batch_id")
    zero = s[s["family"] == "zero"].drop_duplicates("batch_id").set_index("batch_id")
    out = []
    for row in result.batches.to_dict("records"):
        b = row["batch_id"]
        out.append(
            Row.of(
                str(b),
                str(row.get("start") or NOTHING).replace("T", " ")[:16].removesuffix(" 00:00"),
                str(row.get("speed", "–")),
                number(float(row.get("start_ambient_degC", math.nan)), 1),
                f"{row['n_rows']}",
                number(_at(zero, b, "S_um"), digits),
                number(_at(own, b, "S_um"), digits),
                number(_at(own, b, "max_abs_um"), 1),
                number(_at(own, b, "bias_um"), 1, sign=True),
            )
        )
    columns = (
        Column("batch"),
        Column("start"),
        Column("speed"),
        Column("start ambient", "°C", "number"),
        Column("samples", "", "number"),
        Column("S, no model", "µm", "number"),
        Column("S, left out", "µm", "number"),
        Column(_MAX, "µm", "number"),
        Column("mean e", "µm", "number"),
    )
    label = cell_label(choice.selector, choice.family, choice.n_tsp)
    return Table(f"Every batch, left out by {label}", columns, tuple(out), result.simulated)


def _row_of(cells: pd.DataFrame, choice: Choice) -> pd.Series | None:
    hit = cells[
        (cells["selector"] == choice.selector) & (cells["family"] == choice.family) & (cells["n_tsp"] == choice.n_tsp)
    ]
    return hit.iloc[0] if len(hit) else None


def _strip(values: np.ndarray, mean_um: float, scale: Scale, digits: int) -> Strip:
    good = np.sort(values[np.isfinite(values)])
    beyond = int((good > scale.high_um).sum())
    if not len(good):
        return Strip((), 0.0, 0, NOTHING)
    label = f"{number(good[0], digits)} to {number(good[-1], digits)}, median {number(float(np.median(good)), digits)}"
    return Strip(tuple(scale.at(float(v)) for v in good), scale.at(mean_um), beyond, label)


def _groups(result: GridResult, rows: pd.DataFrame, protocol: str) -> list[dict[str, float]]:
    """Per row the mean S of every left-out season or speed; empty for the protocols of single batches."""
    if protocol in (MAIN_PROTOCOL, "train-on-one"):
        return [{} for _ in range(len(rows))]
    parts = [part.groupby("fold", sort=False)["S_um"].mean() for part in S_by_batch(result, rows)]
    if max((len(p) for p in parts), default=0) > _MOST_GROUPS:
        return [{} for _ in range(len(rows))]
    return [{_short(str(k)): float(v) for k, v in part.items()} for part in parts]


def _short(fold: str) -> str:
    """A block of runs by its first day."""
    first, _, last = fold.partition(" to ")
    return f"from {first}" if last else first


def group_order(name: str) -> tuple[int, float, str]:
    """Seasons from cold to warm, speeds from slow to fast, other names last."""
    found = re.search(r"[\d.]+", name)
    side = {"below": -1, "above": 1}.get(name.split(" ")[0], 0)
    return (side if found else 2, float(found[0]) if found else 0.0, name)


def _at(table: pd.DataFrame, batch_id: str, column: str) -> float:
    return float(table[column].get(batch_id, math.nan)) if column in table else math.nan


def _rests_on(result: GridResult, protocol: str) -> str:
    """How many folds and batches a protocol's numbers rest on."""
    s = result.scores[result.scores["protocol"] == protocol]
    tested = len(result.batches) if protocol == "train-on-one" else s["batch_id"].nunique()
    return f"{count(int(s['fold'].nunique()), 'fold')}, {count(int(tested), 'batch')} predicted"
