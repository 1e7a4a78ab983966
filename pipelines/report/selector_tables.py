"""What is known to go wrong with each selector, as a table in plain words."""

from __future__ import annotations

import pandas as pd

from models.result import GridResult
from pipelines.report.layout import Column, Row, Table
from pipelines.report.words import NOTHING, number, selector_label

_STABILITY = "stability over batches"
_WORDS = {
    "largest |corr| among the chosen": "two chosen points tell the same",
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
        return [Row((*first, "no measure of its own", NOTHING, NOTHING, stability["comment"].iloc[0]), _mark(unstable))]
    rows = []
    for statistic, value, limit, ok, comment in zip(
        others["statistic"], others["value"], others["threshold"], others["ok"], others["comment"], strict=True
    ):
        words = f"{_WORDS[statistic]}: {statistic}" if statistic in _WORDS else statistic
        side = "at most" if ok == (value <= limit) else "at least"
        cells = (*first, words, number(value, 2), f"{side} {number(limit, 2)}", comment)
        rows.append(Row(cells, _mark(unstable or not ok)))
    return rows


def _mark(warns: bool) -> str:
    return "look" if warns else ""
