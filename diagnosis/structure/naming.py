"""One round under the structural discrepancy: detect by the screen, name by full refits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data.errors import InputError, WorkError
from diagnosis.candidates.library import log_prior_odds
from diagnosis.candidates.priors import starts
from diagnosis.contracts import Candidate, Scored
from diagnosis.policy import POLICY
from diagnosis.structure.fit import StructuralFit, refitted, settle
from diagnosis.structure.null import Null
from diagnosis.structure.policy import STRUCTURE
from diagnosis.structure.screen import Screen, best_variants, moved, screen


@dataclass(frozen=True, eq=False)
class Refit:
    """A candidate after its full refit.

    Attributes:
        gain: log evidence ratio to the fit before over `inflation`, what structure alone makes of it; nats.
        log_prior: log prior odds by the equipment that it needs.
    """

    scored: Scored
    fitted: StructuralFit
    gain: float
    inflation: float
    log_prior: float

    @property
    def candidate(self) -> Candidate:
        return self.scored.candidate

    @property
    def level(self) -> float:
        """What ranks it among explanations, nats."""
        return self.gain + self.log_prior


@dataclass(frozen=True, eq=False)
class Detection:
    """What a round found: the fit it stands on, the screen, the null, listed and free refits, best first."""

    before: StructuralFit
    screen: Screen
    null: Null
    listed: tuple[Refit, ...]
    free: tuple[Refit, ...]

    @property
    def threshold(self) -> float:
        """Nats that the best must gain."""
        return self.null.threshold()

    @property
    def score(self) -> float:
        """The most that any explanation gains, in thresholds: above 1 something is detected."""
        gains = [r.gain for r in (*self.listed[:1], *self.free[:1])]
        return max(gains, default=0.0) / self.threshold

    @property
    def best(self) -> Refit | None:
        """The listed explanation with the most evidence."""
        return self.listed[0] if self.listed else None


def detect(fitted: StructuralFit, seed: int = 0) -> Detection:
    """A round from a fit; where a refit shows that the fit was not at its optimum, from a better one.

    A baseline in a local optimum lets every candidate gain what the descent alone would: it continues from where the
    best refit has led, with the candidate taken out.
    """
    for _ in range(STRUCTURE.fair_rounds):
        found = _round(fitted, seed)
        best = max((*found.listed[:1], *found.free[:1]), key=lambda r: r.gain, default=None)
        if best is None or best.gain < found.threshold:
            return found
        try:
            back = refitted(
                replace(best.fitted, covariance=fitted.covariance), fitted.part, steps=STRUCTURE.settle_steps
            )
        except (InputError, WorkError):
            return found
        if back.evidence < fitted.evidence + found.threshold / 2:
            return found
        fitted = settle(replace(back, structure=fitted.structure))
    return _round(fitted, seed)


def _round(now: StructuralFit, seed: int) -> Detection:
    seen = screen(now, seed)
    null = Null(seen.gains.max(axis=1) if seen.gains.size else np.zeros(0))
    listed = _refits(now, seen, best_variants(seen.scored), STRUCTURE.refits, STRUCTURE.finalists)
    free = _refits(now, seen, seen.free, STRUCTURE.finalists // 2, STRUCTURE.finalists // 2)
    return Detection(now, seen, null, tuple(listed), tuple(free))


def _refits(now: StructuralFit, seen: Screen, scored: Sequence[Scored], most: int, most_settled: int) -> list[Refit]:
    """Refits of the likeliest candidates, and of others that look different; the finalists at their optimum."""
    top = [s for s in scored[: STRUCTURE.screened] if s.gain > POLICY.screen_min_gain_nats]
    odds = {s.candidate.name: log_prior_odds(now.machine, now.part, s.candidate) for s in top}
    ranked = sorted(top, key=lambda s: -(s.gain + odds[s.candidate.name]))
    tried = []
    for s in _chosen(ranked, most):
        name = s.candidate.name
        refit = _refit(now, moved(s, seen), seen.inflation[name], odds[name], STRUCTURE.refit_steps)
        if refit is not None:
            tried.append(refit)
    tried.sort(key=lambda r: -r.level)
    final = sorted((_settled(now, r) for r in tried[:most_settled]), key=lambda r: -r.level)
    return [*final, *tried[most_settled:]]


def _chosen(ranked: Sequence[Scored], most: int) -> list[Scored]:
    """The best half as they come, then the best of other mechanisms, then the rest."""
    chosen = list(ranked[: (most + 1) // 2])
    kinds = {(s.candidate.mechanism, s.candidate.where.kind) for s in chosen}
    for s in ranked[len(chosen) :]:
        if len(chosen) < most and (s.candidate.mechanism, s.candidate.where.kind) not in kinds:
            chosen.append(s)
            kinds.add((s.candidate.mechanism, s.candidate.where.kind))
    rest = [s for s in ranked if all(s is not c for c in chosen)]
    return [*chosen, *rest[: most - len(chosen)]]


def _refit(now: StructuralFit, s: Scored, inflation: float, log_prior: float, steps: int) -> Refit | None:
    """The best of its starts, as many as it takes to come near to what the screen promised; None where no start of it
    can be simulated."""
    best: Refit | None = None
    for values, begin in starts(s, now):
        try:
            fitted = refitted(now, s.candidate.applied(now.part, values), begin, steps)
        except (InputError, WorkError):
            continue
        gain = (fitted.evidence - now.evidence) / inflation
        if best is None or gain > best.gain:
            best = Refit(s, fitted, gain, inflation, log_prior)
        if gain > STRUCTURE.short_refit_share * s.gain:
            break
    return best


def _settled(now: StructuralFit, r: Refit) -> Refit:
    """A refit at its optimum under the covariance that its own residuals say: a covariance that has grown to hold a
    missing effect hardly tells candidates apart."""
    try:
        fitted = settle(replace(r.fitted, structure=now.structure))
    except (InputError, WorkError):
        return r
    return replace(r, fitted=fitted, gain=(fitted.full_evidence - now.full_evidence) / r.inflation)
