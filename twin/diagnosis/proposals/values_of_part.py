"""A twin part's values by the names that its network's parameters have ("links.shaft-front.conductance")."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from twin.quantity import Parameter, Value
from twin.schema import MechanismPart, TwinPart

PLACES = ("materials", "surroundings", "bodies", "links", "exposures", "mechanisms", "sensors", "errors")  # by name
_INDEX = re.compile(r"^(\w+)\[(\d+)\]$")


def with_parts(part: TwinPart, parts: Mapping[str, BaseModel | None]) -> TwinPart:
    """The part with others in it by path ("bodies.bed"), new or in place of what was there; None takes one out."""
    update: dict[str, dict[str, Any]] = {}
    for path, given in parts.items():
        group, name = path.split(".", 1)
        members = update.setdefault(group, dict(getattr(part, group)))
        if given is None:
            members.pop(name, None)
        else:
            members[name] = given
    return part.model_copy(update=update)


def with_value(part: TwinPart, parameter: Parameter, **changes: Any) -> TwinPart:
    """The part in which one parameter's value is changed (`value`, `spread`, `per_batch`, …), written out if it was
    a default.

    Raises:
        ValueError: the part does not state it and cannot (a built-in material's property).
    """
    group, rest = parameter.name.split(".", 1)
    name, steps = _split(part, group, rest)
    members = dict(getattr(part, group))
    if name not in members:
        raise ValueError(f"twin.{parameter.name}: is no value of the machine file; state it there first")
    members[name] = _changed(members[name], steps, parameter, changes)
    return part.model_copy(update={group: members})


def _split(part: TwinPart, group: str, rest: str) -> tuple[str, list[str]]:
    """A member's name may hold dots of its own ("column@0.8-bed"): the longest that the part knows."""
    words = rest.split(".")
    for n in range(len(words) - 1, 0, -1):
        if ".".join(words[:n]) in getattr(part, group):
            return ".".join(words[:n]), words[n:]
    return words[0], words[1:]


def _changed(owner: Any, steps: list[str], parameter: Parameter, changes: dict[str, Any]) -> Any:
    if isinstance(owner, MechanismPart) and len(steps) == 1:
        old = owner.parameters.get(steps[0])
        return owner.model_copy(update={"parameters": {**owner.parameters, steps[0]: _new(old, parameter, changes)}})
    if isinstance(owner, MechanismPart) and steps[0] == "into" and isinstance(owner.into, dict):
        place = ".".join(steps[1:])
        old = owner.into[place]
        new = _new(old if isinstance(old, Value) else None, parameter, changes)
        return owner.model_copy(update={"into": {**owner.into, place: new}})
    indexed = _INDEX.match(steps[0])
    if indexed:
        items = list(getattr(owner, indexed[1]))
        items[int(indexed[2])] = _changed(items[int(indexed[2])], steps[1:], parameter, changes)
        return owner.model_copy(update={indexed[1]: tuple(items)})
    if len(steps) != 1 or not isinstance(owner, BaseModel):
        raise ValueError(f"twin.{parameter.name}: is no value of the machine file; state it there first")
    return owner.model_copy(update={steps[0]: _new(getattr(owner, steps[0]), parameter, changes)})


def _new(old: Value | None, parameter: Parameter, changes: dict[str, Any]) -> Value:
    base = old if old is not None else Value(value=parameter.value, source=parameter.source)
    return base.model_copy(update=changes)
