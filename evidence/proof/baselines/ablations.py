"""The diagnosis with one of its rules taken out, at the round in which it first decides about physics.

Evidence, refits and all other rules are its own. A finer network that comes first counts as no claim, as in a
diagnosis, where it is a refinement; so an ablation is not blamed for what refinements would have caught.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from scipy.stats import chi2

from data.arrays import Array
from diagnosis.contracts import Candidate, Tried, Where
from diagnosis.findings.conclude import SURE, most_left, remainder, rms_of, slow_remainder
from diagnosis.findings.report_data import rms_table
from diagnosis.findings.schema import Findings
from diagnosis.fitting.fitted import left_out_rows
from diagnosis.screening.evidence import Evidence
from diagnosis.screening.screen import alone
from diagnosis.search.acceptance import EVEN, flipped_threshold, trust
from diagnosis.search.decision import Round, agreed_on, coarse_first, to_claim
from diagnosis.search.null import structural_misfits
from diagnosis.search.probability import Explanation, explanations, most_sure
from diagnosis.search.refits import refit, taken_on
from diagnosis.search.search import Search
from evidence.proof.baselines.base import WITHIN, Claim, Reply, claimable, counted_in_full, without_nuisances
from evidence.proof.baselines.bic import in_sample_gains, in_sample_score, null_of

COARSE = "coarse_network"
REFITS = 10  # what gains less would not come first by any other count


@dataclass(frozen=True)
class Stage:
    """The first round that named no finer network, or the last; `findings` are of the whole diagnosis, if there are."""

    done: Search
    findings: Findings | None = None

    @cached_property
    def number(self) -> int:
        names = [r.accepted and r.best is not None and r.best.candidate.mechanism for r in self.done.rounds]
        return next((k for k, name in enumerate(names) if name != COARSE), len(names) - 1)

    @property
    def round(self) -> Round:
        return self.done.rounds[self.number]

    @property
    def alone(self) -> bool:
        """Whether no later round accepted anything."""
        return not any(r.accepted for r in self.done.rounds[self.number + 1 :])

    @cached_property
    def refits(self) -> tuple[Tried, ...]:
        """Its best full refits; one that was swapped in beside later effects is refitted as it was here."""
        out: list[Tried] = []
        for t in [t for t in self.round.tried if t.fitted is not None][:REFITS]:
            again = refit(self.round.before, t.scored) if self._swapped_in(t) else t
            if again is not None:
                own = again if again is t else taken_on(self.round.before, again)
                out.append(replace(own, cluster=t.cluster))
        return tuple(out)

    def _swapped_in(self, t: Tried) -> bool:
        """Whether its fit holds more than what this round began with and itself."""
        assert t.fitted is not None
        before, after = self.round.before.part, t.fitted.part
        more = set(after.mechanisms) - set(before.mechanisms) - {t.candidate.name}
        return bool(more) or (t.candidate.part is not None and set(after.bodies) != set(before.bodies))

    @cached_property
    def before(self) -> Evidence:
        """How the fit without any candidate predicts batches left out."""
        return alone(self.round.before, self.round.before.memory)

    @cached_property
    def after(self) -> list[Evidence]:
        """The same of every refit, its rows counted as before."""
        memory = self.round.before.memory
        return [alone(t.fitted, memory) for t in self.refits if t.fitted is not None]

    @cached_property
    def misfits(self) -> list[list[Array]]:
        """What the refined machines of the structural null show beyond the fit."""
        return structural_misfits(self.round.before)

    @cached_property
    def rest(self) -> float:
        """What the fit leaves, in units of what structure alone would."""
        return remainder(replace(self.done, final=self.round.before))

    @cached_property
    def slow(self) -> float:
        """The same of rows as they are."""
        before = self.round.before
        left = left_out_rows(before)
        return slow_remainder(rms_of(rms_table(left, left, before), before), before)

    def bar(self, null: float, name: str) -> float:
        """The threshold with another structural null."""
        names, flipped = self.round.null.names, self.round.flipped  # none where nothing was refitted
        which = names.index(name) if name in names else None
        return max(null, flipped_threshold(flipped, len(self.round.before.batches), which), EVEN)

    def ranked(self, tried: Sequence[Tried]) -> list[Tried]:
        """By gain and what is plausible, a finer network first where it gains nearly as much."""
        temperature = self.round.null.temperature
        order = sorted(tried, key=lambda t: -t.standing(temperature))
        return coarse_first(order)

    def decided(self, tried: Sequence[Tried], threshold: float) -> Reply:
        """The reply under the rules of a diagnosis, by other gains or another threshold."""
        ranked = self.ranked(tried)
        best = to_claim(ranked, len(self.round.before.batches)) if ranked else None
        ranked = [best, *(t for t in ranked if t is not best)] if best is not None else []
        if best is None or not self.accepts(best, threshold):
            return Reply("undecidable" if self.slow > most_left(self.round.before.runs) else "consistent")
        if best.candidate.mechanism == COARSE:
            return Reply("consistent")  # a refinement is no finding
        claim, told = self.claim(ranked, threshold)
        if (claim.probability or 0.0) < SURE and any(self.ties(e, claim) for e in told):
            return Reply("undecidable", (claim,))
        rest = remainder(replace(self.done, final=best.fitted)) if best.fitted is not None else self.rest
        return Reply("partly_explained" if rest > most_left(self.round.before.runs) else "explained", (claim,))

    def accepts(self, t: Tried, threshold: float) -> bool:
        batches = len(self.round.before.batches)
        return t.gain > threshold and agreed_on(t, batches)

    def claim(self, ranked: Sequence[Tried], threshold: float) -> tuple[Claim, list[Explanation]]:
        """The first with its probability and its reported set, and all explanations."""
        told, _, _ = explanations(replace(self.round, tried=tuple(ranked), threshold=threshold, accepted=True))
        first = ranked[0].candidate
        p = min(sum(e.probability for e in told if _same(e, first)), most_sure(self.round.before.runs))
        alike = tuple(e.tried.candidate for e in told if not _same(e, first) and e.probability >= WITHIN * p)
        return Claim(first, p * trust(ranked[0], len(self.round.before.batches)), alike), told

    @staticmethod
    def ties(e: Explanation, claim: Claim) -> bool:
        return not _same(e, claim.candidate) and e.alike and e.probability >= (claim.probability or 0.0) / 2


def _same(e: Explanation, c: Candidate) -> bool:
    return (e.tried.candidate.mechanism, e.tried.candidate.where) == (c.mechanism, c.where)


REFITTED = 4  # of a screen without projection, each of another mechanism
SIGNIFICANT = 0.01  # of a chi-square test, for all candidates together (Bonferroni)


def reference(stage: Stage) -> Reply:
    """The full rules. What is in no list is said where the diagnosis went no further than this round."""
    r = stage.round
    if stage.findings is not None and stage.findings.verdict == "unlisted" and stage.alone:
        return Reply("unlisted", _unlisted(stage.findings))
    if not r.accepted:
        return stage.decided([], r.threshold)
    return stage.decided(stage.refits, r.threshold)


def no_projection(stage: Stage) -> Reply:
    """Screened as if nothing had been recalibrated; the best of few mechanisms are refitted, the full rules judge."""
    r = stage.round
    residuals = r.before.problem.residuals(r.before.x, r.before.state.nuisance)
    gain = without_nuisances(r.screen.evidence, residuals).scores().gain
    order = sorted(claimable(r), key=lambda s: (gain[s.column], s.candidate.name))
    best = list({s.candidate.mechanism: s for s in order}.values())
    best = sorted(best, key=lambda s: (-gain[s.column], s.candidate.name))[:REFITTED]
    known = {t.candidate.name: t for t in stage.refits}
    tried = [known.get(s.candidate.name) or refit(r.before, s) for s in best]
    fitted = stage.ranked([replace(t, alike=None, cluster=-k) for k, t in enumerate(tried) if t is not None])
    if fitted and fitted[0].candidate.name not in known:
        fitted[0] = taken_on(r.before, fitted[0])
    return stage.decided(fitted, r.threshold)


def independent_noise(stage: Stage) -> Reply:
    """Every row counts in full, and a chi-square test decides."""

    before = float(counted_in_full(stage.before).base_score()[0])
    gains = [float(counted_in_full(after).base_score()[0]) - before for after in stage.after]
    return _tested(stage, [replace(t, gain=g, alike=None) for t, g in zip(stage.refits, gains, strict=True)])


def in_sample(stage: Stage) -> Reply:
    """Gains on the recordings that were fitted; nothing is left out, the null by the same statistic."""
    r = stage.round

    columns = {s.candidate.name: s.column for s in claimable(r)}
    null = null_of(stage.misfits, r.screen.evidence, columns, in_sample_gains, in_sample_score)
    before = float(in_sample_score(stage.before)[0])
    gains = [float(in_sample_score(after)[0]) - before for after in stage.after]
    tried = [
        replace(t, gain=gain, alike=None, improved=len(r.before.batches))
        for t, gain in zip(stage.refits, gains, strict=True)
    ]
    if not tried:
        return stage.decided([], EVEN)
    best = stage.ranked(tried)[0]
    name = best.candidate.name
    return stage.decided(tried, stage.bar(null.threshold(before + best.gain, name=name), name))


def no_structural_null(stage: Stage) -> Reply:
    """Left-out gains as they are, against what a chi-square test asks of noise alone."""
    return _tested(stage, list(stage.refits))


def no_floor_check(stage: Stage) -> Reply:
    """The best listed explanation is claimed where it passes the threshold, whatever is left over."""
    r = stage.round
    ranked = stage.ranked(stage.refits)
    if not ranked or ranked[0].gain <= r.threshold or r.best is None or r.best.candidate.mechanism == "coarse_network":
        return Reply.of([])
    return Reply.of([stage.claim(ranked, r.threshold)[0]])


def _tested(stage: Stage, tried: list[Tried]) -> Reply:
    """Twice a gain is chi-square with as many degrees of freedom as the candidate has parameters (Wilks 1938)."""
    ranked = stage.ranked(tried)
    if not ranked:
        return stage.decided([], 0.0)
    c = ranked[0].candidate
    freedom = max(1, len(c.amplitudes) + len(c.shape))
    return stage.decided(ranked, 0.5 * float(chi2.isf(SIGNIFICANT / len(claimable(stage.round)), freedom)))


def _unlisted(findings: Findings) -> tuple[Claim, ...]:
    return tuple(
        Claim(Candidate(f.mechanism, Where(f.where.kind, f.where.name), f.name or f.mechanism, ""), f.probability)
        for f in findings.findings
    )
