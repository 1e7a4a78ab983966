"""The diagnosis with one of its rules taken out, at the round in which it first decides about physics.

Evidence, refits and all other rules are its own. A finer network that comes first counts as no claim, as in a
diagnosis, where it is a refinement; so an ablation is not blamed for what refinements would have caught.
"""

from __future__ import annotations

from dataclasses import replace

from scipy.stats import chi2

from twin.diagnosis.proposals.candidate import Candidate, Where
from twin.diagnosis.rounds.refits import Tried, refit, taken_on
from twin.diagnosis.rounds.trust import EVEN
from twin.diagnosis.telling.findings import Findings
from twin.proof.rivals.answer import Claim, Reply
from twin.proof.rivals.in_sample import in_sample_gains, in_sample_score
from twin.proof.rivals.null_again import null_of
from twin.proof.rivals.rows import claimable, counted_in_full, without_nuisances
from twin.proof.rivals.stage import Stage

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
