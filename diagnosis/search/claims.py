"""How probable a claim is: a logistic model of how much less the twin leaves with it.

What wrong claims gain grows with what the network cannot represent, and reaches thousands of nats; they remove
little of that. Offset and weight are a fit to development cases of six kinds of machines (`results/claims.csv`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from data.arrays import Array
from diagnosis.contracts import Fitted, Tried
from diagnosis.fitting.fitted import plain
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen


@dataclass(frozen=True)
class Round:
    """One round: all that was tried, the claim first, and how probable it is.

    `null` (T,) are the largest gains on refined twins with nothing missing, in nats; `fall` of what the twin leaves;
    `raised` channels by which the claim was refused, with rms before and after; `resolved` channels that show what is
    impossible without it; `forms` the terms (`free_forms.Form`) of candidates of no listed mechanism.
    """

    before: Fitted
    screen: Screen
    tried: tuple[Tried, ...]
    null: Array
    trust: float
    accepted: bool
    fall: float = 0.0
    raised: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    resolved: frozenset[str] = frozenset()
    forms: Mapping[str, Any] = field(default_factory=dict)

    @property
    def best(self) -> Tried | None:
        return self.tried[0] if self.tried else None

    @property
    def threshold(self) -> float:
        """Nats that structure alone gains in one of a hundred refined twins (Gumbel 1958)."""
        return null_quantile(self.null)

    @property
    def removed(self) -> float:
        """Share of the rms misfit that goes with the claim, geometric mean over channels; its `fall` in other words."""
        return float(1.0 - np.exp(-self.fall))


def null_quantile(null: Array) -> float:
    """The 99 % quantile of largest gains (T,) by a Gumbel distribution of their mean and spread."""
    scale = float(np.std(null, ddof=1)) * np.sqrt(6.0) / np.pi
    return float(np.mean(null) - scale * (np.euler_gamma + np.log(-np.log(POLICY.chance_quantile))))


def fall(before: Fitted, after: Fitted) -> float:
    """How much less the fit after leaves: ln(rms before / rms after), the mean over channels; 0.1 is a tenth less.

    Rms is not counted below noise. Of two predictions each channel counts the one that falls less: by the values of the
    fit under structure, and by those of the `plain` fit. A wrong claim may improve one by harming the other.
    """
    pairs = (before, after), (plain(before), plain(after))
    return float(np.min([np.log(a.noise.factor / b.noise.factor) for a, b in pairs], axis=0).clip(min=0.0).mean())


def trust(fallen: float) -> float:
    """The probability that a claim with this `fall` is true."""
    return float(1.0 / (1.0 + np.exp(-POLICY.claim_offset - POLICY.claim_weight * fallen)))


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
