"""First screen of a channel: the number that holds, what it rests on, and the seasons and speeds that fail."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from models.selection.outlook import Outlook, outlook
from models.selection.promotion import Choice
from models.selection.result import GridResult, Training
from reports.comparison.story import Verdict
from reports.comparison.tables import group_order
from reports.labels import NOTHING, cell_label, count, number, percent, plus_minus, sentence
from reports.layout import Column, Number, Numbers, Row, Table, Text, given

_GROUPS = {"season": "leave-season-out", "speed": "leave-speed-out"}


_S = "S is the standard deviation of the error that is left in a run."


def headline(name: str, training: Training, choice: Choice, verdict: Verdict, digits: int) -> tuple[Any, ...]:
    """The first screen of one channel as blocks: figures, what they rest on, warnings; without the groups' table."""
    result, expected = training.result, outlook(training.result, choice)
    forward = expected.protocol == "forward"
    none_um = _no_model_um(result, expected.protocol)
    own = _of_cell(result, choice.selector, choice.family, choice.n_tsp)
    S_um = own.loc[own["protocol"] == expected.protocol, "S_um"].to_numpy(float)
    below = f"{int((S_um <= expected.bound_um).sum())} of {count(int(np.isfinite(S_um).sum()), 'left-out run')} below"
    figures = [
        Number(
            "Expected next season" if forward else "Expected error, optimistic",
            f"{number(expected.S_um, digits)} µm",
            f"mean S of {count(expected.n_runs, 'later run' if forward else 'left-out run')}"
            + (", each by the model that the others chose" if expected.nested else ""),
        ),
        Number("90 % bound of one run", f"{number(expected.bound_um, digits)} µm", f"{below} it"),
        Number(
            "Leave-batch-out",
            f"{plus_minus(expected.leave_batch_out_um, expected.leave_batch_out_std_um, digits)} µm",
            "all other runs are known",
        ),
        Number("No model", f"{number(none_um, digits)} µm", f"S on the same {'later ' if forward else ''}runs"),
    ]
    return given(
        Text(sentence(expected.warning), "caution"),
        Numbers(tuple(f for f in figures if not f.value.startswith(NOTHING))),
        Text(verdict.caution, "caution"),
        Text(_rests_on(result, choice, expected)),
    )


def overview(rows: Sequence[tuple[str, Training, Choice, Verdict, int]], simulated: bool) -> Table:
    """A row per channel: name, training, promoted cell, verdict, decimals."""
    out = []
    for name, training, choice, verdict, digits in rows:
        expected = outlook(training.result, choice)
        none_um = _no_model_um(training.result, expected.protocol)
        near = plus_minus(expected.leave_batch_out_um, expected.leave_batch_out_std_um, digits)
        out.append(
            Row.of(
                name,
                verdict.chip,
                number(expected.S_um, digits) + ("" if expected.protocol == "forward" else " ‡"),
                number(expected.bound_um, digits),
                near,
                number(none_um, digits),
                percent(1 - expected.S_um / none_um) if none_um > 0 else NOTHING,
                cell_label(choice.selector, choice.family, choice.n_tsp),
            )
        )
    columns = (
        Column("error channel"),
        Column("status"),
        Column("expected S", "µm", "number"),
        Column("90 % bound", "µm", "number"),
        Column("leave-batch-out", "µm", "number"),
        Column("no model", "µm", "number"),
        Column("removed", "", "number"),
        Column("model"),
    )
    optimistic = any("‡" in str(r.cells[2]) for r in out)
    notes = ("‡ Optimistic: no later run was predicted from earlier ones.",) if optimistic else ()
    return Table("What the models leave in the next season", columns, tuple(out), simulated, None, notes)


def _rests_on(result: GridResult, choice: Choice, expected: Outlook) -> str:
    model = cell_label(choice.selector, choice.family, choice.n_tsp)
    model = model[:1].upper() + model[1:]
    s = result.scores
    if expected.protocol != "forward":
        return f"{model}. {sentence(expected.note)} {_S}"
    blocks = s.loc[s["protocol"] == "forward", "fold"].nunique()
    return (
        f"{model}. Each of {count(blocks, 'block')} of later runs is predicted by a model of all runs before it. {_S}"
    )


def groups_table(name: str, result: GridResult, choice: Choice, digits: int) -> Table | None:
    """Every season and speed: S of the model forward, with the group left out, and without a model; worst marked."""
    expected = outlook(result, choice)
    own = _of_cell(result, choice.selector, choice.family, choice.n_tsp)
    nothing = _of_cell(result, "none", "zero", 0)
    rows: list[tuple[float, Row]] = []
    for kind, protocol in _GROUPS.items():
        if kind not in result.batches or result.batches[kind].nunique() < 2:
            continue
        label = result.batches.set_index(result.batches["batch_id"].astype(str))[kind].astype(str)
        led, left, zero = (
            _means(part, p, label)
            for part, p in ((own, expected.protocol), (own, protocol), (nothing, "leave-batch-out"))
        )
        counts = label.value_counts()
        for group in sorted(counts.index, key=group_order):
            shown = [float(means.get(group, math.nan)) for means in (led, left, zero)]
            worst = max((v for v in shown[:2] if math.isfinite(v)), default=math.nan)
            cells = (f"{kind} {group}", str(counts[group]), *(number(v, digits) for v in shown))
            rows.append((worst, Row(cells)))
    if not rows:
        return None
    top = max((v for v, _ in rows if math.isfinite(v)), default=math.nan)
    columns = (
        Column("group"),
        Column("runs", "", "number"),
        Column("forward" if expected.protocol == "forward" else expected.protocol, "µm", "number"),
        Column("whole group left out", "µm", "number"),
        Column("no model", "µm", "number"),
    )
    marked = tuple(Row(r.cells, "worst" if v == top else "") for v, r in rows)
    return Table(f"{name}: S_mean by season and speed", columns, marked, result.simulated)


def _of_cell(result: GridResult, selector: str, family: str, n_tsp: int) -> pd.DataFrame:
    s = result.scores
    return s[(s["selector"] == selector) & (s["family"] == family) & (s["n_tsp"] == n_tsp)]


def _means(scores: pd.DataFrame, protocol: str, label: pd.Series) -> pd.Series:
    own = scores[scores["protocol"] == protocol]
    return own["S_um"].groupby(own["batch_id"].astype(str).map(label)).mean()


def _no_model_um(result: GridResult, protocol: str) -> float:
    zero = _of_cell(result, "none", "zero", 0)
    return float(zero.loc[zero["protocol"] == protocol, "S_um"].mean())
