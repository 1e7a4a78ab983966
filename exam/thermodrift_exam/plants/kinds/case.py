"""A case of a kind: plant, runs, recordings, machine file and answer key, with effects of requested strength."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from data.arrays import Array, Mask
from data.errors import InputError, closest
from data.machine import Machine
from data.registry import Registry
from thermodrift_exam.plants.kinds.common import Item, Kind
from thermodrift_exam.plants.kinds.effects.base import Effect
from thermodrift_exam.plants.kinds.effects.faults import Drifts, Offset, Swapped
from thermodrift_exam.plants.kinds.machine_file import machine_file
from thermodrift_exam.plants.kinds.plant import Dice, KindPlant, links_W_per_K
from thermodrift_exam.plants.kinds.runs import KindRun, Now, driven, plan_runs, switch
from thermodrift_exam.plants.kinds.simulation import (
    Course,
    Recorder,
    coarse_s,
    gridded,
    noise_of,
    on_rows,
    prepared,
    rows_of,
    shown,
    simulated,
    without,
    written,
)
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.plant import Case, Windows, stretches

KINDS = Registry(
    "kind",
    {
        "lathe": "thermodrift_exam.plants.kinds.lathe:LATHE",
        "board": "thermodrift_exam.plants.kinds.board:BOARD",
        "horizontal": "thermodrift_exam.plants.kinds.horizontal:HORIZONTAL",
        "gantry": "thermodrift_exam.plants.kinds.gantry:GANTRY",
        "bench": "thermodrift_exam.plants.kinds.bench:BENCH",
        "battery": "thermodrift_exam.plants.kinds.battery:BATTERY",
    },
)
IDLE = ("chip_conveyor", "mist_extraction", "light", "door", "lubrication")
NEARLY_ALWAYS = 0.95
NAMED_SEEDS = 10**12  # a machine's name ends with its seed modulo this: seeds of sealed suites have 256 bits


def effects_of(kind: str) -> tuple[str, ...]:
    """Keys of the effects of a kind that a mechanism of the library describes."""
    return tuple(KINDS[kind].listed)


def unlisted_of(kind: str) -> tuple[str, ...]:
    """Keys of the unlisted effects."""
    return tuple(KINDS[kind].unlisted)


@dataclass(frozen=True)
class KindPosed:
    """A plant of a kind with its effects; `plant` is `full` less what they bring themselves.

    `decoys` are small faults that are at work in every variant; `idle` are recorded switches that drive nothing.
    """

    seed: int
    kind: str
    full: KindPlant
    plant: KindPlant
    effects: tuple[Effect, ...]
    sizes: tuple[float, ...]
    decoys: tuple[tuple[Effect, float], ...]
    runs: tuple[KindRun, ...]
    machine: Machine
    recorder: Recorder
    misread: tuple[str, ...]  # links whose value in the file is off by as much as its prior allows


def draw_kind_case(
    seed: int, kind: str, effects: Mapping[str, float] | None = None, *, decoys: bool = False, runs: int | None = None
) -> Case:
    """A case; the same arguments give the same one, to the last digit.

    `effects` gives the requested sigma of each effect: the rms of its change of the channel that it affects most,
    in units of that channel's noise, before any recalibration. The key states the actual sigma, since some effects have
    a least or a largest size. `decoys` adds small faults that are no effect: idle switches, an offset within its prior,
    a drift below the noise, a conductance that is misread within its prior, early rows, holes, lost samples.

    Raises:
        InputError: an unknown kind or effect, a seed below 0, a sigma that is not above 0, fewer than 2 runs; one line.
    """
    at = posed(seed, kind, dict(effects or {}), decoys=decoys, runs=runs)
    course = simulated(at.plant, at.runs, all_effects(at), variants(at), at.plant.setting.solver_s)
    true = shown(at.plant, course, all_effects(at), list(variants(at)[0]), 0)
    channels = at.machine.batch_channels()
    for name in channels.keys() & set(IDLE):
        true[name] = np.zeros_like(next(iter(course.air_degC.values())))
    tables = written(at.plant, course, true, ahead_s(at.effects, at.sizes), seed, channels, at.recorder)
    row_s = at.plant.setting.row_s
    batches = [gridded(at.machine.machine, r, t, channels, row_s) for r, t in zip(at.runs, tables, strict=True)]
    by_batch = {r.batch_id: t for r, t in zip(at.runs, tables, strict=True)}
    return Case(at.machine, batches, truth_of(at, course), by_batch)


def posed(
    seed: int, kind: str, wanted: Mapping[str, float], *, decoys: bool = False, runs: int | None = None
) -> KindPosed:
    """The simulated variant of `draw_kind_case`, with the sizes of the requested sigmas.

    Raises:
        InputError: as `draw_kind_case`.
    """
    _check(seed, wanted, runs)
    of: Kind = KINDS[kind]
    known = {**of.listed, **of.unlisted}
    for key in wanted:
        if key not in known:
            raise InputError(f"kind {kind}: unknown effect {key!r}; {closest(key, known)}")
    full = of.draw(seed, frozenset(wanted))
    chosen = tuple(made(key, known[key], full, seed) for key in wanted)
    plant = without(full, chosen)
    lot = Dice(stream(seed, "kind decoys"))
    small = _decoys(plant, lot) if decoys else ()
    idle = tuple(sorted(lot.rng.permutation(IDLE)[: lot.whole(1, 2)].tolist())) if decoys else ()
    recorder = Recorder(0.2 * full.setting.row_s, 0.4, 0.002) if decoys else Recorder()
    planned = plan_runs(full, seed, runs)
    idle_runs = tuple(_with_idle(run, idle, seed, k) for k, run in enumerate(planned))
    sizes = fitted_sizes(plant, planned, chosen, list(wanted.values()))
    joints = ["-".join(pair) for pair in links_W_per_K(full)] if decoys else []
    misread = {lot.pick(joints): float(np.exp(1.2 * lot.sign() * full.setting.file_error))} if joints else {}
    machine = machine_file(plant, full, f"{kind}_{seed % NAMED_SEEDS:04d}", seed, idle, misread)
    return KindPosed(seed, kind, full, plant, chosen, sizes, small, idle_runs, machine, recorder, tuple(misread))


def made(key: str, item: Item, plant: KindPlant, seed: int) -> Effect:
    """An effect at one of the places that this plant has of its list."""
    dice = Dice(stream(seed, f"kind effect {key}"))
    every = (*plant.bodies, *plant.errors)
    there = [name for pattern in item.places for name in every if fnmatchcase(name, pattern)]
    sensed = {s.body for s in plant.sensors}
    if item.make.kind == "sensor":
        there = [b for b in there if b in sensed] or there
    elif dice.chance(0.8):
        there = [b for b in there if b in (*sensed, *plant.errors)] or there
    return item.make(key, plant, dice, dice.pick(list(dict.fromkeys(there))), **item.options)


def fitted_sizes(
    plant: KindPlant, runs: Sequence[KindRun], effects: Sequence[Effect], wanted: Sequence[float]
) -> tuple[float, ...]:
    """Sizes at which each effect alone has the requested sigma.

    Two or three trials with coarse steps, each followed by a linear or power-law extrapolation.
    """
    if not effects:
        return ()
    prepared(plant, runs, effects, wanted)
    trials: list[tuple[Array, Array]] = []  # size, sigma
    least, largest = (np.array([getattr(e, n) for e in effects]) for n in ("least", "largest"))
    size = np.clip(np.ones(len(effects)), least, largest)
    for trial in range(3):
        sigma = _sigmas(plant, runs, effects, size)
        trials.append((size, sigma))
        off = np.abs(np.log(np.maximum(sigma, 1e-9) / wanted))[(size < largest) & (size > least)]
        if trial and (off < 0.1).all():
            break
        size = np.clip(size * _change(trials, np.asarray(wanted)), least, largest)
    size = np.where([isinstance(e, Swapped) for e in effects], 1.0, size)
    return tuple(float(f"{x:.6g}") for x in size)


def _sigmas(plant: KindPlant, runs: Sequence[KindRun], effects: Sequence[Effect], size: Array) -> Array:
    """Of each effect alone at its size."""
    none = np.zeros(len(effects))
    course = simulated(plant, runs, effects, np.vstack([none, np.diag(size)]), coarse_s(plant))
    clean = shown(plant, course, effects, none.tolist(), 0)
    out = none.copy()
    for k, effect in enumerate(effects):
        alone = np.where(np.arange(len(effects)) == k, size, 0.0).tolist()
        one, ahead = shown(plant, course, effects, alone, k + 1), effect.ahead_s(float(size[k]))
        out[k] = visibility(plant, course, clean, one, {}, ahead)
    return out


def _change(trials: Sequence[tuple[Array, Array]], wanted: Array) -> Array:
    """Factors of the last sizes: linear, or by the power law through two trials."""
    size, sigma = trials[-1]
    power = np.ones(len(size))
    if len(trials) > 1:
        size_before, sigma_before = trials[-2]
        stretch = np.log(np.maximum(size, 1e-12) / np.maximum(size_before, 1e-12))
        grown = np.log(np.maximum(sigma, 1e-12) / np.maximum(sigma_before, 1e-12))
        safe = np.where(np.abs(stretch) > 0.05, stretch, 1.0)
        power = np.where(np.abs(stretch) > 0.05, np.clip(grown / safe, 0.4, 2.0), 1.0)
    return np.clip((wanted / np.maximum(sigma, 1e-9)) ** (1.0 / power), 1e-4, 1e4)


def visibility(
    plant: KindPlant, course: Course, one: Mapping[str, Array], other: Mapping[str, Array],
    ahead_one_s: Mapping[str, float], ahead_other_s: Mapping[str, float],
) -> float:  # fmt: skip
    """The rms difference over all rows of the channel that differs most, in units of its noise."""
    squares = dict.fromkeys(one, 0.0)
    rows = 0
    for b, run in enumerate(course.runs):
        rows_s = rows_of(run, plant.setting.row_s)
        rows += len(rows_s)
        a, c = on_rows(course, one, ahead_one_s, b, rows_s), on_rows(course, other, ahead_other_s, b, rows_s)
        for name in one:
            squares[name] += float(((a[name] - c[name]) ** 2).sum())
    return max(np.sqrt(total / rows) / noise_of(plant, name) for name, total in squares.items())


def truth_of(at: KindPosed, course: Course) -> dict[str, Any]:
    """The answer key: plain data, as `plants.plant.truth_of` has it, with sigma, driver and partners a term."""
    effects, sizes = all_effects(at), variants(at)
    whole = shown(at.plant, course, effects, list(sizes[0]), 0)
    terms = []
    for k, effect in enumerate(at.effects):
        less = shown(at.plant, course, effects, list(sizes[k + 1]), k + 1)
        others = tuple(0.0 if n == k else s for n, s in enumerate(at.sizes))
        sigma = visibility(at.plant, course, less, whole, ahead_s(at.effects, others), ahead_s(at.effects, at.sizes))
        terms.append(_term(at, effect, at.sizes[k]) | {"active": _windows(at, effect), "sigma": round(float(sigma), 3)})
    nothing: dict[str, Any] = dict(where=None, also=[], neighbours=[], mechanism=None, parameters={}, words="")
    first: Mapping[str, Any] = terms[0] if terms else nothing
    return {
        "simulated": True, "effect": "+".join(t["effect"] for t in terms) or None,
        "size": first["size"] if terms else 0.0, **{k: first[k] for k in nothing}, "terms": terms,
        "features": sorted(at.full.drivers), "cells": at.plant.solid.size, "kind": at.kind,
        "decoys": [*(f"{e.key} at {e.place}" for e, _ in at.decoys), *(f"misread {link}" for link in at.misread)],
    }  # fmt: skip


def _term(at: KindPosed, effect: Effect, size: float) -> dict[str, Any]:
    return {
        "effect": effect.key, "size": size, "mechanism": effect.mechanism,
        "where": {"kind": effect.kind, "name": effect.place}, "also": list(effect.also),
        "neighbours": _neighbours(at.plant, effect),
        "parameters": {k: {"value": float(v), "unit": u} for k, (v, u) in effect.values(size).items()},
        "words": effect.words, "driver": effect.driver,
        "same_as": [{"mechanism": m, "where": {"kind": k, "name": n}} for m, k, n in effect.same_as],
        **({"form": list(effect.form)} if effect.form else {}),
    }  # fmt: skip


def _neighbours(plant: KindPlant, effect: Effect) -> list[str]:
    ends = set(effect.place.split("-")) & set(plant.bodies) if effect.kind in ("node", "link") else set()
    return sorted({b for pair in plant.touching() if ends & pair for b in pair} - ends)


def _windows(at: KindPosed, effect: Effect) -> Windows:
    """Stretches of rows in which it can work, or "always"."""
    out: list[list[str | float]] = []
    shares = []
    for run in at.runs:
        rows_s = rows_of(run, at.plant.setting.row_s)
        on = np.array([bool(now_on[0]) for now_on in _active(at, effect, run, rows_s)])
        shares.append(on.mean())
        out += [[run.batch_id, *ends] for ends in stretches(on, rows_s)]
    return "always" if np.mean(shares) > NEARLY_ALWAYS else out


def _active(at: KindPosed, effect: Effect, run: KindRun, rows_s: Array) -> list[Mask]:
    drive = driven([run], list(at.plant.drivers), rows_s)
    air = {n: run.air[n](rows_s) for n in at.plant.airs}
    ground = np.array([run.ground_degC])
    return [
        effect.active(
            Now(
                float(t), {n: v[k] for n, v in drive.items()}, {n: v[k : k + 1] for n, v in air.items()}, ground,
                np.array([(run.clock_h + t / 3600.0) % 24.0]),
            )
        )
        for k, t in enumerate(rows_s)
    ]  # fmt: skip


def all_effects(at: KindPosed) -> list[Effect]:
    return [*at.effects, *(e for e, _ in at.decoys)]


def variants(at: KindPosed) -> Array:
    """Sizes (1 + effects, effects and decoys): all of them, then without each."""
    small = [size for _, size in at.decoys]
    rows = [[*at.sizes, *small]]
    for k in range(len(at.effects)):
        rows.append([*(0.0 if n == k else s for n, s in enumerate(at.sizes)), *small])
    return np.array(rows, float).reshape(len(rows), -1)


def ahead_s(effects: Sequence[Effect], sizes: Sequence[float]) -> dict[str, float]:
    out: dict[str, float] = {}
    for effect, size in zip(effects, sizes, strict=True):
        out |= effect.ahead_s(size)
    return out


def _decoys(plant: KindPlant, lot: Dice) -> tuple[tuple[Effect, float], ...]:
    """An offset within its prior and a drift below the noise, each in half of the cases."""
    out: list[tuple[Effect, float]] = []
    for make, key in ((Offset, "decoy_offset"), (Drifts, "decoy_drift")):
        effect = make(key, plant, lot, lot.pick([s.body for s in plant.sensors]))
        noise_K = noise_of(plant, effect.place)
        if lot.chance(0.6) and (plant.setting.states_offsets or make is Drifts):
            per_size = effect.K * (plant.setting.hours[1] if isinstance(effect, Drifts) else 1.0)
            limit_K = 0.4 * noise_K if isinstance(effect, Drifts) else 0.15
            out.append((effect, limit_K / per_size))
    return tuple(out)


def _with_idle(run: KindRun, idle: Sequence[str], seed: int, number: int) -> KindRun:
    turns = switch((900.0, 4000.0))
    drawn = {n: turns.draw(stream(seed, f"idle {n} {number}"), number, 3600.0 * run.hours) for n in idle}
    return replace(run, blocks={**run.blocks, **drawn})


def _check(seed: int, wanted: Mapping[str, float], runs: int | None) -> None:
    for what, got, fits, expected in (
        ("seed", seed, seed >= 0, "0 or more"),
        ("runs", runs, runs is None or 2 <= runs <= 40, "2 to 40"),
        *((f"sigma of {k}", v, 0 < v < 1e4, "above 0 and below 10000") for k, v in wanted.items()),
    ):
        if not fits:
            raise InputError(f"kind case: {what}: got {got}, expected {expected}; choose another value")
