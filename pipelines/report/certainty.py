"""How sure the models say they are, and how often they are right in that."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from models.result import CELL_KEYS, GridResult
from pipelines.promotion import Choice
from pipelines.report.extracts import S_by_batch, best_per
from pipelines.report.layout import Column, Row, Table
from pipelines.report.words import NOTHING, family_label, number, percent, plus_minus, selector_label

_MEANT, _TOLERATED = 0.90, 0.05
_BEYOND_CHANCE = 1.6449  # standard errors of a mean over batches
_SEASON = "leave-season-out"


def certainty_table(
    name: str, result: GridResult, cells: pd.DataFrame, choice: Choice, digits: int, mark: str = "chosen"
) -> Table | None:
    """A row for the best cell of every family that states a standard deviation, and for the promoted one.

    Args:
        cells: one protocol's cells from `extracts.scored`.

    Returns:
        None where no family states one.
    """
    told = cells[np.isfinite(cells["coverage90"])] if "coverage90" in cells else cells.iloc[:0]
    if told.empty:
        return None
    promoted = [choice.selector, choice.family, choice.n_tsp]
    own = told[(told[["selector", "family", "n_tsp"]] == promoted).all(axis=1)]
    rows = pd.concat([best_per(told, "family"), own]).drop_duplicates(CELL_KEYS)
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
    """In plain words what a mean share inside the 90 % interval, with its spread over batches, says.

    Within five per cent of nine tenths it is honest; beyond that "perhaps", unless the mean lies further off than
    chance would put it (one-sided 95 % of a mean over batches). `season`: the share where whole seasons are left out.
    """
    if not math.isfinite(mean):
        return NOTHING
    if abs(mean - _MEANT) <= _TOLERATED:
        return "honest, but too sure of a new season" if season < _MEANT - _TOLERATED else "honest"
    words = "too sure" if mean < _MEANT else "too careful"
    if math.isfinite(spread) and abs(mean - _MEANT) > _BEYOND_CHANCE * spread / math.sqrt(n_batches):
        return words
    return f"perhaps {words}"


def _inside_of_seasons(result: GridResult, rows: pd.DataFrame) -> list[float]:
    """Share inside for the same cells where whole seasons are left out; NaN where that was not run."""
    cells = result.cells[result.cells["protocol"] == _SEASON]
    if rows["protocol"].iloc[0] == _SEASON or cells.empty:
        return [math.nan] * len(rows)
    beside = rows[CELL_KEYS[1:]].merge(cells[[*CELL_KEYS[1:], "coverage90"]], on=CELL_KEYS[1:], how="left")
    return [float(v) for v in beside["coverage90"]]
