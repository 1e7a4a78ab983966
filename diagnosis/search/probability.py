"""How probable each explanation is: the candidates of a round, nothing, and what is not listed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from diagnosis.contracts import Tried
from diagnosis.policy import POLICY
from diagnosis.search.acceptance import few_worse
from diagnosis.search.decision import Round


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
    """Of a round's candidates, the likeliest first; then of nothing, and of something that is not listed.

    A tempered posterior over left-out scores (pseudo-Bayes, Geisser and Eddy 1979): differences below what structure
    alone makes decide nothing, and what makes many batches worse explains nothing. Nothing is as likely as what is
    accepted and only just reaches the threshold, and impossible where a channel shows what the twin cannot do; what is
    not listed as one in fifty of the best that is.
    """
    t = done.null.temperature
    batches = len(done.before.batches)

    def agrees(x: Tried) -> bool:
        return x is done.best or x.fitted is None or (few_worse(x, batches) and not x.barred)

    refits = [x for x in done.tried if x.fitted is not None]
    barred = {x.cluster for x in refits} - {x.cluster for x in refits if agrees(x)}
    scores = np.array([x.standing(t) if agrees(x) and x.cluster not in barred else -np.inf for x in done.tried])
    prior = min(done.best.log_prior, 0.0) if done.accepted and done.best is not None else 0.0
    nothing = -np.inf if done.resolved else done.threshold / t + prior
    unlisted = (scores.max(initial=nothing)) - np.log(POLICY.unlisted_odds)
    every = np.append(scores, [nothing, unlisted])
    weight = np.exp(every - every.max())
    weight /= weight.sum()
    most = probability_cap(done.before.runs or len(done.before.batches))
    weight[:-2] *= min(1.0, most / max(weight[:-2].max(initial=0.0), 1e-12))
    best = done.best
    out = [
        Explanation(
            x,
            float(p),
            best is not None
            and (x.cluster == best.cluster or p > POLICY.alike_min_probability_share * weight[:-2].max()),
        )
        for x, p in zip(done.tried, weight[:-2], strict=True)
    ]
    return sorted(out, key=lambda e: -e.probability), float(weight[-2]), float(weight[-1])


def reported(every: Sequence[Explanation], most: int = POLICY.reported_alternatives) -> list[Explanation]:
    """The alternatives worth a line."""
    return [e for e in every[1:] if e.probability >= POLICY.reported_min_probability][:most]
