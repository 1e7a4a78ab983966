"""Export: one JSON file with the operations as plain data, for any reader."""

from __future__ import annotations

import json
import re
from typing import ClassVar

from compensation.exports.base import Export, Exporter
from models.program import OPERATIONS

SCHEMA = "thermodrift.export/1"
_NUMBERS = re.compile(r"\[\n([-+\d.eE,\s]+)\]")  # a list of numbers over several lines, which no string has
ROWS = (
    "The first row is that at which every channel has been seen. The state passes over a missing channel at its last "
    "value; a row without a required channel has no output."
)


class JsonExport(Exporter):
    """Operations, constants and statement in one file; schema `SCHEMA`."""

    key: ClassVar[str] = "json"
    summary: ClassVar[str] = "one JSON file: operations as plain data with their meaning, units, limits and version"
    suffix: ClassVar[str] = ".json"

    def files(self, export: Export) -> dict[str, str | bytes]:
        axes = [a.described() | {"program": a.program.as_plain()} for a in export.axes]
        used = {n.op for a in export.axes for n in a.program.nodes}
        meaning = {op: text for op, text in OPERATIONS.items() if op in used}
        whole = {"schema": SCHEMA, **export.described(), "rows": ROWS, "operations": meaning, "axes": axes}
        text = json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False, default=lambda array: array.tolist())
        text = _NUMBERS.sub(lambda m: f"[{' '.join(m[1].split())}]", text)
        return {f"{export.stem}{self.suffix}": text + "\n"}
