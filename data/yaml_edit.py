"""Edits of a YAML file's text that keep the user's comments, order, quotes and numbers as they are written.

Every plain scalar is text here, so that none is written back in another form; what a text means is for
`data.yaml_file` to say.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from textwrap import dedent, wrap
from typing import Any

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import CommentMark
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.resolver import VersionedResolver
from ruamel.yaml.tokens import CommentToken

WIDTH = 120  # characters: a longer new entry takes several lines
_NULL = ("", "~", "null", "Null", "NULL")


class _Verbatim(VersionedResolver):
    """Plain scalars are text."""

    def resolve(self, kind: Any, value: Any, implicit: Any) -> Any:
        if kind is ScalarNode and implicit and implicit[0]:
            return self.DEFAULT_SCALAR_TAG
        return super().resolve(kind, value, implicit)


class YamlText:
    """A YAML mapping to be edited; `str` gives its text. Paths are keys, and numbers within lists.

    Indentation becomes that of the text's first indented line, and what brackets or quotes hold over several lines
    stands on one.
    """

    def __init__(self, text: str) -> None:
        step = re.search(r"^( +)[^\s#-]", text, re.MULTILINE)
        items = re.search(r"^( *)[^\s#-][^\n]*:[ ]*(?:#[^\n]*)?\n(?:[ ]*(?:#[^\n]*)?\n)*( *)- ", text, re.MULTILINE)
        self._indent = len(step[1]) if step else 2
        self._offset = max(0, len(items[2]) - len(items[1])) if items else 2
        self._yaml = YAML()
        self._yaml.preserve_quotes = True
        self._yaml.width = 10**6
        self._yaml.Resolver = _Verbatim
        self._yaml.indent(mapping=self._indent, sequence=self._offset + 2, offset=self._offset)
        self._root = self._yaml.load(_comments_lifted(text) if "#" in text else text)
        if self._root is None:
            self._root = CommentedMap()
        _with_nulls(self._root)

    def __str__(self) -> str:
        out = io.StringIO()
        self._yaml.dump(self._root, out)
        return out.getvalue()

    def get(self, path: Sequence[str]) -> Any:
        """What stands at a path, None where nothing does."""
        node = self._root
        for step in path:
            node = _child(node, step)
        return node

    def set(
        self,
        path: Sequence[str],
        key: str,
        value: Any,
        comment: str = "",
        order: Sequence[str] = (),
        blocks: int = 0,
    ) -> None:
        """Put `key: value` into the mapping at `path`, which is made where it is missing or empty.

        A new entry goes behind those that `order` puts before it, else to the end; `comment` stands above it, and so
        many levels as `blocks` says are spread over lines where no brackets are around.

        Raises:
            ValueError: what stands at the path is no mapping.
        """
        around = self.get(path)
        if around is None and path:
            self.set(path[:-1], path[-1], {}, order=order)
            around = self.get(path)
        if _is_empty(around) and path:
            above = self.get(path[:-1])
            around = CommentedMap()
            if _is_flow(above):
                around.fa.set_flow_style()
            above[path[-1]] = around
            if isinstance(above, CommentedMap) and (own := above.ca.items.get(path[-1])) and own[2] is not None:
                own[2].start_mark = CommentMark(0)  # directly behind the key
        if not isinstance(around, CommentedMap):
            raise ValueError(f"{'.'.join(path)}: expected a mapping, got {str(around)!r}")
        if comment:
            self._open(path)
        lines = entry_lines(key, value, self._column([*path, key]), 0 if _is_flow(around) else blocks)
        node = YamlText(dedent("\n".join(lines)))._root[str(key)]
        if _is_flow(around):
            _make_flow(node)
        if key in around:
            tail = _take_tail(around, key)
            around[key] = node
            _put_tail(around, key, tail)
        else:
            self._insert(around, key, node, order)
        if comment:
            self.comment([*path, key], comment)

    def comment(self, path: Sequence[str], text: str) -> None:
        """Put a comment above the line of what stands at `path`.

        Raises:
            ValueError: nothing stands there.
        """
        if self.get(path) is None:
            raise ValueError(f"{'.'.join(path)}: does not stand in the file")
        while len(path) > 1 and not (isinstance(self.get(path[:-1]), CommentedMap) and not self._in_flow(path[:-1])):
            path = path[:-1]
        around, column = self.get(path[:-1]), self._column(path)
        width = max(40, WIDTH - column - 2)
        lines = [line for row in text.splitlines() for line in wrap(row, width)]
        if _is_flow(around):
            around.yaml_set_start_comment("\n".join(lines))
        else:
            around.yaml_set_comment_before_after_key(path[-1], before="\n".join(lines), indent=column)

    def _in_flow(self, path: Sequence[str]) -> bool:
        return any(_is_flow(self.get(path[:k])) for k in range(len(path) + 1))

    def _open(self, path: Sequence[str]) -> None:
        """Lines in place of the brackets around a path, so that a comment has room."""
        for k in range(len(path) + 1):
            self.get(path[:k]).fa.set_block_style()

    def _column(self, path: Sequence[str]) -> int:
        """Where an entry's line begins."""
        above = [self.get(path[:k]) for k in range(len(path) - 1)]
        return sum(self._offset + 2 if isinstance(a, CommentedSeq) else self._indent for a in above)

    def _insert(self, around: CommentedMap, key: str, node: Any, order: Sequence[str]) -> None:
        """A new entry; the comment lines that follow the one before it stay behind it."""
        names = list(around)
        before = order[: order.index(key)] if key in order else names
        at = max((k + 1 for k, name in enumerate(names) if name in before), default=0)
        tail = _take_tail(around, names[at - 1]) if at else ""
        around.insert(at, key, node)
        _put_tail(around, key, tail)


def flow(value: Any) -> str:
    """YAML of a value on one line, as it may stand between brackets as well."""
    text: str = yaml.safe_dump([value], default_flow_style=True, sort_keys=False, width=10**6, allow_unicode=True)
    return text.strip()[1:-1]


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


def _child(node: Any, step: str) -> Any:
    if isinstance(node, CommentedSeq):
        return node[int(step)] if step.isdigit() and int(step) < len(node) else None
    return node.get(step) if isinstance(node, CommentedMap) else None


def _is_flow(node: Any) -> bool:
    return isinstance(node, CommentedMap | CommentedSeq) and bool(node.fa.flow_style())


def _is_empty(node: Any) -> bool:
    return (type(node) is str and node in _NULL) or (isinstance(node, CommentedMap) and not node)


def _children(node: Any) -> list[tuple[Any, Any]]:
    return list(node.items() if isinstance(node, Mapping) else enumerate(node))


def _make_flow(node: Any) -> None:
    if isinstance(node, CommentedMap | CommentedSeq):
        node.fa.set_flow_style()
        for _, child in _children(node):
            _make_flow(child)


def _with_nulls(node: Any) -> None:
    """Empty plain scalars between brackets are named, since they would be written as ''."""
    if isinstance(node, CommentedMap | CommentedSeq):
        for key, child in _children(node):
            if _is_flow(node) and type(child) is str and child == "":
                node[key] = "null"
            _with_nulls(child)


def _comments_lifted(text: str) -> str:
    """Comments between brackets, which ruamel.yaml drops, stand above the entry that the brackets belong to."""
    depth, entry, end = 0, 0, 0
    cuts: list[tuple[int, int, str]] = []
    for token in yaml.scan(text, Loader=yaml.SafeLoader):
        start = token.start_mark.index
        if depth:
            for found in re.finditer(r"[ ]*(#[^\n]*)", text[end:start]):
                cuts.append((end + found.start(), end + found.end(), ""))
                line = text.rfind("\n", 0, entry) + 1
                indent = text[line:entry] if text[line:entry].isspace() else ""
                cuts.append((line, line, f"{indent}{found[1]}\n"))
        elif isinstance(token, yaml.KeyToken):
            entry = start
        depth += isinstance(token, yaml.FlowMappingStartToken | yaml.FlowSequenceStartToken)
        depth -= isinstance(token, yaml.FlowMappingEndToken | yaml.FlowSequenceEndToken)
        end = max(end, token.end_mark.index)
    for start, stop, new in sorted(reversed(cuts), key=lambda c: c[0], reverse=True):
        text = text[:start] + new + text[stop:]
    return text


def _leaf(node: Any, key: Any) -> tuple[Any, Any, int]:
    """The container and key of the last thing in an entry, and where its comment is kept."""
    child = node[key]
    while isinstance(child, CommentedMap | CommentedSeq) and len(child) and not _is_flow(child):
        node, key = child, _children(child)[-1][0]
        child = node[key]
    return node, key, 2 if isinstance(node, CommentedMap) else 0


def _take_tail(node: Any, key: Any) -> str:
    """Blank and comment lines that follow an entry, taken from it."""
    node, key, slot = _leaf(node, key)
    kept = node.ca.items.get(key)
    if not kept or kept[slot] is None:
        return ""
    own, _, tail = kept[slot].value.partition("\n")
    if own:
        kept[slot].value = own + "\n"
    else:
        kept[slot] = None
    return str(tail)


def _put_tail(node: Any, key: Any, tail: str) -> None:
    if not tail:
        return
    node, key, slot = _leaf(node, key)
    kept = node.ca.items.setdefault(key, [None, None, None, None])
    if kept[slot] is None:
        kept[slot] = CommentToken("\n", CommentMark(0), None)
    kept[slot].value += tail
