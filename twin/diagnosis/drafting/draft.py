"""The simplest network that recordings support, for a machine file without a twin part.

Sensors that move alike share a body; the bodies form a tree of conductances in a room; every driver is a heat. How
many bodies there are is what predicts parts of the recordings that were left out, by the one-standard-error rule
(Breiman, Friedman, Olshen and Stone 1984, Classification and Regression Trees, section 3.4.3).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from data.batch import Batch
from data.errors import InputError, WorkError
from data.machine import Machine
from twin.compile import compile_network
from twin.diagnosis.drafting.clusters import Rises
from twin.diagnosis.drafting.heats import HELD_W, Driven, driven
from twin.diagnosis.drafting.part import HELD_J_PER_K, Sketch, moved, part_of, sketch, with_values
from twin.diagnosis.drafting.rows import LEAST_PARTS, Rows, rows_of
from twin.diagnosis.drafting.score import Scored, scored
from twin.schema import TwinPart

LEAST_GAIN = 0.03  # relative fall of what is left, for a body or a set of links more
PATIENCE = 2  # counts of bodies that may fail to be better before the search ends
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
    words: tuple[str, ...]
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
    max_bodies: int = 8,
) -> Drafted:
    """The simplest network of at most `max_bodies` bodies that the recordings support.

    Temperatures determine ratios alone: one heat is held at a round value (or, without any, one capacity), and every
    other W, W/K and J/K is relative to it. Values are fitted, spreads wide; the machine file's twin part is not read.

    Raises:
        InputError: no batch, no temperature, nothing that moves, `max_bodies` below 1. WorkError: no network is finite.
    """
    if max_bodies < 1:
        raise InputError(f"draft: max_bodies: got {max_bodies}, expected 1 or more")
    rows = rows_of(machine, batches)
    rises, movement = Rises.of(rows), moved(rows)
    heats, unheard = driven(machine, rows.tops)
    most = min(max_bodies, len(rows.temperatures)) if len(rows.batches) >= LEAST_PARTS else 1

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
    return Drafted(
        with_values(chosen.part, chosen.scored.network, chosen.scored.values),
        (*_words(rows, chosen, heats), *unheard, *rows.words),
        _scores(every, chosen),
        _left_out(chosen.scored),
    )


def _tried_in_turn(tried: Callable[[int], _Tried], most: int) -> list[_Tried]:
    """Networks of 1, 2, … bodies, as long as one more is better now and then."""
    every = [tried(1)]
    best, failed = every[0].scored.share_left, 0
    for count in range(2, most + 1):
        one = _or_none(lambda count=count: tried(count))  # type: ignore[misc]
        if one is not None and len(one.sketch.groups) == count:
            every.append(one)
        if one is not None and one.scored.share_left < (1 - LEAST_GAIN) * best:
            best, failed = one.scored.share_left, 0
        else:
            failed += 1
        if failed == PATIENCE:
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
    return gain <= max(error, -np.log(1 - LEAST_GAIN))


def _words(rows: Rows, chosen: _Tried, heats: Sequence[Driven]) -> tuple[str, ...]:
    drawn = chosen.sketch
    bodies = _counted(len(drawn.groups), "body", "bodies")
    parts = _counted(len(rows.batches), *(("block", "blocks") if rows.blocks else ("batch", "batches")))
    tested = "in recordings that it was not fitted to" if len(rows.batches) >= LEAST_PARTS else "that it was fitted to"
    left = (
        f"the machine file has no twin part: {bodies} drafted from {parts}, named after sensors "
        f"({', '.join(drawn.names)}); it leaves {100 * chosen.scored.share_left:.0f} % of the movement {tested}"
    )
    if drawn.held is not None:
        heat = drawn.heats[drawn.held]
        scale = f"temperatures determine ratios alone: {heat.name} is held at {HELD_W:g} W at {heat.top:g} {heat.unit}"
    else:
        why = "no recorded driver heats it" if not drawn.heats else "no heat could be held"
        scale = f"{why}: the capacity of {drawn.names[0]} is held at {HELD_J_PER_K / 1e3:g} kJ/K"
    words = [left, f"{scale}, and every other W, W/K and J/K is relative to that"]
    cold = [h.driver for h in heats if h not in drawn.heats]
    words += [f"driver {d} warms no body, so that the draft has no heat of it" for d in cold]
    if not rows.rooms:
        words.append("no ambient was recorded: the room is taken from first readings")
    words += [f"ambient {r} is not used: a draft has one room, {rows.rooms[0]}" for r in rows.rooms[1:]]
    return tuple(words)


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


def _left_out(found: Scored) -> pd.DataFrame:
    columns = [found.channels, found.units, np.nanmean(found.left_out, axis=0), np.nanmean(found.zero, axis=0)]
    return pd.DataFrame(dict(zip(LEFT_OUT_COLUMNS, [*columns, found.noise], strict=True)))
