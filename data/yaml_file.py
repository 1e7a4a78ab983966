"""YAML files against a pydantic model: what is wrong in one line, with the file, the line or key, and the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from data.errors import InputError, closest

M = TypeVar("M", bound=BaseModel)


def load_yaml(path: Path, model: type[M], what: str) -> M:
    """Read and check a file; `what` names its kind in error lines ("machine file").

    Raises:
        InputError: file missing, not YAML, a key given twice or misspelt (with the closest), a wrong value.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{what} {path}: cannot be read ({error}); give the path of a .yml file") from None
    return parse_yaml(text, model, f"{what} {path}")


def parse_yaml(text: str, model: type[M], where: str) -> M:
    """The same from text; an empty text is an empty mapping."""
    try:
        raw = _OnceOnly(text).get_single_data()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        at = f" line {mark.line + 1}" if mark else ""
        raise InputError(f"{where}{at}: not valid YAML ({getattr(error, 'problem', error)})") from None
    if raw is None:
        raw = {}
    if not isinstance(raw, dict):
        needed = [k for k, f in model.model_fields.items() if f.is_required()] or list(model.model_fields)
        raise InputError(f"{where}: expected a mapping with the keys {' and '.join(needed)}, got {type(raw).__name__}")
    return parse_part(raw, model, where)


def parse_part(raw: Any, model: type[M], where: str, key: str = "") -> M:
    """Check what YAML already gave; `key` is where the part stands in its file ("twin").

    Raises:
        InputError: as `parse_yaml`.
    """
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise InputError(f"{where}: {_first_problem(error, model, key)}") from None


class _OnceOnly(yaml.SafeLoader):
    """The safe loader, which by itself would let the second of two equal keys win in silence."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.MarkedYAMLError(problem=f"key {key.value!r} is given twice", problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _first_problem(error: ValidationError, model: type[BaseModel], above: str) -> str:
    """The first problem in words, and how many more follow; keys stand below `above`."""
    problems = error.errors()
    first = problems[0]
    key = ".".join([above] * bool(above) + [str(p) for p in first["loc"]])
    if first["type"] == "extra_forbidden":
        text = f"unknown key {key!r}; {closest(str(first['loc'][-1]), _allowed_keys(model, first['loc'][:-1]))}"
    elif first["type"] == "missing":
        text = f"key {key!r} is missing"
    else:
        text = f"key {key!r}: got {first['input']!r}; {first['msg'].removeprefix('Value error, ')}"
    return text + (f" (and {len(problems) - 1} more problems)" if len(problems) > 1 else "")


def _allowed_keys(model: type[BaseModel], loc: Sequence[Any]) -> list[str]:
    """Keys of the model that an error's location points into."""
    part: Any = model
    for step in loc:
        if _is_model(part):
            part = part.model_fields[str(step)].annotation if str(step) in part.model_fields else part
        part = next((a for a in getattr(part, "__args__", ()) if _is_model(a)), part)
    return sorted(part.model_fields) if _is_model(part) else []


def _is_model(part: Any) -> bool:
    return isinstance(part, type) and issubclass(part, BaseModel)
