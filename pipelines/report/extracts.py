"""What the report shows of a grid's result: the best cells, their spread over batches, the chosen points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from features.stability import tsp_frequency
from models.protocols import PROTOCOLS
from models.result import CELL_KEYS, GridResult
from pipelines.promotion import BASELINES, Choice, choose, score_um
from pipelines.settings import PromotionRule

Array = NDArray[np.float64]
MAIN_PROTOCOL = "leave-batch-out"
_MOST_POINTS = 400


@dataclass(frozen=True)
class LeftOut:
    """One batch's left-out prediction, thinned for drawing; arrays (n,) with NaN where masked.

    Of a channel along an axis only the readings, with their positions, all of them.
    """

    batch_id: str
    place: str  # best, median or worst
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
    """The protocols that were run, leave-batch-out first."""
    run = set(result.cells["protocol"])
    return [p for p in PROTOCOLS if p in run] + sorted(run - set(PROTOCOLS))


def scored(result: GridResult, protocol: str, rule: PromotionRule) -> pd.DataFrame:
    """The protocol's cells with a finite score, least score first; column score_um is the rule's."""
    cells = result.cells[result.cells["protocol"] == protocol].copy()
    cells["score_um"] = score_um(cells, rule)
    order = ["score_um", "n_inputs", "rank", "selector", "family"]
    return cells[np.isfinite(cells["score_um"])].sort_values(order, kind="stable").reset_index(drop=True)


def picked(result: GridResult, rule: PromotionRule, protocol: str) -> Choice:
    """The cell that the promotion rule takes under a protocol."""
    return choose(result.cells, rule.model_copy(update={"protocol": protocol}))


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

    Where all points are taken there is no choice to look at, so the best cell with fewer stands for it.
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
    """The best, the median and the worst batch by S of a cell; empty where no left-out prediction was kept."""
    table = result.predictions
    if choice.cell not in table.columns:
        return []
    s = result.scores
    rows = s[(s["protocol"] == MAIN_PROTOCOL) & (s["selector"] == choice.selector) & (s["family"] == choice.family)]
    rows = rows[(rows["n_tsp"] == choice.n_tsp) & np.isfinite(rows["S_um"])].sort_values("S_um", kind="stable")
    ids, values = list(rows["batch_id"]), list(rows["S_um"])
    places = dict(zip(_three(len(ids)), ("best", "median", "worst"), strict=False))
    return [_left_out(table, choice.cell, ids[i], place, float(values[i])) for i, place in places.items()]


def _three(n: int) -> Sequence[int]:
    return list(dict.fromkeys([0, (n - 1) // 2, n - 1])) if n else []


def _left_out(table: pd.DataFrame, cell: str, batch_id: str, place: str, S_um: float) -> LeftOut:
    rows = table[table["batch_id"] == batch_id]
    along_axis = "position_mm" in table.columns
    if along_axis:
        rows = rows[np.isfinite(rows["position_mm"]) & np.isfinite(rows["recorded_um"])]
    every = 1 if along_axis else max(1, -(-len(rows) // _MOST_POINTS))
    shown = rows.iloc[::every]
    return LeftOut(
        batch_id,
        place,
        S_um,
        shown["time_s"].to_numpy(float) / 3600.0,
        shown["recorded_um"].to_numpy(float),
        shown[cell].to_numpy(float),
        every,
        shown["position_mm"].to_numpy(float) if along_axis else None,
    )
