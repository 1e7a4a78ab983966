"""What is known to go wrong with each selector, as a table in plain words."""

from __future__ import annotations

from models.result import GridResult
from pipelines.report.layout import Column, Row, Table
from pipelines.report.words import number, selector_label

_WORDS = {
    "stability over batches": "another batch changes the points",
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
    """A row per selector and statistic, those beyond their limit marked; None where nothing was measured."""
    found = result.selector_diagnostics
    if found.empty:
        return None
    rows = [
        Row(
            (
                selector_label(d["selector"]),
                str(d["n_tsp"]),
                f"{_WORDS[d['statistic']]}: {d['statistic']}" if d["statistic"] in _WORDS else d["statistic"],
                number(d["value"], 2),
                f"{'at most' if d['ok'] == (d['value'] <= d['threshold']) else 'at least'} {number(d['threshold'], 2)}",
                d["comment"],
            ),
            "" if d["ok"] else "look",
        )
        for d in found.to_dict("records")
    ]
    columns = (
        Column("selector"),
        Column("points", "n", "number"),
        Column("what may go wrong", "", "wide"),
        Column("value", "", "number"),
        Column("usual limit"),
        Column("here", "", "wide"),
    )
    note = (
        "Each selector on all batches, at the number of points of its best cell short of all. A marked row is a "
        "warning: the points may be right, yet another recording could change them."
    )
    caption = f"{name}: how far each selector's choice can be trusted"
    return Table(caption, columns, tuple(rows), result.simulated, None, (note,))
