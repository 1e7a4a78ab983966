"""Export: one JSON file with the operations as plain data, for any reader."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import ClassVar

from compensation.exports.base import Export, Exporter

SCHEMA = "thermodrift.export/1"
OPERATIONS: Mapping[str, str] = {
    "input": "the row's channels in their order, a missing one at its last value",
    "constant": "value",
    "join": "all arguments, one behind the other",
    "pick": "x[places], counted from 0",
    "affine": "matrix @ x + offset",
    "add": "a + b",
    "min": "the smaller of a and b, element by element",
    "max": "the larger of a and b, element by element",
    "less": "1 where a < b, else 0",
    "equal": "1 where a = b, else 0",
    "select": "b where a is 1, c where a is 0",
    "previous": "what the argument, a later node, was in the row before; `initial` in the first row",
    "sub": "a - b",
    "mul": "a * b, element by element",
    "power": "|x| ** exponents, element by element",
    "median": "median of x, one value",
    "first": "x of the first row",
    "lag": "v = keep * v + (1 - keep) * x; in the first row v = begin * x",
    "delay": "(1 - part) * (x `rows` rows earlier) + part * (x one more row earlier); before the first row begin * "
    "(x of the first row)",
    "rate": "(x - x `rows` rows earlier) per hour; from the first row while that is nearer; 0 in the first row",
    "clock": "s since the first row",
    "curve": "values at x, linear between knots, held beyond",
    "tanh": "tanh x",
    "kernel": "weights @ exp(-|support - x|^2 * sharpness)",
    "trees": "sum over roots: from node = root, node = left[node] if x[feature[node]] <= threshold[node] else "
    "right[node], until node is its own child; value[node]. With single, x is rounded to single precision first",
}
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
