"""A new or changed entry in a machine file's text: every comment, order and style of the rest stays.

Works on block style, on flow style over one or several lines, on empty mappings and on missing ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import yaml

from twin.diagnosis.writing.short_yaml import WIDTH, comment_lines, entry_lines, flow


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
