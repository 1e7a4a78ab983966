"""Second thoughts: with all effects in, is each still needed, and is its likeliest rival not the better one?

Forward steps can name a substitute that a later effect makes needless (Efroymson 1960): deletion and swaps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from pydantic import BaseModel

from data.errors import InputError, WorkError
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.proposals.priors import start_values
from twin.diagnosis.proposals.values_of_part import with_parts
from twin.diagnosis.rounds.fitted import Fitted, refitted, settle
from twin.diagnosis.rounds.refits import Tried
from twin.diagnosis.rounds.workers import Workers
from twin.diagnosis.scoring.screen import alone
from twin.schema import TwinPart

RIVALS = 2  # of each effect that are tried in its place
NEEDLESS = 0.5  # of its gain: what still loses more was not made needless by a later effect, however small it is
BETTER = 3.0  # nats by which a rival must fit better beside all others


@dataclass(frozen=True)
class Second:
    """An effect taken out, or replaced: how much worse the batches left out are predicted, in nats."""

    effect: int
    rival: Tried | None
    loss: float
    fitted: Fitted


@dataclass(frozen=True)
class _Work:
    effect: int
    part: TwinPart
    rival: Tried | None
    at: dict[str, float]


def second_thoughts(
    final: Fitted,
    effects: list[Tried],
    rivals: list[list[Tried]],
    original: TwinPart,
    least: float,
    temperature: float,
    workers: Workers,
) -> Second | None:
    """The best change of the set of effects, or None: an effect dropped whose loss is below `least` nats and well
    below what it gained when it was accepted, or a rival in its place that gains more than it is less plausible,
    `temperature` nats for each of log prior. Effects and rivals as the rounds tried them."""
    work = []
    for k, t in enumerate(effects):
        rest = without(final.part, t.candidate, original)
        work.append(_Work(k, rest, None, {}))
        for r in rivals[k][:RIVALS]:
            values, at = start_values(r.scored, final)
            try:
                work.append(_Work(k, r.candidate.applied(rest, values), r, dict(at)))
            except (ValueError, KeyError):
                continue
    score = float(alone(final, final.memory).base_score()[0])
    done = [s for s in workers.map(partial(_changed, final, score), work) if s is not None]
    return best_change(done, effects, least, temperature)


def best_change(done: Sequence[Second], effects: Sequence[Tried], least: float, temperature: float) -> Second | None:
    """Of changes that were fitted the one that costs least, if it may be made; as `second_thoughts`."""

    def due(s: Second) -> bool:
        if s.rival is None:
            return s.loss < min(least, NEEDLESS * effects[s.effect].gain)
        return s.loss + temperature * (effects[s.effect].log_prior - s.rival.log_prior) < -BETTER

    return min((s for s in done if due(s)), key=lambda s: s.loss, default=None)


def _changed(final: Fitted, score: float, w: _Work) -> Second | None:
    try:
        fitted = settle(refitted(final, w.part, w.at), steps=4, tolerance=0.05, rounds=2)
        loss = score - float(alone(fitted, final.memory).base_score()[0])
    except (InputError, WorkError):
        return None
    return Second(w.effect, w.rival, loss, fitted)


def without(part: TwinPart, c: Candidate, original: TwinPart) -> TwinPart:
    """The twin part as it would be had this candidate not been accepted."""
    if c.part is not None:
        return with_parts(part, {f"mechanisms.{c.name}": None})
    if c.change is not None:
        group, name = c.change.parameter.name.split(".")[:2]
        known = getattr(original, group)
        return with_parts(part, {f"{group}.{name}": known[name]} if name in known else {})
    return with_parts(part, {path: _part_at(original, path) for path in c.parts})


def _part_at(part: TwinPart, path: str) -> BaseModel | None:
    group, name = path.split(".", 1)
    found: BaseModel | None = getattr(part, group).get(name)
    return found
