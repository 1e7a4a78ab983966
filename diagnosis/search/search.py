"""The search: effects are added one at a time, each chosen by full refits and accepted on batches left out."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pydantic import BaseModel
from threadpoolctl import threadpool_limits

from data.arrays import Array
from data.errors import InputError, WorkError
from data.processes import Processes
from diagnosis.candidates.alternatives import coarse_candidates
from diagnosis.candidates.discretisation import never_reported
from diagnosis.candidates.priors import start_values
from diagnosis.contracts import Candidate, CandidateKind, Fitted, Scored, Tried, with_parts
from diagnosis.fitting.fitted import left_out_rows, refitted, settle, worsened
from diagnosis.fitting.regression import Memory
from diagnosis.policy import POLICY
from diagnosis.screening.exchanged import suspected_swaps
from diagnosis.screening.screen import alone, best_variants, proposed, screens
from diagnosis.search.decision import Criteria, Round, coarse_first, decided, first_claimable
from diagnosis.search.null import cached_null
from diagnosis.search.refits import Progress, Refits, Work, compared, continued, optimised
from diagnosis.search.shortlist import (
    Shortlist,
    at_best_placements,
    cluster_mates,
    moved,
    neighbours,
    not_refitted,
    shortlist,
    with_sharp,
)
from twin.schema import TwinPart


@dataclass(frozen=True)
class RoundContext:
    """What the passes of a round share.

    Attributes:
        now: the fit before the round.
        listed: the shortlist of the screen.
        news: all candidates that it scored, best first, without slack.
        suspected: candidates that a screen cannot score, refitted with the first.
        criteria: what claims are judged by.
    """

    now: Fitted
    workers: Processes
    refits: Refits
    listed: Shortlist
    news: Sequence[Scored]
    suspected: Sequence[Candidate]
    criteria: Criteria

    def first_pass(self) -> list[Tried]:
        """Refits of the shortlist, of cluster members that its refits call for, and of finer networks, best first."""
        listed = self.listed
        tried = self.refits([*listed.work(listed.chosen), *_unscreened(self.suspected)])
        tried = continued(self.now, tried, self.workers)
        tried += self.refits(cluster_mates(listed, tried))
        if any(t.gain > POLICY.coarse_min_refit_gain_nats for t in tried):
            tried += self.refits(_unscreened(coarse_candidates(self.now, self._slow_misfit())))
        return self.ranked(tried)

    def finalists(self, tried: Sequence[Tried]) -> tuple[list[Tried], list[Tried]]:
        """The best at their optimum, and all others.

        Each law is at its best placement. Members of a refit's cluster that might be the best are refitted, too.
        """
        n = sum(
            t.gain > POLICY.finalist_min_null_share * self.criteria.structure(t.candidate.name)
            for t in tried[: POLICY.finalists]
        )
        first, others = at_best_placements(tried, n, self.news, self._placed)
        final = self.optimised(first)
        if not n:
            return final, others
        tried = self.ranked([*final, *others])
        close = self.ranked(m for m in not_refitted(self.listed, self.refits.requested, tried) if self._close(m, tried))
        more = self.refits([(m.scored, m.cluster) for m in close[: POLICY.cluster_member_refits]])
        return (self.optimised(more, final) if more else final), others

    def second_pass(self, tried: Sequence[Tried], final: Sequence[Tried]) -> Round | None:
        """The round decided on further candidates at the places of the best; None where it would claim the same as
        before, which was refused."""
        tried = self.ranked([*tried, *self.refits(neighbours(self.listed, tried, self.refits.requested))])
        more = _second_finalists(tried, final)
        if not more:
            return None
        refitted = {id(t) for t in (*final, *more)}
        tried = self.ranked([*self.optimised(more, final), *(t for t in tried if id(t) not in refitted)])
        best = first_claimable(tried, len(self.now.batches))
        return self.decided(tried) if best.candidate.name in {t.candidate.name for t in more} else None

    def optimised(self, some: Sequence[Tried], others: Sequence[Tried] = ()) -> list[Tried]:
        """The others, and some that are fitted to their optimum, with gains by the same memory."""
        return compared(self.now, [*others, *self.workers.map(partial(optimised, self.now), some)])

    def decided(self, tried: Sequence[Tried]) -> Round:
        """The round decided on refits, best first, and behind them on unfitted members of their clusters."""
        like = self.ranked(not_refitted(self.listed, self.refits.requested, tried))
        return decided(self.criteria, coarse_first([*tried, *like]))

    def ranked(self, tried: Iterable[Tried]) -> list[Tried]:
        """Refits first; then by left-out gain and prior."""
        return sorted(tried, key=lambda t: (t.fitted is None, -self._standing(t)))

    def _standing(self, t: Tried) -> float:
        return t.standing(self.criteria.null.temperature)

    def _placed(self, some: Sequence[Scored]) -> list[Tried]:
        return self.refits([(moved(s, self.criteria.seen.evidence), self.listed.cluster(s)) for s in some])

    def _close(self, member: Tried, tried: Sequence[Tried]) -> bool:
        """Whether a cluster member might be the best after a refit."""
        like = next(t for t in tried if t.cluster == member.cluster)
        standing = self._standing(member) > self._standing(tried[0]) - POLICY.member_max_deficit
        return standing or (like is tried[0] and like.gain - member.gain < POLICY.member_max_gain_loss * like.gain)

    def _slow_misfit(self) -> Array:
        """Left-out mean squares (K,) of unfiltered rows: a coarse network shows in slow misfits."""
        plain = alone(self.now, Memory.none(len(self.now.problem.channels)))
        return plain.mean_squares(plain.left_out())[0]


def one_round(now: Fitted, seed: int, workers: Processes, tell: Progress, cache: Path | None = None) -> Round:
    """One effect named and accepted, or none."""
    context = _context(now, seed, workers, tell, cache)
    final, others = context.finalists(context.first_pass())
    tried = context.ranked([*final, *others])
    done = context.decided(tried)
    if done.accepted or not any(t.gain > POLICY.second_pass_min_gain_nats for t in tried):
        return done
    tell("second pass", 0, 0)
    return context.second_pass(tried, final) or done


def _context(now: Fitted, seed: int, workers: Processes, tell: Progress, cache: Path | None) -> RoundContext:
    """The screen, the shortlist and the criteria of a round."""
    every = proposed(now)
    tell("screen", 0, 0)
    seen, sharp = screens(now, every, [now.memory, Memory.none(len(now.problem.channels))])
    loose = never_reported(every, now)
    # Labels that are exchanged are plainly wrong before a fit (`suspects`); after it, two that are right may gain.
    news = [
        s for s in seen.scored if s.candidate.name not in loose and s.candidate.kind is not CandidateKind.SENSOR_SWAP
    ]
    sharp_news = [s for s in sharp.scored if s.candidate.name not in loose]
    columns = seen.columns(loose)
    null = cached_null(cache, now, seen.evidence, columns, seed, lambda n, of: tell("structural null", n, of))
    listed = shortlist(best_variants(news), seen.evidence)
    listed = with_sharp(listed, best_variants(sharp_news), sharp.evidence)
    criteria = Criteria(now, seen, null, columns, seed)
    return RoundContext(now, workers, Refits(now, workers, tell), listed, news, suspected_swaps(now, every), criteria)


def _second_finalists(tried: Sequence[Tried], final: Sequence[Tried]) -> list[Tried]:
    """The next few refits that are fitted to their optimum, none that was a finalist at another value of its shape.

    A refit of one step may end far from its optimum.
    """
    known = {t.candidate.plain for t in final}
    more = [
        t
        for t in tried
        if t.fitted is not None
        and t.candidate.plain not in known
        and t.gain > POLICY.second_pass_min_finalist_gain_nats
    ]
    return [t for t in more if t.candidate.kind.is_physics][: POLICY.second_pass_finalists]


def _unscreened(some: Sequence[Candidate]) -> list[Work]:
    """Candidates that no screen scored; each is a cluster of its own."""
    return [(Scored(c, 0.0, 0, 0.0, {}, 0.0, -1), c.name) for c in some]


@dataclass(frozen=True)
class Revision:
    """An effect taken out, or exchanged for an alternative, and the loss of left-out score in nats."""

    effect: int
    alternative: Tried | None
    loss: float
    fitted: Fitted


@dataclass(frozen=True)
class _Work:
    effect: int
    part: TwinPart
    alternative: Tried | None
    at: dict[str, float]


def backward_elimination(
    final: Fitted,
    effects: list[Tried],
    alternatives: list[list[Tried]],
    original: TwinPart,
    temperature: float,
    workers: Processes,
) -> Revision | None:
    """The best change of the set of effects, or None.

    An effect is dropped whose loss is below what a claim must gain and well below what it gained when it was accepted;
    an alternative takes its place that gains more than it is less plausible, `temperature` nats for each nat of log
    prior. Effects and alternatives are as the rounds tried them.
    """
    work = []
    for k, t in enumerate(effects):
        rest = without(final.part, t.candidate, original)
        work.append(_Work(k, rest, None, {}))
        for r in alternatives[k][: POLICY.exchanged_alternatives]:
            values, at = start_values(r.scored, final)
            try:
                work.append(_Work(k, r.candidate.applied(rest, values), r, dict(at)))
            except (ValueError, KeyError):
                continue
    score = float(alone(final, final.memory).base_score()[0])
    done = [s for s in workers.map(partial(_changed, final, score), work) if s is not None]
    return best_change(done, effects, temperature)


def best_change(done: Sequence[Revision], effects: Sequence[Tried], temperature: float) -> Revision | None:
    """The change that costs least of those that `backward_elimination` allows."""

    def due(s: Revision) -> bool:
        if s.alternative is None:
            return s.loss < min(POLICY.even_odds_gain_nats, POLICY.needless_max_loss_share * effects[s.effect].gain)
        return (
            s.loss + temperature * (effects[s.effect].log_prior - s.alternative.log_prior)
            < -POLICY.exchange_min_gain_nats
        )

    return min((s for s in done if due(s)), key=lambda s: s.loss, default=None)


def _changed(final: Fitted, score: float, w: _Work) -> Revision | None:
    try:
        fitted = settle(
            refitted(final, w.part, w.at),
            POLICY.elimination_steps,
            POLICY.elimination_tolerance,
            POLICY.elimination_rounds,
        )
        loss = score - float(alone(fitted, final.memory).base_score()[0])
    except (InputError, WorkError):
        return None
    return Revision(w.effect, w.alternative, loss, fitted)


def without(part: TwinPart, c: Candidate, original: TwinPart) -> TwinPart:
    """The twin part without an accepted candidate."""
    if c.part is not None:
        return with_parts(part, {f"mechanisms.{c.name}": None})
    if c.change is not None:
        group, name = c.change.parameter.name.split(".")[:2]
        known = getattr(original, group)
        return with_parts(part, {f"{group}.{name}": known[name]} if name in known else {})
    return with_parts(part, {path: _part_at(original, path) for path in c.parts})


def _part_at(part: TwinPart, path: str) -> BaseModel | None:
    group, name = path.split(".", 1)
    found: BaseModel | None = getattr(part, group).get(name)
    return found


@dataclass(frozen=True)
class Search:
    """All rounds; the last one accepted nothing, or the limit was reached.

    `dropped` numbers the rounds whose effect later effects made needless.
    """

    baseline: Fitted
    final: Fitted
    rounds: tuple[Round, ...]
    dropped: tuple[int, ...] = ()

    @property
    def accepted(self) -> tuple[Round, ...]:
        return tuple(r for k, r in enumerate(self.rounds) if r.accepted and k not in self.dropped)


def search(
    baseline: Fitted,
    seed: int = 0,
    workers: Processes | None = None,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> Search:
    """Forward until nothing more is accepted, then backward elimination; `cache` is the folder of structural nulls."""
    tell = progress or (lambda step, n, of: None)
    workers = workers or Processes()
    return revised(_forward(baseline, seed, workers, tell, cache), workers, tell)


def _forward(baseline: Fitted, seed: int, workers: Processes, tell: Progress, cache: Path | None) -> Search:
    """One effect after the other."""
    now, rounds = baseline, []
    effects = 0
    while True:
        done = _round_with_fair_baseline(now, seed, workers, tell, cache)
        rounds.append(done)
        if not rounds[:-1]:
            baseline = done.before
        if not done.accepted or done.best is None or done.best.fitted is None:
            return Search(baseline, done.before, tuple(rounds))
        tell("settle", len(rounds), POLICY.max_effects)
        now = settled(done.best.fitted)
        effects += done.best.candidate.kind.is_physics
        if effects >= POLICY.max_effects or len(rounds) >= POLICY.max_rounds_per_effect * POLICY.max_effects:
            return Search(baseline, now, tuple(rounds))


def revised(done: Search, workers: Processes, tell: Progress) -> Search:
    """Effects dropped or exchanged for alternatives, one at a time, as long as batches left out allow it."""
    for _ in range(POLICY.max_effects):
        rounds = [k for k, r in enumerate(done.rounds) if r.accepted and k not in done.dropped]
        if len(rounds) < 2:
            return done
        tell("backward elimination", 0, 0)
        effects = [t for k in rounds if (t := done.rounds[k].best) is not None]
        alternatives = [
            [t for t in done.rounds[k].tried[1:] if _exchangeable(t, e)] for k, e in zip(rounds, effects, strict=True)
        ]
        change = backward_elimination(
            done.final,
            effects,
            alternatives,
            done.baseline.part,
            done.rounds[0].null.temperature,
            workers,
        )
        if change is None:
            return done
        at = rounds[change.effect]
        final = settled(change.fitted)
        if worsened(left_out_rows(done.final), left_out_rows(final)):
            return done
        if change.alternative is None:
            done = replace(done, final=final, dropped=(*done.dropped, at))
            continue
        r = done.rounds[at]
        first = replace(change.alternative, fitted=final, gain=effects[change.effect].gain - change.loss)
        tried = (first, *(t for t in r.tried if t is not change.alternative))
        rest = (*done.rounds[:at], replace(r, tried=tried), *done.rounds[at + 1 :])
        done = replace(done, final=final, rounds=rest)
    return done


def _exchangeable(t: Tried, e: Tried) -> bool:
    """Whether `t` may take the place of the accepted effect `e`; none takes that of a finer network, which is accepted
    at a lower gain."""
    if not e.candidate.kind.is_physics:
        return False
    return (
        t.candidate.part is not None
        and not t.barred
        and (t.cluster == e.cluster or t.gain > POLICY.exchange_gain_share * e.gain)
    )


def _round_with_fair_baseline(now: Fitted, seed: int, workers: Processes, tell: Progress, cache: Path | None) -> Round:
    """A round whose baseline fits as well as the best refit does without its candidate, so that no gain is due to a
    better start."""
    for _ in range(POLICY.baseline_restarts):
        done = one_round(now, seed, workers, tell, cache)
        if not done.accepted or done.best is None or done.best.fitted is None:
            return done
        tell("fair baseline", 0, 0)
        try:
            back = settle(refitted(done.best.fitted, now.part))
        except (InputError, WorkError):
            return done  # where it has gone with the effect, no machine without it is
        more = float(alone(back, now.memory).base_score()[0] - alone(now, now.memory).base_score()[0])
        if more < POLICY.baseline_restart_min_gain_nats:
            return done
        fair = replace(done.best, gain=done.best.gain - more)
        gains = fair.gain > done.threshold
        raised = worsened(left_out_rows(back), left_out_rows(done.best.fitted)) if gains else {}
        done = replace(done, before=back, tried=(fair, *done.tried[1:]), accepted=gains and not raised, raised=raised)
        if done.accepted and more < POLICY.baseline_restart_min_gain_share * fair.gain:
            return done
        now = back
    return done


def settled(fitted: Fitted) -> Fitted:
    """The fit at its optimum, or where it is if a channel is predicted worse there."""
    done = settle(fitted)
    return fitted if worsened(left_out_rows(fitted), left_out_rows(done)) else done


def start_worker() -> None:
    """First call in a worker process: to find it here loads the search, since threads are limited of what is loaded."""
    threadpool_limits(limits=1)
