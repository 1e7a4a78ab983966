"""The diagnosis with one rule removed, in the round that first decides about physics.

Every ablation runs the code of the diagnosis with a changed `Policy`, on the fits and the refits of that round. A finer
network that is accepted counts as no claim, as in a diagnosis, where it is a refinement; so that an ablation is not
charged for what a refinement would find.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from diagnosis.candidates.discretisation import never_reported
from diagnosis.contracts import Candidate, Fitted, Scored, Tried, Where
from diagnosis.findings.conclude import claimed, rms_of, slow_residual_ratio, verdict_of
from diagnosis.findings.report_data import Found, rms_table
from diagnosis.findings.schema import Findings, Verdict
from diagnosis.fitting.fitted import left_out_rows
from diagnosis.policy import POLICY, Policy
from diagnosis.screening.screen import proposed, screens
from diagnosis.search.decision import Criteria, Round, coarse_first, decided
from diagnosis.search.null import structural_null
from diagnosis.search.probability import explanations
from diagnosis.search.refits import common_memory, compared, judged, optimised, refit
from diagnosis.search.search import Search
from evidence.proof.baselines.base import MIN_ALIKE_SHARE, Claim, Reply, claimable, without_nuisances

MAX_REFITS = 10  # of the round: a smaller gain ranks first under no other count
UNPROJECTED_REFITS = 4  # of a screen without projection, each of another mechanism


@dataclass(frozen=True)
class Stage:
    """The first round that named no finer network, or the last; `findings` are those of the whole diagnosis."""

    done: Search
    findings: Findings | None = None

    @cached_property
    def number(self) -> int:
        finer = [r.accepted and r.best is not None and not r.best.candidate.kind.is_physics for r in self.done.rounds]
        return next((k for k, one in enumerate(finer) if not one), len(finer) - 1)

    @property
    def round(self) -> Round:
        return self.done.rounds[self.number]

    @property
    def alone(self) -> bool:
        """Whether no later round accepted anything."""
        return not any(r.accepted for r in self.done.rounds[self.number + 1 :])

    @cached_property
    def refits(self) -> tuple[Tried, ...]:
        """Its best full refits; one that a later fit exchanged is refitted in the form that it has here."""
        now, out = self.round.before, []
        for t in [t for t in self.round.tried if t.fitted is not None][:MAX_REFITS]:
            again = refit(now, t.scored) if self._exchanged(t) else t
            if again is not None:
                own = again if again is t else optimised(now, again)
                out.append(replace(own, cluster=t.cluster, barred=t.barred))
        return tuple(out)

    def _exchanged(self, t: Tried) -> bool:
        """Whether its fit contains more than the start of this round and itself."""
        assert t.fitted is not None
        before, after = self.round.before.part, t.fitted.part
        more = set(after.mechanisms) - set(before.mechanisms) - {t.candidate.name}
        return bool(more) or (t.candidate.part is not None and set(after.bodies) != set(before.bodies))

    def decided(self, policy: Policy, tried: Sequence[Tried] | None = None) -> Round:
        """The round decided by another policy, on its own refits or on those given, which the policy judges."""
        r, now = self.round, self.round.before
        if tried is None:
            tried = [replace(t, barred=False) for t in self.refits]
        if (policy.counts_row_memory, policy.leaves_batches_out) == (True, True):
            seen, null = r.screen, r.null
        else:
            tried = compared(now, [judged(now, t, policy=policy) for t in tried], policy)
            (seen,) = screens(now, proposed(now), [common_memory([now], policy)])
            null = structural_null(now, seen.evidence, self._columns, r.seed, policy=policy)
        criteria = Criteria(now, seen, null, self._columns, r.seed, policy)
        return decided(criteria, coarse_first(sorted(tried, key=lambda t: -t.standing(null.temperature))))

    @property
    def _columns(self) -> dict[str, int]:
        now = self.round.before
        return self.round.screen.columns(never_reported(proposed(now), now))

    def reply(self, done: Round, policy: Policy = POLICY) -> Reply:
        """What a diagnosis reports if this round is the last."""
        if not done.accepted or done.best is None or done.best.fitted is None:
            return Reply(self._verdict([], done.before, policy))
        if not done.best.candidate.kind.is_physics:
            return Reply("consistent")  # a refinement is no finding
        best, fitted = done.best.candidate, done.best.fitted
        found = claimed(done, fitted.part, fitted)
        verdict = self._verdict([found], fitted, policy)
        every = [(e.tried.candidate, e.probability) for e in explanations(done)[0]]
        others = [(c, p) for c, p in every if (c.mechanism, c.where) != (best.mechanism, best.where)]
        own = sum(p for _, p in every) - sum(p for _, p in others)
        alike = tuple(c for c, p in others if p >= MIN_ALIKE_SHARE * own)
        return Reply(verdict, (Claim(best, found.probability, alike),))

    def _verdict(self, found: Sequence[Found], fitted: Fitted, policy: Policy) -> Verdict:
        left = left_out_rows(fitted)
        rms = rms_of(rms_table(left, left, fitted), fitted)
        return verdict_of(found, False, rms, slow_residual_ratio(rms, fitted), fitted.runs, policy)


def reference(stage: Stage) -> Reply:
    """The full rules. An unlisted effect is reported where the diagnosis ends with this round."""
    if stage.findings is not None and stage.findings.verdict == "unlisted" and stage.alone:
        return Reply("unlisted", _unlisted(stage.findings))
    return stage.reply(_as_decided(stage))


def no_projection(stage: Stage) -> Reply:
    """Screened without projection of recalibrated parameters; the best mechanisms are refitted, full rules judge."""
    r = stage.round
    residuals = r.before.problem.residuals(r.before.x, r.before.state.nuisance)
    gain = without_nuisances(r.screen.evidence, residuals).scores().gain

    def weakest_last(s: Scored) -> tuple[float, str]:
        return -gain[s.column], s.candidate.name

    best = list({s.candidate.mechanism: s for s in sorted(claimable(r), key=weakest_last, reverse=True)}.values())
    known = {t.candidate.name: t for t in stage.refits}
    first = sorted(best, key=weakest_last)[:UNPROJECTED_REFITS]
    tried = [known.get(s.candidate.name) or refit(r.before, s) for s in first]
    fitted = [replace(t, alike=None, barred=False) for t in tried if t is not None]
    at_optimum = [t if t.candidate.name in known else optimised(r.before, t) for t in fitted]
    return stage.reply(stage.decided(POLICY, compared(r.before, at_optimum)))


def independent_noise(stage: Stage) -> Reply:
    """Every row counts in full, as independent noise; the structural null likewise."""
    return stage.reply(stage.decided(replace(POLICY, counts_row_memory=False)))


def in_sample(stage: Stage) -> Reply:
    """Gains on the fitted recordings; no batch is left out, nor in the structural null."""
    return stage.reply(stage.decided(replace(POLICY, leaves_batches_out=False)))


def no_structural_null(stage: Stage) -> Reply:
    """No candidate is compared with the structural null."""
    return stage.reply(stage.decided(replace(POLICY, uses_structural_null=False)))


def no_floor_check(stage: Stage) -> Reply:
    """The residual is not judged: a claim explains everything, and no claim means that nothing is missing."""
    return stage.reply(_as_decided(stage), replace(POLICY, checks_residual=False))


def _as_decided(stage: Stage) -> Round:
    """The round as the diagnosis decided it, every refit as it was in this round."""
    refits, r = stage.refits, stage.round
    rest = [t for t in r.tried if t.fitted is None]
    return replace(r, tried=(*refits, *rest))


def _unlisted(findings: Findings) -> tuple[Claim, ...]:
    return tuple(
        Claim(Candidate(f.mechanism, Where(f.where.kind, f.where.name), f.name or f.mechanism, ""), f.probability)
        for f in findings.findings
    )
