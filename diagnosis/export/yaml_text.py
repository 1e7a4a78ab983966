"""Parts of a twin as YAML in the house's short style: values as "10 W/K", what fits a line on one line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from twin.compiling import parameters as specs
from twin.mechanisms import MECHANISMS
from twin.quantity import Spec, Value
from twin.schema import Exposure, Link, MechanismPart, TwinPart

DIGITS = 5  # what a calibrated file keeps of a value
_FIELDS = {
    s.name: s for s in (specs.CAPACITY, specs.MASS, specs.CONDUCTANCE, specs.AREA, specs.COEFFICIENT, specs.LENGTH,
                        specs.OFFSET, specs.TEMPERATURE, *specs.MATERIAL.values(), Spec("lag", "s", ""))
} | {n: specs.LENGTH for n in ("width", "thickness", "height", "depth", "lever")}  # fmt: skip


def as_yaml(model: BaseModel, key: str = "") -> Any:
    """A part of a twin as YAML holds it: no defaults, numbers with their units, short forms.

    `key` is its name in the file: a link ``a-b`` is between a and b without a statement of its ends.
    """
    owned = {s.name: s for s in MECHANISMS[model.law].parameters} if isinstance(model, MechanismPart) else {}
    out: dict[str, Any] = {}
    for name, field in type(model).model_fields.items():
        held = getattr(model, name)
        if field.is_required() or held != field.get_default(call_default_factory=True):
            out[name] = _as_yaml(held, name, owned)
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


def part_yaml(part: TwinPart) -> dict[str, Any]:
    """A whole twin part as YAML holds it."""
    out: dict[str, Any] = {}
    for group, field in TwinPart.model_fields.items():
        held = getattr(part, group)
        if isinstance(held, BaseModel):
            out[group] = as_yaml(held)
        elif isinstance(held, Mapping):
            out |= {group: {k: as_yaml(v, k) for k, v in held.items()}} if held else {}
        elif held != field.default:
            out[group] = held
    return out


def _as_yaml(held: Any, name: str, owned: Mapping[str, Spec]) -> Any:
    if isinstance(held, Value):
        return _value(held, owned.get(name) or _FIELDS.get(name))
    if isinstance(held, BaseModel):
        return as_yaml(held)
    if isinstance(held, Mapping):
        return {k: _as_yaml(v, str(k), owned) for k, v in held.items()}
    if isinstance(held, tuple):
        return [_as_yaml(v, name, owned) for v in held]
    return held


def _value(held: Value, spec: Spec | None) -> Any:
    unit = spec.unit if spec and spec.unit != "1" else ""
    delta = {"degC": "K"}.get(unit, unit) if spec and spec.scale == "linear" else ""
    entries = {k: v for k, v in tidied(held) if v is not None and v != ""}
    for k, own in (("value", unit), ("prior", unit), ("spread", delta)):
        if own and isinstance(entries.get(k), int | float):
            entries[k] = f"{entries[k]:.{DIGITS}g} {own}"
    entries = {k: [_short(e) for e in v] if isinstance(v, tuple) else _short(v) for k, v in entries.items()}
    return entries["value"] if set(entries) == {"value"} else entries


def _short(number: Any) -> Any:
    """54 instead of 54.0."""
    return int(number) if isinstance(number, float) and number.is_integer() and abs(number) < 1e9 else number


def _rounded(number: Any) -> Any:
    return float(f"{number:.{DIGITS}g}") if isinstance(number, float) else number
