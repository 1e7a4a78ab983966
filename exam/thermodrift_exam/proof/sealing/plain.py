"""A diagnosis as plain data that a confined process can return: all that a page shows, as one JSON text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import pandas as pd

from data.errors import InputError
from data.machine import Machine
from diagnosis.findings.schema import Findings
from diagnosis.result import Diagnosis
from twin.schema import TwinPart


def plain_text(d: Diagnosis) -> str:
    """The findings, the network before and after, the plan of the next run and every table; numbers to the last digit.

    Values that only the machine file needs (fitted values, intervals) are left out.
    """
    value = {
        "findings": d.findings.model_dump(mode="json", by_alias=True),
        "simulated": d.simulated,
        "drafted": d.drafted,
        "remarks": list(d.remarks),
        "part_before": _part(d.part_before),
        "part_after": _part(d.part_after),
        "plan_text": d.plan_text,
        "tables": {name: _table(table) for name, table in d.tables.items()},
    }
    return json.dumps(value, ensure_ascii=False, default=_number)


def from_plain(text: str, machine: Machine, where: str = "answer") -> Diagnosis:
    """The diagnosis of a machine from `plain_text`.

    Raises:
        InputError: it is none, with `where` at the start of the line.
    """
    try:
        raw = json.loads(text)
        return Diagnosis(
            machine=machine,
            findings=Findings.from_json(raw["findings"], where),
            part_before=TwinPart.model_validate(raw["part_before"]),
            part_after=TwinPart.model_validate(raw["part_after"]),
            simulated=raw["simulated"],
            drafted=raw["drafted"],
            remarks=tuple(raw["remarks"]),
            tables={name: _frame(table) for name, table in raw["tables"].items()},
            plan_text=raw["plan_text"],
        )
    except (ValueError, KeyError, TypeError) as error:
        said = " ".join(str(error).split())
        raise InputError(f"{where}: is no diagnosis ({said}); diagnose again") from None


def _part(part: TwinPart) -> Any:
    return part.model_dump(mode="json", by_alias=True, exclude_unset=True)


def _table(table: pd.DataFrame) -> dict[str, Any]:
    """By column its type and values; a number that is not known is NaN, as Python's JSON writes it."""
    columns = [(str(name), str(table[name].dtype), table[name].tolist()) for name in table.columns]
    return {"rows": len(table), "columns": [{"name": n, "type": t, "values": v} for n, t, v in columns]}


def _frame(raw: Mapping[str, Any]) -> pd.DataFrame:
    columns = {c["name"]: pd.Series(c["values"], dtype=c["type"]) for c in raw["columns"]}
    return pd.DataFrame(columns, index=range(raw["rows"]))


def _number(value: Any) -> Any:
    """A numpy scalar among the values of an object column or of the evidence."""
    if hasattr(value, "item"):
        return value.item()
    raise TypeError(f"{type(value).__name__} is no plain data")
