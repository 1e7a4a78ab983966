"""What of a round's refits is claimed: who is asked first, what it is held to, and the verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from data.arrays import Array
from diagnosis.contracts import Fitted, Tried
from diagnosis.screening.screen import Screen, alone
from diagnosis.search.acceptance import (
    EVEN,
    LEAST_FINER,
    flipped_gains,
    flipped_threshold,
    least_gain,
    sign_p,
    stands_out,
)
from diagnosis.search.null import Null, null_beside
from diagnosis.search.refits import refit, taken_on

FINALISTS = 4  # refits that are taken on to their optimum, and that may be claimed
IMPROVED = 0.75  # share of the left-out batches that must improve
WORTH_A_CLAIM = 0.5  # of the highest gain: what improves most batches is asked before what improves a few by more
APART = 0.4  # of a gain: what gains as much beside another is none of it
UNLIKELY = 20.0  # odds of nothing against it, with rows counted as for its rivals, at which nothing is claimed
NEXT = 2  # that are asked after one whose own null speaks against it
FINER = 0.9  # of the best gain: a finer network that gains as much comes first


@dataclass(frozen=True)
class Round:
    """One round: all that was tried, best first, and what it took to be accepted."""

    before: Fitted
    screen: Screen
    tried: tuple[Tried, ...]
    threshold: float
    null: Null
    flipped: Array
    accepted: bool
    sign_p: float = 1.0
    beside: Null | None = None  # the null of the best where the fit has it
    density: float = 0.0  # of batches left out, in nats, where the fit has it

    @property
    def scatter(self) -> float:
        """By how much structure alone moves the best's amplitude, in its unit; 0 where that is not known."""
        if self.beside is None or self.best is None:
            return 0.0
        return self.beside.scatter(self.best.candidate.name, self.density)

    @property
    def best(self) -> Tried | None:
        return self.tried[0] if self.tried else None


@dataclass(frozen=True)
class Bars:
    """What every claim of a round is held to: the fit before it, what the screen saw there, what structure alone gains.

    `columns` are the screen's of all candidates by name; `seed` draws the signs of flipped residuals.
    """

    now: Fitted
    seen: Screen
    null: Null
    columns: Mapping[str, int]
    seed: int

    @cached_property
    def density(self) -> float:
        """Of batches left out before any claim, in nats."""
        return float(alone(self.now, self.now.memory).base_score()[0])

    def structure(self, name: str) -> float:
        """Nats that structure alone may make of this candidate."""
        return self.null.threshold(self.density, name=name)


def decided(bars: Bars, tried: Sequence[Tried]) -> Round:
    """The round in which the first that may be claimed of those tried, best first, is its best; if none may, the first
    that was asked is."""
    now, n = bars.now, len(bars.now.batches)
    if not tried or tried[0].fitted is None:
        least = max(bars.structure(tried[0].candidate.name if tried else ""), EVEN)
        return Round(now, bars.seen, tuple(tried), least, bars.null, np.zeros((0, 0)), False)
    best = to_claim(tried, n)
    if best.gain > least_gain(best, n) and best.candidate.mechanism != "coarse_network":  # agreed on or not
        finer = _apart(now, best, tried, n)
        if finer is not None and (done := asked(bars, tried, finer)).accepted:
            return done
    first = asked(bars, tried, best)
    if first.accepted or best.gain <= EVEN or best.candidate.mechanism == "coarse_network":
        return first
    # What structure may make of one effect, and of what imitates it, is not said of another that stands beside it.
    for other in elsewhere(best, tried, n):
        better = next(k for k, t in enumerate(tried) if t is other)
        like = other.cluster == best.cluster
        rest = [
            replace(t, barred=True) if k < better or (t.cluster == best.cluster and not like) else t
            for k, t in enumerate(tried)
        ]
        if (done := asked(bars, rest, other)).accepted:
            return done
    return first


def asked(bars: Bars, tried: Sequence[Tried], best: Tried) -> Round:
    """The round with this one of those tried as its best, and whether it is accepted."""
    assert best.fitted is not None
    now, null, names = bars.now, bars.null, list(bars.columns)
    n = len(now.batches)
    after = alone(best.fitted, now.memory)
    flipped = flipped_gains(bars.seen.evidence, after, list(bars.columns.values()), bars.seed)
    agreed = agreed_on(best, n)
    beside = null_beside(now, best.fitted, best.candidate, bars.seed) if agreed and best.gain > EVEN else None
    own, density = (null, float(after.base_score()[0])) if beside is None else beside
    structure = own.threshold(density, name=best.candidate.name)
    if best.candidate.mechanism == "coarse_network":
        structure = 0.0  # what structure makes is what it is for
    which = names.index(best.candidate.name) if best.candidate.name in names else None
    least = least_gain(best, n if agreed else best.improved)  # else the bar of one that all batches agree on
    threshold = max(structure, flipped_threshold(flipped, n, which), least)
    accepted = best.gain > threshold and agreed and not _unlikely(best, threshold, null.temperature)
    tried = (best, *(t for t in tried if t is not best))
    return Round(now, bars.seen, tried, threshold, null, flipped, accepted, sign_p(best.improved, n), own, density)


def to_claim(tried: Sequence[Tried], batches: int) -> Tried:
    """Of refits, best first, the first that improves most batches, stands out and gains enough; else the best."""
    for t in tried[:FINALISTS]:
        if gains_enough(t, batches):
            return t if t.gain > WORTH_A_CLAIM * tried[0].gain else tried[0]
    return tried[0]


def coarse_first(tried: list[Tried]) -> list[Tried]:
    """A finer network is the simpler explanation: physics goes first only where it gains clearly more."""
    enough = FINER * (tried[0].level if tried else 0.0)
    finer = [t for t in tried if t.candidate.mechanism == "coarse_network" and t.level > enough > 0]
    return finer[:1] + [t for t in tried if t not in finer[:1]]


def elsewhere(first: Tried, tried: Sequence[Tried], batches: int) -> list[Tried]:
    """Further finalists that may be claimed where the first may not: with it in, they gain nearly as much, or they look
    like it and gain more where each counts rows as its own fit remembers them."""
    out: list[Tried] = []
    for t in effects_of(tried, batches):
        like = t.cluster == first.cluster
        if len(out) < NEXT and t is not first and (t.gain > first.gain if like else _beside(first, t)):
            out.append(t)
    return out


def effects_of(tried: Sequence[Tried], batches: int) -> list[Tried]:
    """The finalists that gain what a claim takes; no finer network."""
    return [t for t in tried if is_effect(t, batches)]


def is_effect(t: Tried, batches: int) -> bool:
    """Whether it gains what a claim takes, and is no finer network."""
    return t.candidate.mechanism != "coarse_network" and gains_enough(t, batches)


def gains_enough(t: Tried, batches: int) -> bool:
    """Whether, refitted, most batches agree on it and it gains what one of its kind takes."""
    return t.fitted is not None and agreed_on(t, batches) and t.gain > least_gain(t, batches)


def agreed_on(t: Tried, batches: int) -> bool:
    """Whether most batches improve and its size stands out from nothing."""
    return bool(t.improved >= IMPROVED * batches and stands_out(t))


def _unlikely(best: Tried, threshold: float, temperature: float) -> bool:
    """Whether nothing would be far likelier, where its rows count as its rivals' do.

    Its own memory may make many rows of a few: a lever that gained 240 nats so gained 96 beside its rivals.
    """
    if best.candidate.mechanism == "coarse_network":
        return False
    return threshold - best.level > temperature * float(np.log(UNLIKELY))


def _apart(now: Fitted, best: Tried, tried: Sequence[Tried], batches: int) -> Tried | None:
    """A finer network that neither the best effect nor the next explains, taken on; None where there is none.

    What heat or a lever really adds makes a network look too coarse, and with it in that is over; castings stay too
    coarse whatever is added, and an effect is better judged where they are not.
    """
    finer = [t for t in tried if t.candidate.mechanism == "coarse_network" and t.fitted is not None]
    agreed = [t for t in finer if t.gain > LEAST_FINER and agreed_on(t, batches)]
    effects = [best, *(t for t in effects_of(tried, batches) if t.cluster != best.cluster)][: 1 + NEXT]
    for first in sorted(agreed, key=lambda t: -t.gain)[:2]:
        if all(_beside(effect, first, LEAST_FINER) for effect in effects):
            return taken_on(now, first)
    return None


def _beside(first: Tried, t: Tried, least: float = EVEN) -> bool:
    """Whether it gains much of what it does alone, and no less than `least` nats, in a fit that has the first."""
    assert first.fitted is not None
    beside = refit(first.fitted, t.scored)
    return beside is not None and beside.gain > max(APART * t.gain, least)
