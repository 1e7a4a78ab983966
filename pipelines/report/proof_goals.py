"""The goals as rows: what was wanted, what was measured with its interval, plant by plant."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from pipelines.report.proof_words import measured
from pipelines.report.words import NOTHING

_WIDTH = 100.0


@dataclass(frozen=True)
class Bar:
    """Positions in 0..100 of a goal's picture: interval, value, and where the goal stands."""

    low: float
    high: float
    value: float
    wanted: float


@dataclass(frozen=True)
class Cell:
    """A value as it is shown; `met` is yes, no or empty where it cannot be said."""

    value: str
    interval: str
    n: str
    met: str
    bar: Bar | None = None


_NONE = Cell(NOTHING, "", "", "")


@dataclass(frozen=True)
class GoalRow:
    """One goal: over all plants, what an answer would reach that is told the truth, and a cell for each plant."""

    measure: str
    goal: str
    whole: Cell
    informed: Cell
    plants: tuple[Cell, ...]


def goal_rows(goals: pd.DataFrame, plants: Sequence[str]) -> tuple[GoalRow, ...]:
    """The rows in the table's order."""
    out = []
    for measure, part in goals.groupby("measure", sort=False):
        by_plant = {str(r["plant"]): r for r in part.to_dict("records")}
        first = next(iter(by_plant.values()))
        every = [_cell(by_plant.get(p), False) for p in plants]
        out.append(
            GoalRow(
                str(measure),
                str(first["goal"]),
                _cell(by_plant.get("all"), True),
                _informed(by_plant.get("all")),
                tuple(every),
            )
        )
    return tuple(out)


def counted(goals: pd.DataFrame) -> tuple[int, int, int]:
    """Goals met, missed, and not measured, over all plants."""
    met = goals.loc[goals["plant"] == "all", "met"]
    yes, no = int(met.eq(True).sum()), int(met.eq(False).sum())
    return yes, no, len(met) - yes - no


def shortfalls(goals: pd.DataFrame, plant: str = "all") -> list[str]:
    """``detection, visible: 95.5 %, wanted ≥ 97 %`` for every goal that was missed."""
    missed = goals[(goals["plant"] == plant) & goals["met"].eq(False)]
    return [f"{r['measure']}: {_value(r)}, wanted {r['goal']}" for r in missed.to_dict("records")]


def _cell(r: Mapping[Any, Any] | None, picture: bool) -> Cell:
    if r is None or not math.isfinite(_number(r["value"])):
        return _NONE
    low, high = _number(r["low90"]), _number(r["high90"])
    known = math.isfinite(low) and math.isfinite(high)
    said = _interval(r, low, high) if known else ""
    met = "" if pd.isna(r["met"]) else "yes" if bool(r["met"]) else "no"
    return Cell(_value(r), said, f"{int(r['n'])}", met, _bar(r, low, high) if picture else None)


def _informed(r: Mapping[Any, Any] | None) -> Cell:
    value = math.nan if r is None else _number(r["informed"])
    return Cell(_value(r, value), "", f"{int(r['informed_n'])}", "") if r and math.isfinite(value) else _NONE


def _value(r: Mapping[Any, Any], value: float | None = None) -> str:
    return measured(_number(r["value"]) if value is None else value, str(r["goal"]), _number(r["wanted"]))


def _interval(r: Mapping[Any, Any], low: float, high: float) -> str:
    """``93.6 to 97.4 %``: the unit once."""
    first, last = _value(r, low), _value(r, high)
    unit = last.partition(" ")[2]
    return f"{first.removesuffix(f' {unit}') if unit else first} to {last}"


def _bar(r: Mapping[Any, Any], low: float, high: float) -> Bar:
    value, wanted = _number(r["value"]), _number(r["wanted"])
    low, high = (low, high) if math.isfinite(low) and math.isfinite(high) else (value, value)
    share = "%" in str(r["goal"]) and wanted > 0.5
    first = max(0.0, min(wanted - 3 * (1 - wanted), low - 0.02)) if share else 0.0
    last = 1.0 if share else 1.1 * max(2 * wanted, high, value)

    def at(x: float) -> float:
        return round(_WIDTH * min(max((x - first) / (last - first), 0.0), 1.0), 1) if math.isfinite(x) else 0.0

    return Bar(at(low), at(high), at(value), at(wanted))


def _number(value: Any) -> float:
    return math.nan if value is None or pd.isna(value) else float(value)
