"""The round in which a diagnosis first decides about physics, and its rules, so that one of them can be replaced."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from twin.calibration.fit_problem import Array
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.rounds.acceptance import flipped_threshold
from twin.diagnosis.rounds.decision import Round, agreed_on, coarse_first, to_claim
from twin.diagnosis.rounds.null import structural_misfits
from twin.diagnosis.rounds.prediction import left_out_rows
from twin.diagnosis.rounds.probability import Explanation, explanations, most_sure
from twin.diagnosis.rounds.refits import Tried, refit, taken_on
from twin.diagnosis.rounds.search import Search
from twin.diagnosis.rounds.trust import EVEN, trust
from twin.diagnosis.scoring.evidence import Evidence
from twin.diagnosis.scoring.screen import alone
from twin.diagnosis.telling.conclude import SURE, most_left, remainder, rms_of, slow_remainder
from twin.diagnosis.telling.findings import Findings
from twin.diagnosis.telling.tables import rms_table
from twin.proof.rivals.answer import WITHIN, Claim, Reply

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
