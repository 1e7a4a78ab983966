"""The machine file of a diagnosis: the user's own text with what was found put into it, read back before it is given.

Everything else of the text stays: comments, order, style. `simulate`, `calibrate` and the twin family use it as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel

from data.errors import InputError, WorkError, closest
from data.machine import Machine, parse_machine
from data.yaml_edit import YamlText
from diagnosis.contracts import PART_GROUPS, with_parts, with_value
from diagnosis.export.yaml_text import DIGITS, as_yaml, part_yaml, tidied
from diagnosis.fitting.fit import Fitted
from twin.calibration.calibrated_file import Update, held_steps, kept, put_values, with_calibrated
from twin.calibration.identifiability import Interval
from twin.compile import compile_network, own_paths
from twin.network import Network
from twin.quantity import Value
from twin.schema import Calibrated, MechanismPart, TwinPart, twin_part

PRIOR_SAME = 1e-4  # relative: five digits are kept
SAME = 1e-9  # relative: what is read back against what was to be written
GROUPS = tuple(TwinPart.model_fields)


def diagnosed_text(
    text: str,
    where: str,
    values: Mapping[str, float],
    intervals: Iterable[Interval],
    added: Mapping[str, BaseModel],
    notes: Mapping[str, str],
    origin: Calibrated | None = None,
) -> str:
    """The text of a machine file with new values and new parts of its twin.

    Args:
        values: by parameter of the network with the parts in it, or by the file's own path
            ("mechanisms.floor_bed.conductance"), in the parameter's unit; five digits are kept.
        intervals: of those values; every value needs one.
        added: mechanisms by name, or any part by its path ("bodies.bed", "sensors.front": refinements), new or changed.
        notes: comments by name or path of what was added or changed: where it comes from.
        origin: the entry `calibrated`.

    Raises:
        InputError: no value of that name, or one that the file does not hold as its own.
        WorkError: the text does not read back as the same network with these values.
    """
    parts = {path if "." in path else f"mechanisms.{path}": tidied_part(p) for path, p in added.items()}
    machine = parse_machine(text, where)
    old = twin_part(machine, where)
    part = _with_parts(old, parts)
    network = compile_network(machine, where, part)
    own = own_paths(machine, part)
    updates = _updates(values, {i.name: i for i in intervals}, network, own, where)
    document = YamlText(text)
    filled, rest = _filled(parts, updates)
    for path, given in filled.items():
        _put_part(document, path, given, old)
    for path in rest:
        _put_default(document, path, network, own)
    put_values(document, rest, where)
    for path, note in notes.items():
        document.comment(_held_steps(document, path), note)
    new = str(document)
    if origin is not None:
        new = with_calibrated(new, origin)
    _check(new, machine, part, network, updates, own, where)
    return new


def drafted_text(text: str, part: TwinPart, where: str, note: str = "") -> str:
    """The text of a machine file that had no twin part with a drafted one behind all else, `note` above it.

    Raises:
        InputError: the file has a twin part.
        WorkError: the text does not read back as the same network.
    """
    machine = parse_machine(text, where)
    if machine.twin is not None:
        raise InputError(f"{where}: has a twin part already; nothing is drafted over it")
    part = tidied_part(part)
    document = YamlText(text)
    document.set([], "twin", part_yaml(part), note, blocks=2)
    new = str(document)
    network = compile_network(machine, where, part)
    _check(new, machine, part, network, {}, {}, where)
    return new


def tidied_part(model: Any) -> Any:
    """A part of a twin whose bare numbers are rounded as the file keeps them."""
    if isinstance(model, Value):
        return tidied(model)
    if isinstance(model, BaseModel):
        return model.model_copy(update={k: tidied_part(getattr(model, k)) for k in type(model).model_fields})
    if isinstance(model, Mapping):
        return {k: tidied_part(v) for k, v in model.items()}
    return tuple(tidied_part(v) for v in model) if isinstance(model, tuple) else model


def _updates(
    values: Mapping[str, float], intervals: Mapping[str, Interval], network: Network, own: Mapping[str, str], where: str
) -> dict[str, Update]:
    """By the file's own paths."""
    names = {p.name: p for p in network.parameters}
    here = {path: name for name, path in own.items()}
    out: dict[str, Update] = {}
    for given, value in values.items():
        name = here.get(given, given)
        if name not in names:
            raise InputError(f"{where}: no twin parameter {given!r}; {closest(given, names)}")
        interval = intervals.get(given) or intervals.get(name)
        if interval is None or not all(math.isfinite(v) for v in (value, interval.low, interval.high)):
            raise WorkError(f"{where}: {given} has no finite value and interval; nothing was written")
        path = own.get(name, name)
        update = Update(names[name], float(value), (interval.low, interval.high))
        if path in out and kept(out[path].value) != kept(update.value):
            raise WorkError(
                f"{where}: {path} is one value in the file and was fitted as {out[path].value:g} and {value:g}; "
                "give each place a mechanism of its own; nothing was written"
            )
        out[path] = update
    return out


def _with_parts(old: TwinPart, parts: Mapping[str, BaseModel]) -> TwinPart:
    for path in parts:
        group = path.partition(".")[0]
        if group not in GROUPS or not isinstance(getattr(old, group), Mapping):
            raise ValueError(f"{path}: no part of a twin is called {group!r}; {closest(group, GROUPS)}")
    return with_parts(old, parts)


def _filled(
    parts: Mapping[str, BaseModel], updates: Mapping[str, Update]
) -> tuple[dict[str, BaseModel], dict[str, Update]]:
    """The added mechanisms with their fitted values, and the values elsewhere."""
    filled, rest = dict(parts), {}
    for path, update in updates.items():
        group, name, *below = path.split(".")
        given = filled.get(f"{group}.{name}")
        if not isinstance(given, MechanismPart) or len(below) != 1:
            rest[path] = update
            continue
        unit = update.parameter.unit
        both = (kept(update.value), kept(update.parameter.prior_value))
        value, prior = (v if unit == "1" else f"{v:.{DIGITS}g} {unit}" for v in both)
        fitted = {"value": value, "prior": prior, "interval90": tuple(kept(v) for v in update.interval90)}
        held = (given.parameters.get(below[0]) or Value(value=0.0)).model_copy(update=fitted)
        filled[f"{group}.{name}"] = given.model_copy(update={"parameters": {**given.parameters, below[0]: held}})
    return filled, rest


def _put_part(document: YamlText, path: str, given: BaseModel, old: TwinPart) -> None:
    """A new part whole; of a changed one only the keys that changed, so that its other comments stay."""
    group, name = path.split(".", 1)
    before, whole = getattr(old, group).get(name), as_yaml(given)
    if type(before) is type(given) and isinstance(as_yaml(before, name), dict):
        changed = [k for k in type(given).model_fields if getattr(before, k) != getattr(given, k)]
        if set(changed) <= set(whole):
            for key in changed:
                document.set(["twin", group, name], key, whole[key])
            return
    document.set(["twin", group], name, as_yaml(given, name), order=GROUPS)


def _put_default(document: YamlText, path: str, network: Network, own: Mapping[str, str]) -> None:
    """A mechanism's default value is written out, so that it can be changed."""
    steps = ["twin", *path.split(".")]
    if steps[1] != "mechanisms" or len(steps) != 4 or _held_steps(document, path) != steps[:3]:
        return
    name = next((n for n, at in own.items() if at == path), path)
    p = network.parameters[network.index(name)]
    value: Any = f"{p.value:.{DIGITS}g} {p.unit}" if p.unit != "1" else p.value
    document.set([*steps[:3], "parameters"], steps[3], value)


def _held_steps(document: YamlText, path: str) -> list[str]:
    """The keys that lead as far towards a path as the text goes; a bare name is a mechanism's."""
    return held_steps(document, path if "." in path else f"mechanisms.{path}")[0]


def _check(
    text: str, before: Machine, part: TwinPart, network: Network, updates: Mapping[str, Update],
    own: Mapping[str, str], where: str,
) -> None:  # fmt: skip
    """Raises WorkError where the text differs from what was to be written."""
    try:
        machine = parse_machine(text, where)
        again, read = compile_network(machine, where), twin_part(machine, where)
    except InputError as error:
        raise WorkError(f"{where}: the new file does not read back ({error}); nothing was written") from None
    if machine.model_copy(update={"twin": None}) != before.model_copy(update={"twin": None}):
        raise WorkError(f"{where}: writing would change more than the twin part; nothing was written")
    for group in GROUPS:
        if group != "calibrated" and _frame(getattr(read, group)) != _frame(getattr(part, group)):
            raise WorkError(f"{where}: twin.{group} does not read back as it was meant; nothing was written")
    if [p.name for p in again.parameters] != [p.name for p in network.parameters]:
        raise WorkError(f"{where}: the new file reads back as another network; nothing was written")
    for new, old in zip(again.parameters, network.parameters, strict=True):
        update = updates.get(own.get(old.name, old.name))
        value = old.value if update is None else kept(update.value)
        stated = (new.value, new.low, new.high, new.spread)
        if not math.isclose(new.prior_value, old.prior_value, rel_tol=PRIOR_SAME, abs_tol=1e-300) and update:
            stated, value = (new.prior_value, *stated[1:]), old.prior_value
        for got, meant in zip(stated, (value, old.low, old.high, old.spread), strict=True):
            if not (math.isclose(got, meant, rel_tol=SAME, abs_tol=1e-300) or (math.isnan(got) and math.isnan(meant))):
                raise WorkError(f"{where}: {new.name} reads back as {got:g} instead of {meant:g}; nothing was written")


def _frame(held: Any) -> Any:
    """A part of a twin without its values, nor those of a mechanism that may be in the file or in its class."""
    if isinstance(held, Value):
        return Value
    if isinstance(held, BaseModel):
        mine = set(type(held).model_fields) - ({"parameters"} if isinstance(held, MechanismPart) else set())
        return {k: _frame(getattr(held, k)) for k in mine}
    if isinstance(held, Mapping):
        return {k: _frame(v) for k, v in held.items()}
    return [_frame(v) for v in held] if isinstance(held, tuple) else held


def with_deviations(fitted: Fitted) -> TwinPart:
    """The twin part whose `per_batch` values are the deviations that the batches have."""
    part, problem = fitted.part, fitted.problem
    for name, sd in deviations(fitted).items():
        parameter = problem.network.parameters[problem.network.index(name)]
        part = with_value(part, parameter, per_batch=float(f"{max(sd, 0.01):.2g}"))
    return part


def deviations(fitted: Fitted) -> dict[str, float]:
    """By parameter that differs from run to run the sd of its logarithm over the batches."""
    offsets = fitted.problem.nuisance_offsets(fitted.fitted_nuisance)
    names = [fitted.problem.network.parameters[k].name for k in fitted.problem.nuisances.parameters]
    return dict(zip(names, np.sqrt(np.mean(offsets**2, axis=0)).tolist(), strict=True))


def changed_parts(before: TwinPart, after: TwinPart) -> Mapping[str, BaseModel]:
    """By path ("mechanisms.floor_sink_bed") what `after` states that `before` does not, or states otherwise."""
    out = {}
    for group in PART_GROUPS:
        old = getattr(before, group)
        for name, given in getattr(after, group).items():
            if name not in old or old[name] != given:
                out[f"{group}.{name}"] = given
    return out
