"""YAML files against a pydantic model: what is wrong in one line, with the file, the line or key, and the remedy."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_origin
from zoneinfo import available_timezones

import yaml
from pydantic import AfterValidator, BaseModel, ValidationError
from yaml.composer import Composer

from data.errors import InputError, closest, masked

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

M = TypeVar("M", bound=BaseModel)


def _time_zone(name: str) -> str:
    if name not in available_timezones():
        raise ValueError(f"unknown time zone {name!r}; {closest(name, sorted(available_timezones()))}")
    return name


TimeZone = Annotated[str, AfterValidator(_time_zone)]

MAX_BYTES = 1_000_000  # ten times a machine file with a thousand channels; a file of this size takes ten seconds
MAX_DEPTH = 50  # far below the depth at which Python's own recursion ends
MAX_REPEATED = 10_000  # values that all aliases (*name) of a file stand for together
_CHARACTERS_A_VALUE = 100  # a longer text counts as several values
_MAX_DIGITS = 100  # Python takes quadratic time for long numbers, and does not write them
_SHOWN = 300  # characters of a wrong value that an error line shows


def load_yaml(path: Path, model: type[M], what: str, every: bool = False) -> M:
    """Read and check a file; `what` names its kind in error lines ("machine file").

    Args:
        every: a line for every mistake, instead of the first with the number of the others.

    Raises:
        InputError: file missing, not YAML, a key given twice or misspelt (with the closest), a wrong value, or more
            than `parse_plain` allows.
    """
    try:
        with path.open("rb") as file:
            body = file.read(MAX_BYTES + 1)
        text = body.decode("utf-8", "strict" if len(body) <= MAX_BYTES else "replace")  # what was cut is refused below
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{what} {path}: cannot be read ({reason}); give the path of a .yml file") from None
    return parse_yaml(text, model, f"{what} {path}", every)


def parse_yaml(text: str, model: type[M], where: str, every: bool = False) -> M:
    """The same from text; an empty text is an empty mapping."""
    raw, node = _plain(text, where)
    if raw is None:
        raw = {}
    if not isinstance(raw, dict):
        needed = [k for k, f in model.model_fields.items() if f.is_required()] or list(model.model_fields)
        raise InputError(f"{where}: expected a mapping with the keys {' and '.join(needed)}, got {type(raw).__name__}")
    return _checked(raw, model, where, "", node, every)


def parse_plain(text: str, where: str) -> Any:
    """Plain data from YAML text, without a model; None from an empty text.

    Raises:
        InputError: not YAML, a key given twice, more than 1 MB, more than 50 levels of nesting, or aliases that
            contain themselves or stand for more than 10000 values.
    """
    return _plain(text, where)[0]


def _plain(text: str, where: str) -> tuple[Any, yaml.Node | None]:
    if len(text) > MAX_BYTES or len(text.encode("utf-8", "replace")) > MAX_BYTES:
        raise InputError(
            f"{where}: more than {MAX_BYTES / 1e6:g} MB, expected a file written by hand; give the right one"
        )
    try:
        loader = _Bounded(text)
        node = loader.get_single_node()
        return None if node is None else loader.construct_document(node), node
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        at = f" line {mark.line + 1}" if mark else ""
        reason = " ".join(str(getattr(error, "problem", None) or error).split())
        raise InputError(f"{where}{at}: not valid YAML ({reason})") from None


def parse_part(raw: Any, model: type[M], where: str, key: str = "") -> M:
    """Check what YAML already gave; `key` is where the part stands in its file ("twin").

    Raises:
        InputError: as `parse_yaml`.
    """
    return _checked(raw, model, where, key, None)


def _checked(raw: Any, model: type[M], where: str, above: str, node: yaml.Node | None, every: bool = False) -> M:
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        # a misspelt key also leaves the right one missing: the misspelling is what the user corrects
        problems = sorted(error.errors(), key=lambda p: p["type"] != "extra_forbidden")
        shown = problems if every else problems[:1]
        numbers = [_line(node, p["loc"]) for p in shown]
        lines = [
            f"{where}{f' line {n}' if n else ''}: {_in_words(p, model, above)}"
            for n, p in zip(numbers, shown, strict=True)
        ]
        left = len(problems) - len(shown)
        more = f" (and {left} more problem{'s' * (left > 1)})" if left else ""
        raise InputError("\n".join(lines) + more) from None


class _Bounded(Composer, yaml.CSafeLoader):
    """The safe loader with bounds on depth and aliases, a line for every wrong value, and each key once.

    libyaml reads the text, in a fifth of the time; Python composes the nodes, so that they can be counted.

    PyYAML shares the object that several aliases name, so that a bomb costs nothing until something walks over it.
    The bound therefore counts each alias as all the values that it stands for.
    """

    def __init__(self, text: str) -> None:
        yaml.CSafeLoader.__init__(self, text.encode("utf-8", "surrogatepass"))  # half a pair of UTF-16 is refused
        self.anchors: dict[str, yaml.Node] = {}
        self._depth = 0
        self._values = 0  # composed so far, with those behind aliases
        self._repeated = 0  # of these, those behind aliases
        self._sizes: dict[str, int] = {}  # anchor -> values below it

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event: Any = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            self._repeat(event)
            return super().compose_node(parent, index)
        if self._depth >= MAX_DEPTH:
            raise _problem(f"more than {MAX_DEPTH} levels of nesting", event.start_mark)
        before = self._values
        self._depth, self._values = self._depth + 1, before + 1
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        if isinstance(node, yaml.ScalarNode):
            self._values += len(node.value) // _CHARACTERS_A_VALUE
        if event.anchor is not None:
            self._sizes[event.anchor] = self._values - before
        return node

    def _repeat(self, event: yaml.AliasEvent) -> None:
        anchor = event.anchor or ""
        if anchor in self.anchors and anchor not in self._sizes:
            raise _problem(f"alias *{anchor} contains itself; write its values out", event.start_mark)
        size = self._sizes.get(anchor, 0)
        self._values, self._repeated = self._values + size, self._repeated + size
        if self._repeated > MAX_REPEATED:
            reason = f"the aliases up to *{anchor} stand for more than {MAX_REPEATED} values; write fewer"
            raise _problem(reason, event.start_mark)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            if node.tag in _NUMBERS and len(node.value) > _MAX_DIGITS:
                raise ValueError
            return super().construct_object(node, deep)
        except yaml.YAMLError:
            raise
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError):
            # PyYAML passes on what int, float, date and dict raise
            tag = node.tag.rpartition(":")[2]
            shown = f"{str(node.value)[:40]!r} is no valid {tag}" if isinstance(node, yaml.ScalarNode) else f"bad {tag}"
            raise _problem(f"{shown}; correct it, or put it in quotes", node.start_mark) from None

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping; the plain loader would let the second of two equal keys win without a word."""
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _problem("a key is a list or a mapping, expected text or a number", key.start_mark)
            if key.value in seen:
                raise _problem(f"key {key.value!r} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")


def _problem(text: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=text, problem_mark=mark)


def _line(node: yaml.Node | None, loc: Sequence[Any]) -> int | None:
    """The line, counted from 1, of the deepest key or list entry of the file on an error's location."""
    line = None
    for step in loc:
        if isinstance(node, yaml.MappingNode):
            found = next(((k, v) for k, v in node.value if k.value == str(step)), None)
            if found is not None:
                line, node = found[0].start_mark.line + 1, found[1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(step, int) and step < len(node.value):
            node = node.value[step]
            line = node.start_mark.line + 1
    return line


def _in_words(problem: ErrorDetails, model: type[BaseModel], above: str) -> str:
    """One problem; keys stand below `above`."""
    loc = problem["loc"]
    key = ".".join([above] * bool(above) + [str(p) for p in loc if p != "[key]"])
    if problem["type"] == "extra_forbidden":
        return f"unknown key {key!r}; {closest(str(loc[-1]), _allowed_keys(model, loc[:-1]))}"
    if problem["type"] == "missing":
        return f"key {key!r} is missing"
    got = masked(repr(problem["input"]))
    got = got if len(got) <= _SHOWN else f"{got[: _SHOWN // 2]}…{got[-_SHOWN // 2 :]}"
    return f"key {key!r}: got {got}; {problem['msg'].removeprefix('Value error, ')}"


def _allowed_keys(annotation: Any, loc: Sequence[Any]) -> list[str]:
    """Keys of the model that an error's location points into, from the type at its beginning."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if not loc:
            return sorted(annotation.model_fields)
        field = annotation.model_fields.get(str(loc[0]))
        return _allowed_keys(field.annotation, loc[1:]) if field is not None else []
    inner, origin = get_args(annotation), get_origin(annotation)
    if isinstance(origin, type) and issubclass(origin, Collection):
        return _allowed_keys(inner[-1], loc[1:]) if loc else []
    return next((keys for part in inner if (keys := _allowed_keys(part, loc))), [])
