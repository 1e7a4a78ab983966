"""One error channel of a page: its trainings with what was chosen, and the sentence and rows that state it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from data.errors import InputError
from models.protocols import PromotionRule
from models.selection.outlook import Outlook, outlook
from models.selection.promotion import BASELINES, Choice, lacking, ranked
from models.selection.result import GridResult, Training
from reports.comparison.story import Verdict, mark_of, promoted_cell, verdict
from reports.comparison.tables import MAIN_PROTOCOL, best_per, protocols_of, scored, scores_of
from reports.labels import NOTHING, cell_label, decimals, number, percent, plus_minus, sentence
from reports.layout import Cell, Column, Row, Table, Text

_RUNNERS_UP = 2


@dataclass(frozen=True)
class Channel:
    """A channel's trainings, newest first, each with its promoted cell; `protocol` leads, `expected` is of the newest.

    `runs`: of the left-out runs under the outlook's protocol, in the order of time, start, S_um of the chosen cell and
    none_um without a model.
    """

    name: str
    unit: str
    trainings: tuple[Training, ...]
    choices: tuple[Choice, ...]
    verdict: Verdict
    protocol: str
    expected: Outlook
    runs: pd.DataFrame
    digits: int

    @classmethod
    def of(cls, name: str, group: Sequence[Training], rule: PromotionRule) -> Channel:
        """From its trainings. Raises: InputError, a newest training without a judged cell."""
        result = group[0].result
        protocol = protocols_of(result)[0]
        if scored(result, protocol).empty:
            raise InputError(f"report: training {group[0].training_id} has no cell with a finite score; train again")
        choices = tuple(promoted_cell(t, rule) for t in group)
        expected = outlook(result, choices[0])
        digits = decimals(choices[0].S_std_um, choices[0].n_batches)
        said = verdict(group[0], choices[0])
        runs = _runs(result, *_key(choices[0]), expected.protocol)
        unit = group[0].params.get("unit", "um")
        return cls(name, unit, tuple(group), choices, said, protocol, expected, runs, digits)

    @property
    def result(self) -> GridResult:
        return self.trainings[0].result

    @property
    def choice(self) -> Choice:
        return self.choices[0]

    @property
    def mark(self) -> str:
        return mark_of(self.trainings[0])

    @property
    def label(self) -> str:
        return cell_label(*_key(self.choice))

    @property
    def cost(self) -> float:
        """By how much choosing among the cells flatters the chosen one, as a factor of its S."""
        return self.expected.S_um / self.expected.cell_S_um if self.expected.cell_S_um > 0 else 1.0

    @property
    def none_um(self) -> float:
        """Mean S without a model; NaN where it was not measured."""
        return float(self.runs["none_um"].mean())


def _key(choice: Choice) -> tuple[str, str, int]:
    return choice.selector, choice.family, choice.n_tsp


def _runs(result: GridResult, selector: str, family: str, n_tsp: int, protocol: str) -> pd.DataFrame:
    own = scores_of(result, selector, family, n_tsp, protocol)
    s = result.scores
    zero = s[(s["protocol"] == protocol) & (s["family"] == "zero")].drop_duplicates("batch_id")
    out = own[["batch_id", "S_um"]].drop_duplicates("batch_id")
    out = out.assign(none_um=out["batch_id"].map(zero.set_index("batch_id")["S_um"]))
    starts = result.batches.drop_duplicates("batch_id").set_index("batch_id").get("start", pd.Series(dtype=str))
    out = out.assign(start=out["batch_id"].map(starts).fillna(""))
    return out[np.isfinite(out["S_um"])].sort_values("start", kind="stable").reset_index(drop=True)


def removed(runs: pd.DataFrame, cost: float = 1.0) -> tuple[float, float]:
    """Share of the error that a model removes, and its standard error over the runs (jackknife of the ratio of means).

    Args:
        runs: S_um and none_um of each.
        cost: factor of S_um for having chosen the model by the same runs.
    """
    pairs = runs[["S_um", "none_um"]].dropna().to_numpy(float)
    n, total = len(pairs), pairs.sum(axis=0)
    if not n or not total[1] > 0:
        return math.nan, math.nan
    share = 1.0 - cost * total[0] / total[1]
    if n < 2:
        return share, math.nan
    without = total - pairs
    each = 1.0 - cost * without[:, 0] / without[:, 1]
    return share, float(np.sqrt((n - 1) / n * np.sum((each - each.mean()) ** 2)))


def leads(c: Channel, rule: PromotionRule) -> tuple[Text, ...]:
    """What the channel's model removes of the error of runs that it has not seen, how many runs a champion lacks, and
    what to doubt about it."""
    of = "later runs" if c.expected.protocol == "forward" else "left-out runs"
    S = f"{plus_minus(c.expected.S_um, c.expected.S_std_um, c.digits)} µm"
    none, bound = (f"{number(v, c.digits)} µm" for v in (c.none_um, c.expected.bound_um))
    share = _share(*removed(c.runs, c.cost))
    text = f"{c.label} removes {share} of the error of {of}: S {none} → {S};"
    if c.choice.family == "zero":
        text = f"nothing is compensated; S of {of} is {S};"
    elif share == NOTHING:
        text = f"{c.label} leaves S {S} of {of};"
    below = int((c.runs["S_um"] <= c.expected.bound_um).sum())
    tested = f"{below} of {len(c.runs)} stay below the 90 % bound of {bound}."
    doubts = [c.verdict.caution, sentence(c.expected.warning), sentence(c.expected.note)]
    text = f"{text} {tested}" if len(c.runs) else f"{text[:-1]}."
    if c.verdict.outcome != "champion":
        text += f" {sentence(lacking(c.result, rule, c.choice))}".rstrip()
    lead = Text(text, "lead", f"{c.name}:")
    return (lead, *(Text(t, "caution") for t in doubts if t))


def leaders(channels: Sequence[Channel], rule: PromotionRule, unit: str) -> Table:
    """The chosen model of every channel, marked, and the runners-up of other families."""
    columns = (
        Column("model"), Column("expected S", f"± S_std, {unit}", "number"),
        Column("removed", "± standard error", "number"),
        Column("leave-batch-out", f"S_mean ± S_std, {unit}", "number"),
        Column("loss against the chosen", f"± standard error, {unit}", "number"),
    )  # fmt: skip
    notes = [
        "S: standard deviation of the error that is left in a run. Expected S: mean S of runs left out, later ones "
        "predicted from earlier ones; of the chosen model each run by the cell that the others chose, where choosing "
        "costs. Loss: the rule's measure of a future run; plus is worse."
    ]
    if any(c.expected.protocol != "forward" for c in channels):
        notes.append("‡ Optimistic: no later run was predicted from earlier ones.")
    return Table("Leaders", columns, tuple(row for c in channels for row in _leaders(c, rule)), notes=tuple(notes))


def _leaders(c: Channel, rule: PromotionRule) -> list[Row]:
    optimistic = "" if c.expected.protocol == "forward" else " ‡"
    own = Cell(f"{c.name}: {c.label}", chip=(c.verdict.chip, c.verdict.outcome))
    S, share = plus_minus(c.expected.S_um, c.expected.S_std_um, c.digits) + optimistic, _share(*removed(c.runs, c.cost))
    rows = [Row.of(own, S, share, _near(c, *_key(c.choice)), NOTHING, look="marked")]
    for row in _others(c, rule):
        key = (row["selector"], row["family"], int(row["n_tsp"]))
        runs = _runs(c.result, *key, c.expected.protocol)
        behind = plus_minus(row["behind_um"], row["se_um"], max(c.digits, 2)) if "se_um" in row else NOTHING
        S = plus_minus(float(runs["S_um"].mean()), float(runs["S_um"].std()), c.digits) + optimistic
        share = _share(*removed(runs))
        rows.append(Row.of(f"{c.name}: {cell_label(*key)}", S, share, _near(c, *key), behind))
    return rows


def _others(c: Channel, rule: PromotionRule) -> list[dict[Any, Any]]:
    """The best cells of other families by the rule, else by the leading protocol."""
    cells = best_per(scored(c.result, c.protocol), "family")
    if rule.offered(set(c.result.cells["protocol"])):
        cells = ranked(c.result, rule, c.choice.cell)
    others = cells[~cells["family"].isin([c.choice.family, *BASELINES])]
    return others[:_RUNNERS_UP].to_dict("records")


def _near(c: Channel, selector: str, family: str, n_tsp: int) -> str:
    """S_mean ± S_std where only the run itself is left out."""
    S = scores_of(c.result, selector, family, n_tsp, MAIN_PROTOCOL)["S_um"]
    return plus_minus(float(S.mean()), float(S.std()), c.digits)


def _share(share: float, se: float) -> str:
    """``97 % ± 1 %``."""
    return f"{percent(share)} ± {percent(se)}" if math.isfinite(share) and math.isfinite(se) else percent(share)
