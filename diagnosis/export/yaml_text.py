"""Parts of a twin as YAML in the house's short style: values as "10 W/K", what fits a line on one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import yaml
from pydantic import BaseModel

from twin.compiling import parameters as specs
from twin.mechanisms import MECHANISMS
from twin.quantity import Spec, Value
from twin.schema import Exposure, Link, MechanismPart, TwinPart

WIDTH = 120
DIGITS = 5  # what a calibrated file keeps of a value
_FIELDS = {
    s.name: s for s in (specs.CAPACITY, specs.MASS, specs.CONDUCTANCE, specs.AREA, specs.COEFFICIENT, specs.LENGTH,
                        specs.OFFSET, specs.TEMPERATURE, *specs.MATERIAL.values(), Spec("lag", "s", ""))
} | {n: specs.LENGTH for n in ("width", "thickness", "height", "depth", "lever")}  # fmt: skip


def plain(model: BaseModel, key: str = "") -> Any:
    """What YAML is to hold of a part of a twin: no defaults, bare numbers with their units, short forms.

    `key` is its name in the file: a link ``a-b`` between a and b need not say so again.
    """
    owned = {s.name: s for s in MECHANISMS[model.law].parameters} if isinstance(model, MechanismPart) else {}
    out: dict[str, Any] = {}
    for name, field in type(model).model_fields.items():
        held = getattr(model, name)
        if field.is_required() or held != field.get_default(call_default_factory=True):
            out[name] = _plain(held, name, owned)
    ends: dict[str, Any] = {"between": key.split("-")} if isinstance(model, Link) else {}
    if isinstance(model, Exposure):
        ends = dict(zip(("of", "to"), key.split("-"), strict=False))
    if ends and all(out.get(k) == v for k, v in ends.items()):
        out = {k: v for k, v in out.items() if k not in ends}
        return out["conductance"] if set(out) == {"conductance"} else out
    return out


def tidied(value: Value) -> Value:
    """The value with its bare numbers rounded as the file keeps them."""
    update: dict[str, Any] = {k: _rounded(getattr(value, k)) for k in ("value", "spread", "prior")}
    for k in ("bounds", "interval90"):
        ends = getattr(value, k)
        update[k] = None if ends is None else tuple(_rounded(v) for v in ends)
    return value.model_copy(update=update)


def flow(value: Any) -> str:
    """On one line."""
    text: str = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10**6, allow_unicode=True)
    return text.removesuffix("...\n").strip()


def entry_lines(key: str, value: Any, column: int, blocks: int = 0) -> list[str]:
    """``key: value`` indented by `column`, over several lines where one does not hold it, or in so many `blocks`."""
    indent, name = " " * column, flow(key)
    one = f"{indent}{name}: {flow(value)}"
    if not isinstance(value, dict | list) or not value or (len(one) <= WIDTH and not blocks):
        return [one]
    if isinstance(value, list):
        return [one] if len(one) <= WIDTH else [f"{indent}{name}:", *(f"{indent}  - {flow(item)}" for item in value)]
    return [
        f"{indent}{name}:",
        *(line for k, v in value.items() for line in entry_lines(k, v, column + 2, max(blocks - 1, 0))),
    ]


def part_plain(part: TwinPart) -> dict[str, Any]:
    """A whole twin part for YAML."""
    out: dict[str, Any] = {}
    for group, field in TwinPart.model_fields.items():
        held = getattr(part, group)
        if isinstance(held, BaseModel):
            out[group] = plain(held)
        elif isinstance(held, Mapping):
            out |= {group: {k: plain(v, k) for k, v in held.items()}} if held else {}
        elif held != field.default:
            out[group] = held
    return out


def _plain(held: Any, name: str, owned: Mapping[str, Spec]) -> Any:
    if isinstance(held, Value):
        return _value(held, owned.get(name) or _FIELDS.get(name))
    if isinstance(held, BaseModel):
        return plain(held)
    if isinstance(held, Mapping):
        return {k: _plain(v, str(k), owned) for k, v in held.items()}
    if isinstance(held, tuple):
        return [_plain(v, name, owned) for v in held]
    return held


def _value(held: Value, spec: Spec | None) -> Any:
    unit = spec.unit if spec and spec.unit != "1" else ""
    delta = {"degC": "K"}.get(unit, unit) if spec and spec.scale == "linear" else ""
    told = {k: v for k, v in tidied(held) if v is not None and v != ""}
    for k, own in (("value", unit), ("prior", unit), ("spread", delta)):
        if own and isinstance(told.get(k), int | float):
            told[k] = f"{told[k]:.{DIGITS}g} {own}"
    told = {k: [_short(e) for e in v] if isinstance(v, tuple) else _short(v) for k, v in told.items()}
    return told["value"] if set(told) == {"value"} else told


def _short(number: Any) -> Any:
    """54 instead of 54.0."""
    return int(number) if isinstance(number, float) and number.is_integer() and abs(number) < 1e9 else number


def _rounded(number: Any) -> Any:
    return float(f"{number:.{DIGITS}g}") if isinstance(number, float) else number


def comment_lines(text: str, column: int) -> list[str]:
    """The text as comment lines, wrapped."""
    width = max(40, WIDTH - column - 2)
    return [f"{' ' * column}# {line}" for row in text.splitlines() for line in wrap(row, width)]


@dataclass(frozen=True)
class _Entry:
    """A key with its value; `inside` says whether a flow-style mapping is around it."""

    key: yaml.Node
    value: yaml.Node
    inside: bool


def with_entry(
    text: str, path: Sequence[str], key: str, value: Any, comment: str = "", order: Sequence[str] = (), blocks: int = 0
) -> str:
    """The text with `key: value` in the mapping at `path` (made where it is missing), replacing what stands there.

    A new one goes behind those that `order` puts before it, else to the end; `comment` stands above it,
    and so many levels as `blocks` says are spread over lines where brackets are not around.

    Raises:
        ValueError: what stands at the path is no mapping.
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    around = _Entry(root, root, is_flow(root)) if root is not None and not path else entry_at(root, path)
    if around is None:
        made = with_entry(text, path[:-1], path[-1], {}, "", order)
        return with_entry(made, path, key, value, comment, order, blocks)
    if _is_empty(around.value):
        return _first(text, around, key, value, comment)
    if not isinstance(around.value, yaml.MappingNode):
        raise ValueError(f"{'.'.join(path)}: expected a mapping, got {text[_span(around.value)]!r}")
    held = _held(around.value, key)
    if held is not None:
        entry = _Entry(*held, around.inside or is_flow(around.value))
        new = _replaced(text, entry, value, blocks)
        return with_comment(new, [*path, key], comment) if comment else new
    if around.inside or is_flow(around.value):
        return _flow_end(text, around.value, key, value, comment)
    return _block_end(text, around.value, key, value, comment, order, blocks)


def with_comment(text: str, path: Sequence[str], comment: str) -> str:
    """The text with a comment above the line of what stands at `path`.

    Raises:
        ValueError: nothing stands there.
    """
    entry = entry_at(yaml.compose(text, Loader=yaml.SafeLoader), path)
    if entry is None:
        raise ValueError(f"{'.'.join(path)}: does not stand in the file")
    at = text.rfind("\n", 0, entry.key.start_mark.index) + 1
    for token in reversed(_tokens(text)):  # never in the midst of a text of several lines
        if token.start_mark.index < at < token.end_mark.index:
            at = text.rfind("\n", 0, token.start_mark.index) + 1
    column = len(text[at:]) - len(text[at:].lstrip(" "))
    return text[:at] + "".join(f"{line}\n" for line in comment_lines(comment, column)) + text[at:]


def entry_at(root: yaml.Node | None, path: Sequence[str]) -> _Entry | None:
    """The entry at a path of keys (numbers in lists), None where it does not stand in the text."""
    entry, node, inside = None, root, False
    for step in path:
        inside = inside or is_flow(node)
        if isinstance(node, yaml.SequenceNode) and step.isdigit() and int(step) < len(node.value):
            node = node.value[int(step)]
            entry = _Entry(node, node, inside)
            continue
        held = _held(node, step)
        if held is None:
            return None
        entry, node = _Entry(*held, inside), held[1]
    return entry


def is_flow(node: yaml.Node | None) -> bool:
    """Whether a mapping or list stands in brackets."""
    return isinstance(node, yaml.CollectionNode) and bool(node.flow_style)


def steps_of(text: str, path: str) -> list[str]:
    """The keys below `twin` that lead to a parameter's path, as far as the text holds it.

    Parameters of a mechanism stand a level deeper than their path says, a lone conductance a level higher.
    """
    root, out = yaml.compose(text, Loader=yaml.SafeLoader), ["twin"]
    for step in path.replace("[", ".").replace("]", "").split("."):
        deeper = next((d for d in ([step], ["parameters", step]) if entry_at(root, [*out, *d])), None)
        if deeper is None:
            break
        out += deeper
    return out[1:]


def _held(node: yaml.Node | None, key: str) -> tuple[yaml.Node, yaml.Node] | None:
    if not isinstance(node, yaml.MappingNode):
        return None
    return next(((k, v) for k, v in node.value if k.value == key), None)


def _is_empty(node: yaml.Node) -> bool:
    null = isinstance(node, yaml.ScalarNode) and node.tag == "tag:yaml.org,2002:null"
    return null or (isinstance(node, yaml.MappingNode) and not node.value)


def _first(text: str, around: _Entry, key: str, value: Any, comment: str) -> str:
    """Into ``{}`` or nothing at all."""
    start, end = around.value.start_mark.index, around.value.end_mark.index
    if around.inside:
        return f"{text[:start].rstrip(' ')} {{{flow(key)}: {flow(value)}}}{text[end:]}"
    before, behind = text[:start].rstrip(" "), text[end:]
    line, newline, rest = behind.partition("\n")
    column = around.key.start_mark.column + 2
    block = "\n".join([*comment_lines(comment, column), *entry_lines(key, value, column)])
    return f"{before}{line.rstrip()}\n{block}{newline or chr(10)}{rest}"


def _replaced(text: str, entry: _Entry, value: Any, blocks: int) -> str:
    start, column = entry.key.end_mark.index, entry.key.start_mark.column
    tokens = [t for t in _tokens(text) if t.start_mark.index >= start]
    colon = next(t for t in tokens if isinstance(t, yaml.ValueToken)).end_mark.index
    if entry.value.start_mark.index < start:  # an alias: its node stands elsewhere
        end = next(t for t in tokens if isinstance(t, yaml.AliasToken)).end_mark.index
    else:
        end = max(_content_end(text, entry.value), colon)
    lines = entry_lines(entry.key.value, value, column, 0 if entry.inside else blocks)
    fits = entry.inside or len(lines) == 1
    new = f" {flow(value)}" if fits else "\n" + "\n".join(lines[1:])
    return text[:colon] + new + text[end:]


def _block_end(
    text: str, around: yaml.MappingNode, key: str, value: Any, comment: str, order: Sequence[str], blocks: int
) -> str:
    column = around.value[0][0].start_mark.column
    before = order[: order.index(key)] if key in order else ()
    last = max((k for k, (name, _) in enumerate(around.value) if name.value in before), default=len(around.value) - 1)
    limit = around.value[last + 1][0].start_mark.index if last + 1 < len(around.value) else around.end_mark.index
    end = text.find("\n", _end_before(text, limit))
    end = len(text) if end < 0 else end
    block = "\n".join([*comment_lines(comment, column), *entry_lines(key, value, column, blocks)])
    return f"{text[:end]}\n{block}{text[end:] or chr(10)}"


def _flow_end(text: str, around: yaml.MappingNode, key: str, value: Any, comment: str) -> str:
    brace = around.end_mark.index - 1
    last = [t for t in _tokens(text) if t.end_mark.index <= brace][-1]
    comma = "" if isinstance(last, yaml.FlowEntryToken) else ","
    gap, entry = text[last.end_mark.index : brace], f"{flow(key)}: {flow(value)}"
    line = text.rfind("\n", 0, around.start_mark.index) + 1
    column = len(text[line:]) - len(text[line:].lstrip(" "))
    told = "".join(f"\n{line}" for line in comment_lines(comment, column + 2))
    if told or "\n" in gap or brace - text.rfind("\n", 0, brace) + len(entry) > WIDTH:
        told += f"\n{' ' * (column + 2)}"
    else:
        told = " "
    kept, closing = gap.rstrip(), gap[len(gap.rstrip()) :]
    return text[: last.end_mark.index] + comma + kept + told + entry + closing + text[brace:]


def _content_end(text: str, node: yaml.Node) -> int:
    """Behind the last character of a value, without the comments and blanks that follow it."""
    if isinstance(node, yaml.ScalarNode) or is_flow(node):
        end = node.end_mark.index
        return len(text[:end].rstrip()) if end > node.start_mark.index else end
    return _end_before(text, node.end_mark.index)


def _end_before(text: str, limit: int) -> int:
    """Behind the last thing that is no comment before a place."""
    last = [t for t in _tokens(text) if t.start_mark.index < limit][-1]
    return len(text[: last.end_mark.index].rstrip())


def _tokens(text: str) -> list[Any]:
    """What stands in the text, in order: keys, values, brackets; no comments, no blanks."""
    return [t for t in yaml.scan(text, Loader=yaml.SafeLoader) if t.end_mark.index > t.start_mark.index]


def _span(node: yaml.Node) -> slice:
    return slice(node.start_mark.index, node.end_mark.index)
