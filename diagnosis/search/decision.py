"""What of a round's refits is claimed: the order in which they are evaluated, the criteria, and the decision."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from data.arrays import Array
from diagnosis.contracts import Fitted, Tried
from diagnosis.fitting.fitted import left_out_rows, worsened
from diagnosis.localisation.balance import impossible
from diagnosis.policy import POLICY, Policy
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.screen import Screen, alone
from diagnosis.search.acceptance import (
    few_worse,
    flipped_gains,
    flipped_threshold,
    least_gain,
    sign_p,
    stands_out,
    trust,
)
from diagnosis.search.null import Null, null_with
from diagnosis.search.refits import common_memory, optimised, refit


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
    own_null: Null | None = None  # at the fit with the best
    density: float = 0.0  # of batches left out at that fit, in nats
    seed: int = 0  # of the signs and of the null
    raised: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # channels by which the best was refused
    resolved: frozenset[str] = frozenset()  # channels that show what is impossible without the best

    @property
    def scatter(self) -> float:
        """By how much structure alone moves the amplitude of the best, in its unit; 0 where that is not known."""
        if self.own_null is None or self.best is None:
            return 0.0
        return self.own_null.scatter(self.best.candidate.name, self.density)

    @property
    def best(self) -> Tried | None:
        return self.tried[0] if self.tried else None

    @property
    def trust(self) -> float:
        """The probability that the best is no chance."""
        return 1.0 if self.resolved or self.best is None else trust(self.best)


@dataclass(frozen=True)
class Criteria:
    """What the claims of a round are judged by: the fit before it, the screen there and the structural null.

    `columns` are the screen's, by candidate, of those that would be an alarm; `seed` draws signs and the null.
    """

    now: Fitted
    seen: Screen
    null: Null
    columns: Mapping[str, int]
    seed: int
    policy: Policy = POLICY

    def resolved(self, t: Tried) -> frozenset[str]:
        """Channels that show what the fit before cannot do whatever its values, and that an effect makes possible."""
        before = frozenset(i.channel for i in impossible(self.now))
        if not before or t.fitted is None or not t.candidate.kind.is_physics:
            return frozenset()
        return before - {i.channel for i in impossible(t.fitted)}

    @cached_property
    def density(self) -> float:
        """Of batches left out before any claim, in nats."""
        return self.score(self.now)[1]

    def score(self, fitted: Fitted) -> tuple[Evidence, float]:
        """How a fit predicts batches left out, its rows counted as before the claim, and its log density in nats."""
        evidence = alone(fitted, common_memory([self.now], self.policy))
        return evidence, float(evidence.base_score(left_out=self.policy.leaves_batches_out)[0])

    def structure(self, name: str) -> float:
        """Nats that structure alone may make of this candidate."""
        if not self.policy.uses_structural_null:
            return 0.0
        return self.null.threshold(self.density, name=name)


def decided(criteria: Criteria, tried: Sequence[Tried]) -> Round:
    """The round, given its refits, best first: its best is the first of them that is accepted, or, if none is, the
    first that was evaluated."""
    now, n = criteria.now, len(criteria.now.batches)
    if not tried or tried[0].fitted is None:
        least = max(criteria.structure(tried[0].candidate.name if tried else ""), POLICY.even_odds_gain_nats)
        return Round(
            now, criteria.seen, tuple(tried), least, criteria.null, np.zeros((0, 0)), False, seed=criteria.seed
        )
    for needed in (t for t in tried if criteria.resolved(t)):
        if (done := evaluated(criteria, tried, needed)).accepted:
            return done
    best = first_claimable(tried, n)
    if best.gain > least_gain(best) and best.candidate.kind.is_physics:  # agreed on or not
        finer = _independent_refinement(criteria, best, tried)
        if finer is not None and (done := evaluated(criteria, tried, finer)).accepted:
            return done
    first = evaluated(criteria, tried, best)
    if first.accepted or best.gain <= POLICY.even_odds_gain_nats or not best.candidate.kind.is_physics:
        return first
    # What structure may make of one effect, and of its imitators, says nothing of another that gains in a fit with it.
    for other in alternatives_to(criteria, best, tried):
        better = next(k for k, t in enumerate(tried) if t is other)
        like = other.cluster == best.cluster
        rest = [
            replace(t, barred=True) if k < better or (t.cluster == best.cluster and not like) else t
            for k, t in enumerate(tried)
        ]
        if (done := evaluated(criteria, rest, other)).accepted:
            return done
    return first


def evaluated(criteria: Criteria, tried: Sequence[Tried], best: Tried) -> Round:
    """The round with `best` as its claim, and whether it is accepted."""
    assert best.fitted is not None
    now, null, names, policy = criteria.now, criteria.null, list(criteria.columns), criteria.policy
    n = len(now.batches)
    after, density = criteria.score(best.fitted)
    flipped = flipped_gains(criteria.seen.evidence, after, list(criteria.columns.values()), criteria.seed, policy)
    agreed, own, structure = agreed_on(best, n), null, 0.0
    if policy.uses_structural_null:
        if agreed and best.gain > policy.even_odds_gain_nats:
            own, density = null_with(now, best.fitted, best.candidate, criteria.seed, policy) or (null, density)
        if best.candidate.kind.is_physics:  # what structure makes is what a finer network is for
            structure = own.threshold(density, name=best.candidate.name)
    which = names.index(best.candidate.name) if best.candidate.name in names else None
    least = least_gain(best if agreed else replace(best, worse=0))  # as of one that no batch speaks against
    resolved = criteria.resolved(best)  # without it nothing explains the recording: there is no chance to rule out
    threshold = 0.0 if resolved else max(structure, flipped_threshold(flipped, n, which), least)
    unlikely = not resolved and _less_likely_than_nothing(best, threshold, null.temperature)
    accepted = best.gain > threshold and agreed and not unlikely
    raised = worsened(left_out_rows(now), left_out_rows(best.fitted)) if accepted else {}
    tried = (best, *(t for t in tried if t is not best))
    return Round(
        now,
        criteria.seen,
        tried,
        threshold,
        null,
        flipped,
        accepted and not raised,
        sign_p(best.improved, n),
        own,
        density,
        criteria.seed,
        raised,
        resolved,
    )


def first_claimable(tried: Sequence[Tried], batches: int) -> Tried:
    """The first of the refits, best first, that most batches agree on and that gains enough; else the best."""
    for t in tried[: POLICY.finalists]:
        if gains_enough(t, batches):
            return t if t.gain > POLICY.claim_min_gain_share * tried[0].gain else tried[0]
    return tried[0]


def coarse_first(tried: list[Tried]) -> list[Tried]:
    """The refits with a finer network first, if it gains nearly as much as the best: it is the simpler explanation."""
    enough = POLICY.coarse_first_gain_share * (tried[0].level if tried else 0.0)
    finer = [t for t in tried if not t.candidate.kind.is_physics and t.level > enough > 0]
    return finer[:1] + [t for t in tried if t not in finer[:1]]


def alternatives_to(criteria: Criteria, first: Tried, tried: Sequence[Tried]) -> list[Tried]:
    """Further finalists that may be claimed where the first may not.

    They gain nearly as much in a fit with the first, or they belong to its cluster and gain more than it.
    """
    out: list[Tried] = []
    for t in effects_of(tried, len(criteria.now.batches)):
        if len(out) == POLICY.alternatives_judged:
            break
        like = t.cluster == first.cluster
        if t is not first and (t.gain > first.gain if like else _gains_jointly(criteria, first, t)):
            out.append(t)
    return out


def effects_of(tried: Sequence[Tried], batches: int) -> list[Tried]:
    """The finalists that gain what a claim takes; no finer network."""
    return [t for t in tried if t.candidate.kind.is_physics and gains_enough(t, batches)]


def gains_enough(t: Tried, batches: int) -> bool:
    """Whether, refitted, few batches speak against it and it gains what one of its kind takes."""
    return t.fitted is not None and agreed_on(t, batches) and t.gain > least_gain(t)


def agreed_on(t: Tried, batches: int) -> bool:
    """Whether few batches get worse and the interval of its size excludes no effect."""
    return few_worse(t, batches) and stands_out(t)


def _less_likely_than_nothing(best: Tried, threshold: float, temperature: float) -> bool:
    """Whether no effect at all would be far more likely, with rows counted as for the alternatives.

    The memory of its own fit may count a few rows as many.
    """
    if not best.candidate.kind.is_physics:
        return False
    return threshold - best.level > temperature * float(np.log(POLICY.nothing_max_odds))


def _independent_refinement(criteria: Criteria, best: Tried, tried: Sequence[Tried]) -> Tried | None:
    """A finer network that neither the best effect nor the next explains, at its optimum; None where there is none.

    What heat or a lever adds makes a network look too coarse, and with it in that is over; castings stay too
    coarse whatever is added, and an effect is better judged where they are not.
    """
    batches, least = len(criteria.now.batches), POLICY.coarse_min_gain_nats
    finer = [t for t in tried if not t.candidate.kind.is_physics and t.fitted is not None]
    agreed = [t for t in finer if t.gain > least and agreed_on(t, batches)]
    others = [t for t in effects_of(tried, batches) if t.cluster != best.cluster]
    effects = [best, *others[: POLICY.alternatives_judged]]
    for first in sorted(agreed, key=lambda t: -t.gain)[: POLICY.coarse_alternatives]:
        if all(_gains_jointly(criteria, effect, first, least) for effect in effects):
            return optimised(criteria.now, first, criteria.policy)
    return None


def _gains_jointly(criteria: Criteria, first: Tried, t: Tried, least: float = POLICY.even_odds_gain_nats) -> bool:
    """Whether it gains much of what it does alone, and no less than `least` nats, in a fit that has the first."""
    assert first.fitted is not None
    joint = refit(first.fitted, t.scored, criteria.policy)
    return joint is not None and joint.gain > max(POLICY.joint_gain_share * t.gain, least)
