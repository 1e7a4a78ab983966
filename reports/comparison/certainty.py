"""Certainty of the models: stated intervals, the error to expect of a run, weaknesses of the selectors."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from models.selection.conformal import RunBound
from models.selection.promotion import Choice
from models.selection.result import CELL_KEYS, GridResult
from models.selection.trust import SLACK
from reports.comparison.figures import Cloud, S_against_S
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
    rows = rows.sort_values("S_mean_um", kind="stable").reset_index(drop=True)
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

    Within five per cent of nine tenths it is calibrated; beyond that "perhaps", unless the mean lies further off than
    chance would put it (one-sided 95 % of a mean over batches). `season`: the share where whole seasons are left out.
    """
    if not math.isfinite(mean):
        return NOTHING
    if abs(mean - _MEANT) <= _TOLERATED:
        return "calibrated, but too sure of a new season" if season < _MEANT - _TOLERATED else "calibrated"
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
    "forward": ("later run", BLUE, "circle"),
    "leave-season-out": ("season left out", ORANGE, "square"),
    "leave-speed-out": ("speed left out", "#8a5fbf", "diamond"),
    "leave-batch-out": ("run left out", "#b5bec8", "circle"),
}


def bound_panel(name: str, left_out: pd.DataFrame, simulated: bool) -> Panel | None:
    """S of every left-out run over the S expected from its inputs, with the bound; None where nobody measured it.

    Args:
        left_out: of `models.selection.trust.left_out_runs`.
    """
    expected = _expected(left_out)
    if expected is None:
        return None
    runs, bound = expected
    by = dict(list(runs.groupby("protocol")))
    clouds = [
        Cloud(by[p]["expected_um"].to_numpy(float), by[p]["S_um"].to_numpy(float), Key(*_MARKERS[p], alone=True))
        for p in reversed(_MARKERS) if p in by
    ]  # fmt: skip
    lines = [(1.0, GREEN), (bound.bound_um / bound.expected_um, INK)]
    figure = S_against_S(clouds, lines, "expected S", "S", simulated, equal=False)
    keys = [c.key for c in reversed(clouds)] + [Key("as expected", GREEN), Key("90 % bound", INK)]
    notes = (
        "The expected S rises with the disagreement of the best of other families and with the distance from the "
        "trained region, as far as the left-out runs show it. Runs above the upper line are worse than their bound.",
    )
    return Panel(f"{name}: S of left-out runs against the S expected from their inputs", (Plot(figure, name, "half"),),
                 simulated, tuple(keys), notes)  # fmt: skip


def bound_table(name: str, left_out: pd.DataFrame, digits: int, simulated: bool) -> Table | None:
    """A row per protocol: its left-out runs against the expected S and the 90 % bound."""
    expected = _expected(left_out)
    if expected is None:
        return None
    runs, bound = expected
    rows = []
    for protocol in [p for p in _MARKERS if (runs["protocol"] == p).any()]:
        own = runs[runs["protocol"] == protocol]
        most = own["expected_um"] * bound.bound_um / bound.expected_um
        values = (number(own[c].mean(), digits) for c in ("S_um", "expected_um"))
        below = percent(float((own["S_um"] <= most).mean()))
        rows.append(Row.of(protocol, str(len(own)), *values, number(most.mean(), digits), below))
    columns = (
        Column("protocol"),
        Column("left-out runs", "", "number"),
        Column("S_mean", "µm", "number"),
        Column("expected", "µm", "number"),
        Column("90 % bound", "µm", "number"),
        Column("below the bound", "", "number"),
    )
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
    return Table(f"{name}: error to expect of a run", columns, tuple(rows), simulated, None, tuple(notes))


def _expected(left_out: pd.DataFrame) -> tuple[pd.DataFrame, RunBound] | None:
    """The runs that a bound is learned from with expected_um; None without any."""
    if left_out.empty or not (known := left_out["protocol"].isin(_MARKERS) & (left_out["S_um"] > 0)).any():
        return None
    runs, bound = left_out[known], RunBound.of(left_out[known])
    apart = runs["disagreement_um"] if "disagreement_um" in runs else [math.nan] * len(runs)
    factor = [bound.factor(*pair) for pair in zip(apart, runs["distance"], strict=True)]
    return runs.assign(expected_um=bound.expected_um * np.array(factor)), bound


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
