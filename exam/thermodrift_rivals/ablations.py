"""The diagnosis with one rule removed, in its first round."""

from __future__ import annotations

from dataclasses import dataclass, replace

from data.processes import Processes
from diagnosis.contracts import Candidate, Where
from diagnosis.findings.conclude import claimed_effect, rms_of, slow_residual_ratio, verdict_of
from diagnosis.findings.report_data import Effect, rms_table
from diagnosis.findings.schema import Findings, Verdict
from diagnosis.fitting.covariance import independent, white_noise
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import left_out_rows, under
from diagnosis.policy import POLICY, Policy
from diagnosis.search.claims import Round, explanations
from diagnosis.search.search import Search, one_round
from thermodrift_rivals.base import Claim, Reply


@dataclass(frozen=True)
class Stage:
    """The first round; `findings` are those of the whole diagnosis."""

    done: Search
    findings: Findings | None = None

    @property
    def round(self) -> Round:
        return self.done.rounds[0]

    def reply(self, done: Round, policy: Policy = POLICY) -> Reply:
        """What a diagnosis reports if this round is the last."""
        if not done.accepted or done.best is None:
            return Reply(_verdict([], done.before, policy))
        best, fitted = done.best.candidate, done.best.fitted
        found = claimed_effect(done, fitted.part, fitted)
        every = [(e.tried.candidate, e.probability) for e in explanations(done)[0]]
        others = [(c, p) for c, p in every if (c.mechanism, c.where) != (best.mechanism, best.where)]
        own = sum(p for _, p in every) - sum(p for _, p in others)
        alike = tuple(c for c, p in others if p >= POLICY.named_min_probability_share * own)
        return Reply(_verdict([found], fitted, policy), (Claim(best, found.probability, alike),))


def _verdict(found: list[Effect], fitted: Fitted, policy: Policy) -> Verdict:
    left = left_out_rows(fitted)
    rms = rms_of(rms_table(left, left, fitted), fitted)
    listed = [f for f in found if not f.kind.is_unlisted]
    return verdict_of(listed, len(listed) < len(found), rms, slow_residual_ratio(rms, fitted), fitted.runs, policy)


def reference(stage: Stage) -> Reply:
    """The full rules. An unlisted effect is reported where the diagnosis ends with this round."""
    if stage.findings is not None and stage.findings.verdict == "unlisted":
        return Reply("unlisted", _unlisted(stage.findings))
    return stage.reply(stage.round)


def independent_noise(stage: Stage) -> Reply:
    """Every row counts in full, as independent noise, without the structure of refined twins."""
    now = stage.round.before
    bare = under(now, independent(now.problem, white_noise(now.problem)))
    return stage.reply(one_round(bare, Processes(), lambda step, n, of: None))


def no_floor_check(stage: Stage) -> Reply:
    """The residual is not judged: a claim explains everything, and no claim means that nothing is missing."""
    return stage.reply(stage.round, replace(POLICY, checks_residual=False))


def _unlisted(findings: Findings) -> tuple[Claim, ...]:
    return tuple(
        Claim(Candidate(f.mechanism, Where(f.where.kind, f.where.name), f.name or f.mechanism, ""), f.probability)
        for f in findings.findings
    )
