"""How probable a claim is: a logistic model of a figure that is free of scale.

What a wrong claim gains in nats grows with the recordings and with what a network cannot represent. So a claim is
judged by what it gains relative to the log evidence of the fit before it. Offset and weight are fitted to development
cases of several kinds of machine (`results/claims.csv`). Of the other figures there (odds of the mechanism,
lead over what differs, share of runs) none makes it better, left-out kinds judged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import softmax

from data.arrays import Array
from diagnosis.contracts import Candidate, Scored
from diagnosis.fitting.fit import Fitted
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen


@dataclass(frozen=True)
class Tried:
    """A candidate after its full refit; `gain` in nats of log evidence over the fit before.

    `by_run` (B,) is what each left-out batch gains, `cluster` the first of the candidates that these recordings cannot
    distinguish, `log_prior` of its law and of the equipment that it needs. Where it is `confirmed`, the gain is
    the lesser under two structures: that of the fit before, and the one that is drawn with what either fit holds.
    """

    scored: Scored
    fitted: Fitted
    gain: float
    by_run: Array
    cluster: str
    log_prior: float
    confirmed: bool = False

    @property
    def candidate(self) -> Candidate:
        return self.scored.candidate

    @property
    def improved(self) -> int:
        """Left-out batches that are predicted better."""
        return int((self.by_run > 0).sum())

    @property
    def score(self) -> float:
        """Log weight among explanations; free forms imitate any law to within a share of its gain."""
        credit = POLICY.free_form_credit if self.candidate.kind.is_unlisted else 1.0
        return credit * self.gain + self.log_prior


@dataclass(frozen=True)
class Figures:
    """Of a claim, free of units: `relative_gain`, nats gained over the absolute log evidence of the fit before, which
    its probability follows; `log_odds` of the mechanism before the recordings; `lead`, the share of the gain that the
    best different explanation lacks; `agreeing`, the share of the runs that are predicted better."""

    relative_gain: float
    log_odds: float
    lead: float
    agreeing: float

    @property
    def probability(self) -> float:
        """That the claim is true."""
        score = POLICY.claim_offset + POLICY.claim_weight * np.log(max(self.relative_gain, 1e-9))
        return float(1.0 / (1.0 + np.exp(-score)))


def least_relative_gain() -> float:
    """From which on a claim is made."""
    p = POLICY.claim_min_probability
    return float(np.exp((np.log(p / (1.0 - p)) - POLICY.claim_offset) / POLICY.claim_weight))


@dataclass(frozen=True)
class Round:
    """One round: all that was tried, the likeliest first, and how probable it is.

    `resolved`: channels that show what is impossible without the claim; `forms`: the terms (`free_forms.Form`) of
    candidates of no listed mechanism.
    """

    before: Fitted
    screen: Screen
    tried: tuple[Tried, ...]
    figures: Figures | None = None
    resolved: frozenset[str] = frozenset()
    forms: Mapping[str, Any] = field(default_factory=dict)

    @property
    def best(self) -> Tried | None:
        return self.tried[0] if self.tried else None

    @property
    def claim_probability(self) -> float:
        """The probability that the first is true, or one that recordings cannot distinguish from it."""
        if self.figures is None:
            return 0.0
        return POLICY.max_probability if self.resolved else self.figures.probability

    @property
    def accepted(self) -> bool:
        return self.claim_probability >= POLICY.claim_min_probability

    @property
    def threshold(self) -> float:
        """Nats from which on an effect is claimed."""
        return least_relative_gain() * abs(self.before.log_evidence)


def figures(before: Fitted, tried: Sequence[Tried]) -> Figures:
    """Of the first of those that were tried."""
    first = tried[0]
    gain = max(first.gain, 1e-9)
    other = max((t.gain for t in tried[1:] if differs(first, t)), default=0.0)
    lead = float(np.clip(1.0 - other / gain, -1.0, 1.0))
    return Figures(gain / abs(before.log_evidence), first.log_prior, lead, first.improved / len(first.by_run))


def differs(one: Tried, other: Tried) -> bool:
    """Whether another explanation has another mechanism at another place, and recordings can distinguish the two."""
    a, b = one.candidate, other.candidate
    return a.mechanism != b.mechanism and a.where.name != b.where.name and one.cluster != other.cluster


def indistinguishable(one: Tried, other: Tried) -> bool:
    """Whether a user acts on both explanations in the same way: recordings cannot distinguish them, or they are of one
    place and nearly as likely."""
    same_place = one.candidate.where == other.candidate.where
    close = abs(one.score - other.score) < POLICY.decisive_nats
    return one.cluster == other.cluster or (same_place and close)


@dataclass(frozen=True)
class Explanation:
    """A candidate with its probability, and whether the recordings cannot distinguish it from the best."""

    tried: Tried
    probability: float
    indistinguishable: bool


def probability_cap(runs: int) -> float:
    """The highest probability that so many runs allow."""
    few = POLICY.few_runs_max_probability
    return few[runs - 1] if 1 <= runs <= len(few) else POLICY.max_probability


def explanations(done: Round) -> tuple[list[Explanation], float, float]:
    """Of a round's candidates, the claim first; then of nothing, and of something that is not listed: they add to 1.

    The claim, with all that is indistinguishable from it, has the probability of its figures. The rest is shared in
    proportion to gains and odds, tempered by what structure scatters gains by; nothing is as likely as an effect that
    would just be claimed.
    """
    runs = done.before.runs or len(done.before.batches)
    best = done.best
    top = best.score if best is not None else 0.0
    scale = max(POLICY.temperature_share * max(top, done.threshold), POLICY.temperature_min_nats)
    other = done.threshold - np.log(POLICY.unlisted_odds) * scale
    score = np.array([t.score for t in done.tried] + [done.threshold, other])
    if done.resolved:
        score[-2] = -np.inf
    if best is None:
        weight = softmax(score / scale)
        return [], float(weight[-2]), float(weight[-1])
    like = np.array([t is best or indistinguishable(best, t) for t in done.tried] + [False, False])
    own = min(done.claim_probability, probability_cap(runs))
    weight = np.empty(len(score))
    weight[like], weight[~like] = own * softmax(score[like] / scale), (1.0 - own) * softmax(score[~like] / scale)
    every = zip(done.tried, weight.tolist(), like.tolist(), strict=False)
    out = [Explanation(t, p, a) for t, p, a in every]
    return [out[0], *sorted(out[1:], key=lambda e: -e.probability)], float(weight[-2]), float(weight[-1])


def reported(every: Sequence[Explanation], most: int = POLICY.reported_alternatives) -> list[Explanation]:
    """The alternatives worth a line."""
    return [e for e in every[1:] if e.probability >= POLICY.reported_min_probability][:most]
