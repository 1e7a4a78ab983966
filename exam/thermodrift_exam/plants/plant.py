"""A case: a plant drawn from a seed, its recordings, its machine file, and the answer key of what the file omits."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from data.files import write_atomic
from data.machine import Machine
from thermodrift_exam.plants.drawing import HABITS, draw_plant
from thermodrift_exam.plants.effects import EFFECTS
from thermodrift_exam.plants.effects.base import Answer, Effect
from thermodrift_exam.plants.everyday import Everyday, everyday
from thermodrift_exam.plants.machine_file import machine_file
from thermodrift_exam.plants.options import Options, stream
from thermodrift_exam.plants.runs import Run, earlier, moments, plan_runs
from thermodrift_exam.plants.simulation import LEAD_S, Course, gridded, simulated, written
from thermodrift_exam.plants.structure import AIR, FEATURES, Plant

AT_WORK = 0.1  # of the largest heat in any run
NEARLY_ALWAYS = 0.95  # of the rows

Windows = Literal["always"] | list[list[str | float]]  # [batch id, start s, end s]


def windows(effect: Effect, runs: Sequence[Run], step_s: float, course: Course) -> Windows:
    """Time intervals in which the effect acts, on the rows of the recordings, or "always".

    A switched effect acts while its driver or gate is on. Another effect on heat acts while its heat exceeds a tenth of
    the largest value. Faults, chains and constants always act.
    """
    rows_s = np.arange(0.0, runs[0].hours * 3600.0 + 1.0, step_s)
    shown = moments(runs, rows_s, rows_s)
    on = np.stack([effect.active(now) for now in shown])
    if on.all():
        heat_W = moved_W(effect, runs, rows_s, course)
        on = heat_W >= AT_WORK * heat_W.max()
    if on.mean() > NEARLY_ALWAYS:
        return "always"
    return [[run.batch_id, *ends] for b, run in enumerate(runs) for ends in stretches(on[:, b], rows_s)]


def moved_W(effect: Effect, runs: Sequence[Run], rows_s: Array, course: Course) -> Array:
    """Heat that an effect moves into or out of all cells together, W, (rows, B)."""
    at = np.searchsorted(course.time_s, rows_s - 1e-6)
    out = []
    for k, now in zip(at, moments(runs, rows_s, rows_s), strict=True):
        heat_W = np.zeros_like(course.cells_degC[k])
        effect.add_heat_W(heat_W, course.cells_degC[k], now)
        out.append(np.abs(heat_W).sum(axis=0))
    return np.stack(out)


def stretches(on: NDArray[np.bool_], time_s: Array) -> list[list[float]]:
    """[start, end] of every stretch: from its first row to the row at which it is over, or to the last one."""
    edges = np.flatnonzero(np.diff(np.r_[False, on, False].astype(int)))
    last = len(time_s) - 1
    return [[float(time_s[a]), float(time_s[min(b, last)])] for a, b in zip(edges[::2], edges[1::2], strict=True)]


@dataclass(frozen=True)
class Case:
    """`truth` holds effect (its key, None: nothing missing), mechanism, where, also, parameters, and one of these a
    term in `terms` where several are at work at once. Everything is simulated.

    `tables` are the rows that the recorder wrote, by batch; `batches` what a reader makes of them.
    """

    machine: Machine
    batches: list[Batch]
    truth: Mapping[str, Any]
    tables: Mapping[str, pd.DataFrame]


@dataclass(frozen=True)
class Posed:
    """A plant with its effects, runs and machine file, before any run is simulated."""

    seed: int
    plant: Plant
    effects: list[Effect]
    everyday: list[Everyday]
    runs: list[Run]
    machine: Machine
    options: Options


def draw(
    seed: int, effect: str | None = None, size: float = 1.0, *, plant: str = "volumes",
    sizes: Mapping[str, float] | None = None, **options: Any,
) -> Case:  # fmt: skip
    """A case; the same arguments give the same one, to the last digit.

    `effect` is a key of `EFFECTS`, or several joined by "+"; None: the machine file leaves nothing out. `sizes` gives
    each effect its own size instead. `plant` is a key of `PLANTS`, `options` are the fields of `Options`.

    Raises:
        InputError: an unknown effect, plant or option, or a number out of range; one line.
    """
    _check("size", size, size >= 0, "0 or more")
    own = {key: size for key in (effect.split("+") if effect else ())} if sizes is None else dict(sizes)
    at = posed(seed, own, plant, **options)
    shown, name, channels = with_amounts(at.plant, at.effects), at.machine.machine, at.machine.batch_channels()
    course = simulated(shown, at.runs, [*at.effects, *at.everyday], at.options.solver_s, at.options.before_h)
    tables = written(shown, course, at.effects, seed, channels, at.options)
    read = [gridded(name, run, table, channels, at.options) for run, table in zip(at.runs, tables, strict=True)]
    by_batch = {run.batch_id: table for run, table in zip(at.runs, tables, strict=True)}
    return Case(at.machine, read, truth_of(at, course), by_batch)


def posed(seed: int, sizes: Mapping[str, float], plant: str = "volumes", **given: Any) -> Posed:
    """The input of the simulation of `draw`: the plant of a kind with effects of these sizes, its runs and its machine
    file.

    Raises:
        InputError: as `draw`.
    """
    options = _checked(seed, sizes, given)
    kinds = {key: EFFECTS[key] for key in sizes}
    drawn = draw_plant(seed, *_features(kinds, sizes, options), plant, options.spread)
    effects = [kind(drawn, sizes[key], stream(seed, f"effect {key}")) for key, kind in kinds.items()]
    daily = everyday(drawn, seed) if options.everyday else []
    machine = machine_file(drawn, effects, options.name or f"plant_{seed:04d}", seed, options, daily)
    runs = HABITS[options.habit](plan_runs(seed, options, drawn.rated_rpm), drawn.rated_rpm)
    return Posed(seed, drawn, effects, daily, [earlier(run, options.early_s) for run in runs], machine, options)


def _features(
    kinds: Mapping[str, type[Effect]], sizes: Mapping[str, float], options: Options
) -> tuple[frozenset[str], frozenset[str]]:
    """Features that the plant must have and must not."""
    has, lacks = set(options.has), set(options.lacks)
    for key, kind in kinds.items():
        if sizes[key] == 0 and kind.withholds:
            lacks.add(kind.withholds)  # nothing of it in the plant and nothing in the file
        else:
            has |= kind.has
            lacks -= {kind.withholds}
    return frozenset(has), frozenset(lacks)


def with_amounts(plant: Plant, effects: list[Effect]) -> Plant:
    """The plant with withheld features of the strength of their effects."""

    def amount(feature: str) -> float:
        return prod(effect.amount(feature) for effect in effects)

    sources = {k: replace(s, amount=amount(k)) for k, s in plant.sources.items()}
    growths = tuple(g.scaled(amount(g.name)) for g in plant.growths)
    return replace(plant, sources=sources, growths=growths)


def truth_of(at: Posed, course: Course) -> dict[str, Any]:
    """The answer key: plain data."""
    plant = at.plant
    terms = [_term(e, plant) | {"active": windows(e, at.runs, at.options.step_s, course)} for e in at.effects if e.size]
    nothing: dict[str, Any] = {
        "where": None,
        "also": [],
        "neighbours": [],
        "mechanism": None,
        "parameters": {},
        "words": "",
    }
    first: Mapping[str, Any] = terms[0] if terms else nothing
    return {
        "simulated": True, "effect": "+".join(t["effect"] for t in terms) or None,
        "size": first["size"] if terms else 0.0, **{k: first[k] for k in nothing},
        "terms": terms, "features": sorted(plant.features), "cells": plant.structure.size,
    }  # fmt: skip


def _term(effect: Effect, plant: Plant) -> dict[str, Any]:
    answer = effect.answer()
    return {
        "effect": effect.key,
        "size": effect.size,
        "mechanism": answer.mechanism,
        "where": {"kind": answer.kind, "name": answer.name},
        "also": list(answer.also),
        "neighbours": _neighbours(answer, plant),
        "parameters": {k: {"value": v, "unit": u} for k, (v, u) in answer.parameters.items()},
        "words": answer.words,
        **({"form": list(answer.form)} if answer.form else {}),
    }


def _neighbours(answer: Answer, plant: Plant) -> list[str]:
    """Bodies that touch the answer's body, or one end of its link; the air touches too many to count as an end."""
    s = plant.structure
    ends = set(answer.name.split("-")) & set(s.bodies) - {AIR} if answer.kind in ("node", "link") else set()
    return sorted({body for pair in s.touching() if ends & pair for body in pair} - ends)


def _checked(seed: int, sizes: Mapping[str, float], given: Mapping[str, Any]) -> Options:
    for name in given:
        if name not in Options.__dataclass_fields__:
            raise InputError(f"plant: unknown option {name!r}; {closest(name, Options.__dataclass_fields__)}")
    plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
    options = Options(**plain)
    for name in (*options.has, *options.lacks):
        if name not in FEATURES:
            raise InputError(f"plant: unknown feature {name!r}; {closest(name, FEATURES)}")
    whole = all((s / options.solver_s).is_integer() for s in (LEAD_S, options.step_s))
    season_K, day_h = options.warmest_degC - options.coldest_degC, options.latest_h - options.earliest_h
    for what, got, fits, expected in (
        ("seed", seed, seed >= 0, "0 or more"),
        *((f"size of {key}", size, size >= 0, "0 or more") for key, size in sizes.items()),
        ("batches", options.batches, 1 <= options.batches <= 60, "1 to 60"),
        ("step_s", options.step_s, 10.0 <= options.step_s <= 1800.0, "10 to 1800 s"),
        ("hours", options.hours, 0.5 <= options.hours <= 24.0, "0.5 to 24 h"),
        ("before_h", options.before_h, 1.0 <= options.before_h <= 240.0, "1 to 240 h"),
        ("solver_s", options.solver_s, whole, f"a divisor of {LEAD_S:g} s and of step_s"),
        ("spread", options.spread, 0.0 < options.spread <= 2.0, "above 0, at most 2"),
        ("early_s", options.early_s, 0.0 <= options.early_s < options.step_s / 2, "0 to half of step_s"),
        ("warmest_degC less coldest_degC", season_K, season_K >= 0, "0 K or more"),
        ("latest_h less earliest_h", day_h, day_h > 0.02, "more than a minute"),
    ):
        _check(what, got, fits, expected)
    return options


def _check(what: str, got: float, fits: bool, expected: str) -> None:
    if not fits:
        raise InputError(f"plant: {what}: got {got}, expected {expected}; choose another value")


def write_case(case: Case, folder: Path, key_folder: Path | None = None) -> tuple[Path, Path, Path]:
    """Writes `machine.yml` and `recordings/*.csv` below `folder`, `truth.json` into `key_folder`.

    Returns the machine file, the recordings' folder and the key. `key_folder` is by default next to `folder`, with
    `_key` added to its name; it must not lie inside, where the answering process could read it.

    Raises:
        InputError: the key would lie in the case's folder, or a folder cannot be written.
    """
    key_folder = folder.with_name(f"{folder.name}_key") if key_folder is None else key_folder
    if key_folder.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"plant: the key's folder {key_folder} lies in {folder}; give one outside")
    recordings = folder / "recordings"
    machine, key = folder / "machine.yml", key_folder / "truth.json"
    try:
        recordings.mkdir(parents=True, exist_ok=True)
        key_folder.mkdir(parents=True, exist_ok=True)
        write_atomic(machine, machine_text(case.machine))
        for name, text in recording_texts(case).items():
            write_atomic(recordings / name, text)
        write_atomic(key, json.dumps(case.truth, indent=1) + "\n")
    except OSError as error:
        raise InputError(f"plant: {folder} cannot be written ({error}); give a folder that can be") from None
    return machine, recordings, key


def machine_text(machine: Machine) -> str:
    """The machine as a machine file's text; reads back as the same."""
    plain = machine.model_dump(mode="json", exclude_defaults=True)
    return f"# {machine.description or machine.machine}\n" + yaml.safe_dump(plain, sort_keys=False, width=120)


def recording_texts(case: Case) -> dict[str, str]:
    """File name -> CSV text of every run, as the recorder wrote it."""
    return {f"{batch}.csv": csv_text(case.machine.machine, table) for batch, table in case.tables.items()}


def csv_text(machine: str, table: pd.DataFrame) -> str:
    """A recording with a first line that calls it simulated; a lost sample is an empty cell."""
    head = f"# simulated recording, machine {machine}\n"
    return head + str(table.to_csv(index=False, float_format="%.10g", lineterminator="\n"))
