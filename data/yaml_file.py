"""YAML files against a pydantic model: what is wrong in one line, with the file, the line or key, and the remedy."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, ValidationError

from data.errors import InputError, closest

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

M = TypeVar("M", bound=BaseModel)


def load_yaml(path: Path, model: type[M], what: str) -> M:
    """Read and check a file; `what` names its kind in error lines ("machine file").

    Raises:
        InputError: file missing, not YAML, a key given twice or misspelt (with the closest), a wrong value.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{what} {path}: cannot be read ({reason}); give the path of a .yml file") from None
    return parse_yaml(text, model, f"{what} {path}")


def parse_yaml(text: str, model: type[M], where: str) -> M:
    """The same from text; an empty text is an empty mapping."""
    try:
        loader = _OnceOnly(text)
        node = loader.get_single_node()
        raw = {} if node is None else loader.construct_document(node)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        at = f" line {mark.line + 1}" if mark else ""
        raise InputError(f"{where}{at}: not valid YAML ({getattr(error, 'problem', error)})") from None
    if raw is None:
        raw = {}
    if not isinstance(raw, dict):
        needed = [k for k, f in model.model_fields.items() if f.is_required()] or list(model.model_fields)
        raise InputError(f"{where}: expected a mapping with the keys {' and '.join(needed)}, got {type(raw).__name__}")
    return _checked(raw, model, where, "", node)


def parse_part(raw: Any, model: type[M], where: str, key: str = "") -> M:
    """Check what YAML already gave; `key` is where the part stands in its file ("twin").

    Raises:
        InputError: as `parse_yaml`.
    """
    return _checked(raw, model, where, key, None)


def _checked(raw: Any, model: type[M], where: str, above: str, node: yaml.Node | None) -> M:
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        # a misspelt key also leaves the right one missing: the misspelling is what the user corrects
        problems = sorted(error.errors(), key=lambda p: p["type"] != "extra_forbidden")
        line = _line(node, problems[0]["loc"])
        at = f" line {line}" if line else ""
        more = f" (and {len(problems) - 1} more problem{'s' * (len(problems) > 2)})" if len(problems) > 1 else ""
        raise InputError(f"{where}{at}: {_in_words(problems[0], model, above)}{more}") from None


class _OnceOnly(yaml.SafeLoader):
    """The safe loader, which by itself would let the second of two equal keys win in silence."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.MarkedYAMLError(problem=f"key {key.value!r} is given twice", problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


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
    key = ".".join([above] * bool(above) + [str(p) for p in loc])
    if problem["type"] == "extra_forbidden":
        return f"unknown key {key!r}; {closest(str(loc[-1]), _allowed_keys(model, loc[:-1]))}"
    if problem["type"] == "missing":
        return f"key {key!r} is missing"
    return f"key {key!r}: got {problem['input']!r}; {problem['msg'].removeprefix('Value error, ')}"


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
