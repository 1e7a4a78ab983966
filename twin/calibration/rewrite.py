"""New values in a machine file's text: every comment, order and style of the file stays as its author wrote it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import yaml

from data.errors import InputError
from twin.quantity import Parameter


@dataclass(frozen=True)
class Update:
    """One parameter's new value and 90 % interval, in the parameter's unit."""

    parameter: Parameter
    value: float
    interval90: tuple[float, float]


def with_values(text: str, updates: Mapping[str, Update], where: str) -> str:
    """The machine file's text with calibrated values; each keeps its prior's centre beside it.

    `updates` by parameter path ("links.shaft-front.conductance").

    Raises:
        InputError: a path that the text does not hold as a value of its own (an anchor, a mechanism's default).
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    edits: list[tuple[int, int, str]] = []
    for path, update in updates.items():
        node = _find(root, ["twin", *_steps(path)])
        if node is None:
            raise InputError(
                f"{where}: twin.{path} does not stand in the file as a value with a spread; write it there"
            )
        edits += _edits(node, update)
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def with_calibrated(text: str, lines: str) -> str:
    """The text with the twin part's `calibrated` entry replaced by `lines` (YAML of a mapping, not indented)."""
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    twin = _entry(root, "twin")
    if not isinstance(twin, yaml.MappingNode):
        return text
    indent = " " * twin.value[0][0].start_mark.column
    block = f"{indent}calibrated:\n" + "".join(f"{indent}  {line}\n" for line in lines.rstrip().splitlines())
    for key, value in twin.value:
        if key.value == "calibrated":
            start = key.start_mark.index - key.start_mark.column
            end = text.rfind("\n", 0, value.end_mark.index) + 1  # the mark stands behind the next key's indentation
            return text[:start] + block + text[end:]
    first = twin.value[0][0].start_mark
    at = first.index - first.column
    return text[:at] + block + text[at:]


def _steps(path: str) -> list[str]:
    """ "errors.z.chain[0].length" → errors, z, chain, 0, length."""
    return path.replace("[", ".").replace("]", "").split(".")


def _find(node: yaml.Node | None, steps: list[str]) -> yaml.Node | None:
    """The node at a path; parameters stand a level deeper, a lone conductance a level higher, than their path."""
    while steps and node is not None:
        here = _entry(node, steps[0])
        if here is None and steps[0] == "conductance" and _entry(node, "value") is not None:
            here = node
        if here is None:
            deeper = _entry(node, "parameters")
            here = _entry(deeper, steps[0]) if deeper is not None else None
        node, steps = here, steps[1:]
    return node


def _entry(node: yaml.Node | None, key: str) -> yaml.Node | None:
    if isinstance(node, yaml.SequenceNode):
        return node.value[int(key)] if key.isdigit() and int(key) < len(node.value) else None
    if not isinstance(node, yaml.MappingNode):
        return None
    return next((v for k, v in node.value if k.value == key), None)


def _edits(node: yaml.Node, update: Update) -> list[tuple[int, int, str]]:
    """Replacements (start, end, new text) that turn a value into a calibrated one."""
    p = update.parameter
    low, high = (_number(v) for v in update.interval90)
    value, prior = (f"{_number(v)} {p.unit}" if p.unit != "1" else _number(v) for v in (update.value, p.prior_value))
    news = {"value": value, "prior": prior, "interval90": f"[{low}, {high}]"}
    if not isinstance(node, yaml.MappingNode):
        return [
            (node.start_mark.index, node.end_mark.index, "{" + ", ".join(f"{k}: {v}" for k, v in news.items()) + "}")
        ]
    edits = []
    for key, new in news.items():
        old = _entry(node, key)
        if old is not None:
            edits.append((old.start_mark.index, old.end_mark.index, new))
    missing = [f"{k}: {v}" for k, v in news.items() if _entry(node, k) is None]
    at, column = node.value[-1][1].end_mark.index, node.value[0][0].start_mark.column
    glue = ", " if node.flow_style else "\n" + " " * column
    return [*edits, (at, at, "".join(glue + m for m in missing))] if missing else edits


def _number(value: float) -> str:
    """Five digits: more than any calibration knows."""
    return f"{value:.5g}"
