"""A case: a plant drawn from a seed, its recordings, the machine file of it, and what the file leaves out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from data.batch import Batch
from data.errors import InputError, closest
from data.machine import Machine
from twin.plants.drawing import draw_plant
from twin.plants.effects import EFFECTS
from twin.plants.effects.base import Answer, Effect
from twin.plants.machine import FEATURES, Plant
from twin.plants.machine_file import machine_file
from twin.plants.options import Options
from twin.plants.physics import LEAD_S, simulated
from twin.plants.recorded import recordings
from twin.plants.runs import plan_runs
from twin.plants.seeds import stream
from twin.plants.structure import AIR


@dataclass(frozen=True)
class Case:
    """`truth` holds effect (its key, None: nothing missing), mechanism, where, also, parameters, and one of these a
    term in `terms` where several are at work at once. Everything is simulated.
    """

    machine: Machine
    batches: list[Batch]
    truth: Mapping[str, Any]


def draw(
    seed: int, effect: str | None = None, size: float = 1.0, batches: int = 12, step_s: float = 300.0, **options: Any
) -> Case:
    """A case; the same arguments give the same one, to the last digit.

    `effect` is a key of `EFFECTS`, or several joined by "+"; None: the machine file leaves nothing out. `options` are
    the fields of `Options`.

    Raises:
        InputError: an unknown effect or option, or a number out of range; one line.
    """
    asked = _checked(seed, size, Options, {"batches": batches, "step_s": step_s, **options})
    kinds = {key: EFFECTS[key] for key in (effect.split("+") if effect else ())}
    plant = _plant(seed, kinds, size, asked)
    effects = [kind(plant, size, stream(seed, f"effect {key}")) for key, kind in kinds.items()]
    name = f"plant_{seed:04d}"
    machine = machine_file(plant, effects, name, seed, asked)
    runs = plan_runs(seed, asked.batches, asked.hours, asked.step_s, plant.rated_rpm, asked.friction_scatter)
    course = simulated(_with_amounts(plant, effects), runs, effects, asked.solver_s, asked.before_h)
    shown = recordings(
        _with_amounts(plant, effects), runs, course, effects, seed, name, machine.batch_channels(), asked
    )
    return Case(machine, shown, truth_of(effect, size, plant, effects))


def _plant(seed: int, kinds: Mapping[str, type[Effect]], size: float, asked: Options) -> Plant:
    has, lacks = set(asked.has), set(asked.lacks)
    for kind in kinds.values():
        has |= kind.has
        if size == 0 and kind.withholds:
            lacks.add(kind.withholds)  # nothing of it in the plant and nothing in the file
    return draw_plant(seed, frozenset(has), frozenset(lacks))


def _with_amounts(plant: Plant, effects: list[Effect]) -> Plant:
    """The plant with withheld features as strong as their effects say."""

    def amount(feature: str) -> float:
        out = 1.0
        for effect in effects:
            out *= effect.amount(feature)
        return out

    sources = {k: replace(s, amount=amount(k)) for k, s in plant.sources.items()}
    growths = tuple(g.scaled(amount(g.name)) for g in plant.growths)
    return replace(plant, sources=sources, growths=growths)


def truth_of(effect: str | None, size: float, plant: Plant, effects: list[Effect]) -> dict[str, Any]:
    """The answer key: plain data."""
    terms = [_term(e.key, e.answer(), plant) for e in effects] if size else []
    first = (
        terms[0]
        if terms
        else {"where": None, "also": [], "neighbours": []} | {"mechanism": None, "parameters": {}, "words": ""}
    )
    return {
        "simulated": True, "effect": effect if size else None, "size": size,
        **{k: first[k] for k in ("mechanism", "where", "also", "neighbours", "parameters", "words")},
        "terms": terms, "features": sorted(plant.features), "cells": plant.structure.size,
    }  # fmt: skip


def _term(key: str, answer: Answer, plant: Plant) -> dict[str, Any]:
    return {
        "effect": key,
        "mechanism": answer.mechanism,
        "where": {"kind": answer.kind, "name": answer.name},
        "also": list(answer.also),
        "neighbours": _neighbours(answer, plant),
        "parameters": {k: {"value": v, "unit": u} for k, (v, u) in answer.parameters.items()},
        "words": answer.words,
    }


def _neighbours(answer: Answer, plant: Plant) -> list[str]:
    """Bodies that touch the answer's body, or one end of its link; the air touches too many to count as an end."""
    s = plant.structure
    ends = set(answer.name.split("-")) & set(s.bodies) - {AIR} if answer.kind in ("node", "link") else set()
    return sorted({body for pair in s.touching() if ends & pair for body in pair} - ends)


def _checked(seed: int, size: float, kind: type[Options], given: Mapping[str, Any]) -> Options:
    for name in given:
        if name not in kind.__dataclass_fields__:
            raise InputError(f"plant: unknown option {name!r}; {closest(name, kind.__dataclass_fields__)}")
    options = kind(**given)
    for name in (*options.has, *options.lacks):
        if name not in FEATURES:
            raise InputError(f"plant: unknown feature {name!r}; {closest(name, FEATURES)}")
    whole = all((s / options.solver_s).is_integer() for s in (LEAD_S, options.step_s))
    for what, got, fits, expected in (
        ("seed", seed, seed >= 0, "0 or more"),
        ("size", size, size >= 0, "0 or more"),
        ("batches", options.batches, 1 <= options.batches <= 60, "1 to 60"),
        ("step_s", options.step_s, 10.0 <= options.step_s <= 1800.0, "10 to 1800 s"),
        ("hours", options.hours, 0.5 <= options.hours <= 24.0, "0.5 to 24 h"),
        ("before_h", options.before_h, 1.0 <= options.before_h <= 240.0, "1 to 240 h"),
        ("solver_s", options.solver_s, whole, f"a divisor of {LEAD_S:g} s and of step_s"),
    ):
        if not fits:
            raise InputError(f"plant: {what}: got {got}, expected {expected}; choose another value")
    return options
