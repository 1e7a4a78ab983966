"""The simplest network that recordings support, for a machine file without a twin part.

Sensors that move together share a body; the bodies form a tree of conductances in a room; every driver is a heat. How
many bodies there are is what predicts parts of the recordings that were left out, by the one-standard-error rule
(Breiman, Friedman, Olshen and Stone 1984, Classification and Regression Trees, section 3.4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from diagnosis.drafting.first_guess import Driven, driven
from diagnosis.drafting.groups import Rises, Rows, rows_of
from diagnosis.drafting.part import Sketch, moved, part_of, sketch, with_values
from diagnosis.policy import POLICY
from twin.calibration.estimate import free_running_rms
from twin.calibration.fit_problem import Noise, x_of
from twin.calibration.least_squares import State, descend
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.network import Network
from twin.schema import TwinPart


@dataclass(frozen=True)
class Scored:
    """A fitted draft: all parameter values (n,), and by part and channel the rms left out and that of no movement.

    `left_out` and `zero` are (B, C) in the channels' units (K for sensors), NaN where a part has no value of a
    channel; `noise` (C,) the channels' own.
    """

    network: Network
    values: Array
    channels: tuple[str, ...]
    units: tuple[str, ...]
    noise: Array
    left_out: Array
    zero: Array

    @cached_property
    def log_score(self) -> Array:
        """Mean over channels of the logarithm of the share of the movement that is left, (B,); noise counts in both."""
        ratio = np.sqrt((self.left_out**2 + self.noise**2) / (self.zero**2 + self.noise**2))
        return np.asarray(np.nanmean(np.log(ratio), axis=1))

    @property
    def share_left(self) -> float:
        """Geometric mean of it over parts and channels: 1 is as good as nothing."""
        return float(np.exp(self.log_score.mean()))

    def better_than(self, other: Scored) -> tuple[float, float]:
        """By how much the logarithm is below another's on the same parts: mean and its standard error."""
        gain = other.log_score - self.log_score
        return float(gain.mean()), float(gain.std(ddof=1) / np.sqrt(len(gain))) if len(gain) > 1 else 0.0


def scored(network: Network, batches: Sequence[Batch], moved: Mapping[str, float]) -> Scored:
    """Fit the network to all parts, and predict each part by the fit without its fold from first readings alone.

    `moved` is the rms movement of every channel, in its unit.

    Raises:
        InputError: see `CalibrationProblem.of`, or fewer rows than parameters. WorkError: the model is not finite.
    """
    readings = tuple(replace(r, noise=_soft(r.noise, moved[r.channel])) for r in network.readings)
    errors = tuple(replace(e, noise=_soft(e.noise, moved[e.channel])) for e in network.errors)
    soft = replace(network, readings=readings, errors=errors)
    problem = CalibrationProblem.of(soft, batches, every_s=min(b.step_s for b in batches))
    nuisance = [np.zeros(q) for q in problem.nuisance_sizes]
    done = _fit(problem, np.zeros(len(problem.unknowns)), nuisance, POLICY.draft_steps)
    count = len(batches)
    left_out, zero = np.full((2, count, len(problem.channels)), np.nan)
    for fold in range(min(POLICY.draft_folds, count)):
        out = list(range(fold, count, POLICY.draft_folds))
        part = problem.only(out)
        for b, m, rms in zip(out, part.measured, free_running_rms(part, _without(problem, done, out)), strict=True):
            for c, value in rms.items():
                at = m.channel == c
                left_out[b, c] = value
                zero[b, c] = np.sqrt(np.mean((m.value[at] - m.at_rest[at]) ** 2))
    noise = np.array([r.noise for r in network.readings] + [e.noise for e in network.errors])
    return Scored(network, _values(problem, done), problem.channels, problem.units, noise, left_out, zero)


def _soft(noise: float, moved: float) -> float:
    return float(np.hypot(noise, POLICY.draft_misfit_share * moved))


def _fit(problem: CalibrationProblem, z: Array, nuisance: list[Array], iterations: int) -> State:
    channels = len(problem.channels)
    start = State.at(problem, z, nuisance, Noise(np.ones(channels), np.full(channels, POLICY.draft_rows_per_value)))
    return descend(problem, start, iterations, POLICY.draft_tolerance * start.rows)


def _without(problem: CalibrationProblem, done: State, out: Sequence[int]) -> Array:
    """All parameter values (n,) of the fit without some parts; begun at the fit with them, which saves steps."""
    kept = [b for b in range(len(done.nuisance)) if b not in out]
    if kept:
        done = _fit(problem.only(kept), done.z, [done.nuisance[b] for b in kept], POLICY.draft_fold_steps)
    return _values(problem, done)


def _values(problem: CalibrationProblem, state: State) -> Array:
    return problem.values_at(x_of(problem.unknowns, state.z))


SCORE_COLUMNS = ("bodies", "links", "free", "share_left", "worse", "worse_sd", "chosen")
LEFT_OUT_COLUMNS = ("channel", "unit", "left_out", "zero", "noise")


@dataclass(frozen=True)
class Drafted:
    """A drafted twin part, remarks for people, and how the number of bodies was chosen.

    `scores` has a row per network tried, columns `SCORE_COLUMNS`: `share_left` of the movement in parts left out
    (geometric mean over parts and channels), `worse` its logarithm less the best one's with standard error `worse_sd`.
    `left_out` has a row per channel of the chosen one, columns `LEFT_OUT_COLUMNS`: rms over parts left out, the same if
    nothing moved, and the noise, in the channel's unit (K for temperatures).
    """

    part: TwinPart
    remarks: tuple[str, ...]
    scores: pd.DataFrame
    left_out: pd.DataFrame


@dataclass(frozen=True)
class _Tried:
    sketch: Sketch
    part: TwinPart
    scored: Scored


def drafted_part(
    machine: Machine,
    batches: Sequence[Batch],
    progress: Callable[[str, int, int], None] | None = None,
    max_bodies: int = POLICY.draft_max_bodies,
) -> Drafted:
    """The simplest network of at most `max_bodies` bodies that the recordings support.

    Temperatures determine only ratios: one heat is held at a round value (or, without any, one capacity), and every
    other W, W/K and J/K is relative to it. Values are fitted, spreads wide; the machine file's twin part is not read.

    Raises:
        InputError: no batch, no temperature, nothing that moves, `max_bodies` below 1. WorkError: no network is finite.
    """
    if max_bodies < 1:
        raise InputError(f"draft: max_bodies: got {max_bodies}, expected 1 or more")
    rows = rows_of(machine, batches)
    rises, movement = Rises.of(rows), moved(rows)
    heats, unheard = driven(machine, rows.tops)
    most = min(max_bodies, len(rows.temperatures)) if len(rows.batches) >= POLICY.draft_min_parts else 1

    def tried(count: int, extra_links: bool = False) -> _Tried:
        if progress:
            progress(f"draft with {_counted(count, 'body', 'bodies')}", count, most)
        drawn = sketch(rows, rises, heats, count, extra_links)
        part = part_of(machine, rows, rises, drawn)
        return _Tried(drawn, part, scored(compile_network(machine, part=part), rows.batches, movement))

    every = _tried_in_turn(tried, most)
    best = min(every, key=lambda t: t.scored.share_left)
    chosen = next(t for t in every if _as_good(t.scored, best.scored))
    if len(chosen.sketch.groups) > 2:
        meshed = _or_none(lambda: tried(len(chosen.sketch.groups), True))
        if meshed is not None:
            every.append(meshed)
            if not _as_good(chosen.scored, meshed.scored):
                chosen = meshed
    fit = chosen.scored
    left_out = [fit.channels, fit.units, np.nanmean(fit.left_out, axis=0), np.nanmean(fit.zero, axis=0), fit.noise]
    return Drafted(
        with_values(chosen.part, fit.network, fit.values),
        (*_words(rows, chosen, heats), *unheard, *rows.remarks),
        _scores(every, chosen),
        pd.DataFrame(dict(zip(LEFT_OUT_COLUMNS, left_out, strict=True))),
    )


def _tried_in_turn(tried: Callable[[int], _Tried], most: int) -> list[_Tried]:
    """Networks of 1, 2, … bodies, as long as one more is better now and then."""
    every = [tried(1)]
    best, failed = every[0].scored.share_left, 0
    for count in range(2, most + 1):
        one = _or_none(lambda count=count: tried(count))  # type: ignore[misc]
        if one is not None and len(one.sketch.groups) == count:
            every.append(one)
        if one is not None and one.scored.share_left < (1 - POLICY.draft_min_drop) * best:
            best, failed = one.scored.share_left, 0
        else:
            failed += 1
        if failed == POLICY.draft_patience:
            break
    return every


def _or_none(work: Callable[[], _Tried]) -> _Tried | None:
    """A network that the recordings are too few for, or that does not stay finite, is none."""
    try:
        return work()
    except (InputError, WorkError):
        return None


def _as_good(one: Scored, best: Scored) -> bool:
    """Whether the other is not better by more than its standard error and the least gain."""
    gain, error = best.better_than(one)
    return gain <= max(error, -np.log(1 - POLICY.draft_min_drop))


def _words(rows: Rows, chosen: _Tried, heats: Sequence[Driven]) -> tuple[str, ...]:
    drawn = chosen.sketch
    bodies = _counted(len(drawn.groups), "body", "bodies")
    parts = _counted(len(rows.batches), *(("block", "blocks") if rows.blocks else ("batch", "batches")))
    tested = (
        "in recordings that it was not fitted to"
        if len(rows.batches) >= POLICY.draft_min_parts
        else "that it was fitted to"
    )
    left = (
        f"the machine file has no twin part: {bodies} drafted from {parts}, named after sensors "
        f"({', '.join(drawn.names)}); it leaves {100 * chosen.scored.share_left:.0f} % of the movement {tested}"
    )
    if drawn.held is not None:
        heat = drawn.heats[drawn.held]
        held = f"{POLICY.draft_held_heat_W:g} W at {heat.top:g} {heat.unit}"
        scale = f"temperatures determine only ratios: {heat.name} is held at {held}"
    else:
        why = "no recorded driver heats it" if not drawn.heats else "no heat could be held"
        scale = f"{why}: the capacity of {drawn.names[0]} is held at {POLICY.draft_held_capacity_J_per_K / 1e3:g} kJ/K"
    remarks = [left, f"{scale}, and every other W, W/K and J/K is relative to that"]
    cold = [h.driver for h in heats if h not in drawn.heats]
    remarks += [f"driver {d} warms no body, so that the draft has no heat of it" for d in cold]
    if not rows.rooms:
        remarks.append("no ambient was recorded: the room is taken from first readings")
    remarks += [f"ambient {r} is not used: a draft has one room, {rows.rooms[0]}" for r in rows.rooms[1:]]
    return tuple(remarks)


def _counted(count: int, one: str, several: str) -> str:
    return f"{count} {one if count == 1 else several}"


def _scores(every: Sequence[_Tried], chosen: _Tried) -> pd.DataFrame:
    best = min(every, key=lambda t: t.scored.share_left).scored
    out = []
    for t in every:
        worse, error = best.better_than(t.scored)
        out.append(
            (len(t.sketch.groups), len(t.sketch.links), len(t.scored.network.free), t.scored.share_left, worse, error,
             t is chosen)
        )  # fmt: skip
    return pd.DataFrame(out, columns=list(SCORE_COLUMNS))
