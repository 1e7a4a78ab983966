"""How probable a claim is: a logistic model of its gain over what structure alone gains on the same machine.

The weights are a fit to development cases of eight kinds of machines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from data.arrays import Array
from diagnosis.contracts import Fitted, Tried
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen
from twin.mechanisms import MECHANISMS

FEATURES = ("excess", "network", "later")


@dataclass(frozen=True)
class Round:
    """One round: all that was tried, the claim first, and how probable it is.

    `null` (T,) are the largest gains on refined twins with nothing missing, in nats; `features` of the claim by name;
    `raised` channels by which it was refused, with rms before and after; `resolved` channels that show what is
    impossible without it; `forms` the terms (`free_forms.Form`) of candidates of no listed mechanism; `later` after an
    effect that was accepted.
    """

    before: Fitted
    screen: Screen
    tried: tuple[Tried, ...]
    null: Array
    trust: float
    accepted: bool
    features: Mapping[str, float] = field(default_factory=dict)
    raised: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    resolved: frozenset[str] = frozenset()
    forms: Mapping[str, Any] = field(default_factory=dict)
    later: bool = False

    @property
    def best(self) -> Tried | None:
        return self.tried[0] if self.tried else None

    @property
    def threshold(self) -> float:
        """Nats that structure alone gains in one of a hundred refined twins (Gumbel 1958)."""
        return null_quantile(self.null)


def null_quantile(null: Array) -> float:
    """The 99 % quantile of largest gains (T,) by a Gumbel distribution of their mean and spread."""
    scale = float(np.std(null, ddof=1)) * np.sqrt(6.0) / np.pi
    return float(np.mean(null) - scale * (np.euler_gamma + np.log(-np.log(POLICY.chance_quantile))))


def features(t: Tried, done: Round) -> dict[str, float]:
    """Of a claim of a round, by `FEATURES`.

    excess: logarithm of its gain over what structure gains in one of a hundred refined twins and what wrong claims gain
    on any machine; network: 1 for what may only say that a network is drawn too coarse, or follows no law; later: 1
    after an effect that was accepted, which is never modelled to the last nat.
    """
    c = t.candidate
    coarse = c.mechanism in MECHANISMS and MECHANISMS[c.mechanism].of_network
    return {
        "excess": float(np.log((1.0 + max(t.gain, 0.0)) / (max(done.threshold, 1.0) + POLICY.claim_scatter_nats))),
        "network": float(c.kind.is_unlisted or coarse),
        "later": float(done.later),
    }


def trust(of: Mapping[str, float]) -> float:
    """The probability that a claim of these features is true."""
    odds = POLICY.claim_offset + sum(w * of[name] for name, w in zip(FEATURES, POLICY.claim_weights, strict=True))
    return float(1.0 / (1.0 + np.exp(-odds)))


@dataclass(frozen=True)
class Explanation:
    """A candidate with its probability; `alike` where the recordings cannot distinguish it from the best."""

    tried: Tried
    probability: float
    alike: bool


def probability_cap(runs: int) -> float:
    """The highest probability that so many runs allow."""
    few = POLICY.few_runs_max_probability
    return few[runs - 1] if 1 <= runs <= len(few) else POLICY.max_probability


def explanations(done: Round) -> tuple[list[Explanation], float, float]:
    """Of a round's candidates, the claim first; then of nothing, and of something that is not listed: they add to 1.

    The claim, with all that these recordings cannot distinguish from it, has the probability that the calibrated model
    gives. The rest is shared in proportion to gains and odds, tempered by what structure scatters gains by; nothing is
    as likely as an effect that gains what structure does.
    """
    runs = done.before.runs or len(done.before.batches)
    best = done.best
    scale = max(POLICY.temperature_null_share * done.threshold, POLICY.temperature_min_nats)
    other = done.threshold - np.log(POLICY.unlisted_odds) * scale
    standing = np.array([t.standing for t in done.tried] + [done.threshold, other])
    if done.resolved:
        standing[-2] = -np.inf
    weight = np.exp((standing - standing.max()) / scale)
    if best is None:
        weight /= weight.sum()
        return [], float(weight[-2]), float(weight[-1])
    like = np.array([t.cluster == best.cluster for t in done.tried] + [False, False])
    own = min(done.trust, probability_cap(runs))
    weight[like] *= own / weight[like].sum()
    weight[~like] *= (1.0 - own) / max(weight[~like].sum(), 1e-300)
    out = [
        Explanation(t, float(p), bool(a) or p > POLICY.alike_min_probability_share * weight[0])
        for t, p, a in zip(done.tried, weight, like, strict=False)
    ]
    return [out[0], *sorted(out[1:], key=lambda e: -e.probability)], float(weight[-2]), float(weight[-1])


def reported(every: Sequence[Explanation], most: int = POLICY.reported_alternatives) -> list[Explanation]:
    """The alternatives worth a line."""
    return [e for e in every[1:] if e.probability >= POLICY.reported_min_probability][:most]
