"""The search: one effect after the other, each named by full refits and accepted on batches left out, or none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from data.errors import InputError, WorkError
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.proposals.coarse import coarse_candidates
from twin.diagnosis.proposals.slack import no_news
from twin.diagnosis.rounds.decision import FINALISTS, Bars, Round, coarse_first, decided, to_claim
from twin.diagnosis.rounds.fitted import Fitted, refitted, settle
from twin.diagnosis.rounds.null_cache import cached_null
from twin.diagnosis.rounds.refits import Refits, Tried, Work, compared, short_ones_on, taken_on
from twin.diagnosis.rounds.revise import second_thoughts
from twin.diagnosis.rounds.seats import at_best_seats
from twin.diagnosis.rounds.shortlist import Shortlist, mates, moved, neighbours, shortlist, unasked, with_sharp
from twin.diagnosis.rounds.trust import EVEN
from twin.diagnosis.rounds.workers import Progress, Workers
from twin.diagnosis.scoring.exchanged import suspects
from twin.diagnosis.scoring.memory import Memory
from twin.diagnosis.scoring.screen import Scored, alone, best_variants, proposed, screens

MOST_EFFECTS = 4
IN_DOUBT = 20.0  # nats of a refit from which a finer network might be why
RESTARTS = 2  # times that a round is done, where a refit shows that the baseline had stopped short
BETTER = 2.0  # nats by which it must have
LITTLE = 0.3  # of a gain: a baseline that stopped short by no more would have led to the same
HOPEFUL = 0.25  # of the structural null's gain: finalists that gain as much are taken on to their optimum
MEMBERS = 2  # that are refitted too: of those that look like a refit the likeliest
CLOSE, ALIKE = 2.0, 0.15  # if they stand no further below the best, or one step in the screen made the difference
AGAIN, LEFT = 2, 40.0  # refits that are taken on before a round claims nothing, if they gain so many nats at least
SWAP = 0.5  # of an effect's gain: what gained as much may take its place when all others are in

Order = Callable[[Tried], tuple[bool, float]]


@dataclass(frozen=True)
class Search:
    """All rounds; the last one accepted nothing, or there were as many as allowed. `dropped` are rounds whose effect
    was needless once the later ones were in."""

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
    workers: Workers | None = None,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> Search:
    """Forward until nothing more is accepted, then second thoughts; `cache` is a folder that keeps structural nulls."""
    tell = progress or (lambda step, n, of: None)
    workers = workers or Workers()
    return revised(_forward(baseline, seed, workers, tell, cache), workers, tell)


def _forward(baseline: Fitted, seed: int, workers: Workers, tell: Progress, cache: Path | None) -> Search:
    """One effect after the other."""
    now, rounds = baseline, []
    effects = 0
    while True:
        done = _fair_round(now, seed, workers, tell, cache)
        rounds.append(done)
        if not rounds[:-1]:
            baseline = done.before
        if not done.accepted or done.best is None or done.best.fitted is None:
            return Search(baseline, done.before, tuple(rounds))
        tell("settle", len(rounds), MOST_EFFECTS)
        now = settle(done.best.fitted)
        effects += done.best.candidate.mechanism != "coarse_network"
        if effects >= MOST_EFFECTS or len(rounds) >= 2 * MOST_EFFECTS:
            return Search(baseline, now, tuple(rounds))


def revised(done: Search, workers: Workers, tell: Progress) -> Search:
    """Effects dropped or swapped for their rivals, one at a time, as long as the batches left out agree."""
    for _ in range(MOST_EFFECTS):
        rounds = [k for k, r in enumerate(done.rounds) if r.accepted and k not in done.dropped]
        if len(rounds) < 2:
            return done
        tell("second thoughts", 0, 0)
        effects = [t for k in rounds if (t := done.rounds[k].best) is not None]
        rivals = [[t for t in done.rounds[k].tried[1:] if _rival(t, e)] for k, e in zip(rounds, effects, strict=True)]
        change = second_thoughts(
            done.final, effects, rivals, done.baseline.part, EVEN, done.rounds[0].null.temperature, workers
        )
        if change is None:
            return done
        at = rounds[change.effect]
        final = settle(change.fitted)
        if change.rival is None:
            done = replace(done, final=final, dropped=(*done.dropped, at))
            continue
        r = done.rounds[at]
        first = replace(change.rival, fitted=final, gain=effects[change.effect].gain - change.loss)
        tried = (first, *(t for t in r.tried if t is not change.rival))
        rest = (*done.rounds[:at], replace(r, tried=tried), *done.rounds[at + 1 :])
        done = replace(done, final=final, rounds=rest)
    return done


def _rival(t: Tried, e: Tried) -> bool:
    """Whether it is near enough to the accepted effect to be tried in its place; a finer network was asked for less
    than an effect is."""
    if e.candidate.mechanism == "coarse_network":
        return False
    return t.candidate.part is not None and not t.barred and (t.cluster == e.cluster or t.gain > SWAP * e.gain)


def _fair_round(now: Fitted, seed: int, workers: Workers, tell: Progress, cache: Path | None) -> Round:
    """A round whose baseline fits as well as its best candidate's fit without the candidate: no gain by a start."""
    for _ in range(RESTARTS):
        done = one_round(now, seed, workers, tell, cache)
        if not done.accepted or done.best is None or done.best.fitted is None:
            return done
        tell("fair baseline", 0, 0)
        try:
            back = settle(refitted(done.best.fitted, now.part))
        except (InputError, WorkError):
            return done  # where it has gone with the effect, no machine without it is
        more = float(alone(back, now.memory).base_score()[0] - alone(now, now.memory).base_score()[0])
        if more < BETTER:
            return done
        fair = replace(done.best, gain=done.best.gain - more)
        done = replace(done, before=back, tried=(fair, *done.tried[1:]), accepted=fair.gain > done.threshold)
        if done.accepted and more < LITTLE * fair.gain:
            return done
        now = back
    return done


def one_round(now: Fitted, seed: int, workers: Workers, tell: Progress, cache: Path | None = None) -> Round:
    """Screen, cluster, refit, score, decide."""
    every = proposed(now)
    tell("screen", 0, 0)
    none = Memory.none(len(now.problem.channels))
    seen, sharp = screens(now, every, [now.memory, none])
    loose = no_news(every, now)
    # Labels that are exchanged are plainly wrong before a fit (`suspects`); after it, two that are right may gain.
    news = [s for s in seen.scored if s.candidate.name not in loose and s.candidate.mechanism != "sensor_swap"]
    sharp_news = [s for s in sharp.scored if s.candidate.name not in loose]
    columns = seen.columns(loose)
    null = cached_null(cache, now, seen.evidence, columns, seed, lambda n, of: tell("structural null", n, of))
    bars, order = Bars(now, seen, null, columns, seed), _order(null.temperature)
    listed = shortlist(best_variants(news), seen.evidence)
    listed = with_sharp(listed, best_variants(sharp_news), sharp.evidence)
    refits = Refits(now, workers, tell)
    tried = refits([*listed.work(listed.chosen), *_unscreened(suspects(now, every), -2000)])
    tried = short_ones_on(now, tried, workers)
    tried += refits(mates(listed, tried))
    if any(t.gain > IN_DOUBT for t in tried):
        plain = alone(now, none)  # a slow misfit in full: that is what is too coarse
        left = plain.mean_squares(plain.left_out())[0]
        tried += refits(_unscreened(coarse_candidates(now, left), -1000))
    tried.sort(key=order)

    def seated(some: Sequence[Scored]) -> list[Tried]:
        return refits([(moved(s, seen.evidence), listed.cluster(s)) for s in some])

    n_final = sum(t.gain > HOPEFUL * bars.structure(t.candidate.name) for t in tried[:FINALISTS])
    first, rest = at_best_seats(tried, n_final, news, seated)
    final = compared(now, list(workers.map(partial(taken_on, now), first)))
    tried = sorted([*final, *rest], key=order)
    members = unasked(listed, refits.asked, tried) if n_final else []
    close = sorted((m for m in members if _close(m, tried, order)), key=order)[:MEMBERS]
    if again := refits([(m.scored, m.cluster) for m in close]):
        rest = [t for t in tried if not any(t is f for f in final)]
        final = compared(now, [*final, *workers.map(partial(taken_on, now), again)])
        tried = sorted([*final, *rest], key=order)
    done = decided(bars, _with_unasked(tried, listed, refits, order))
    if done.accepted or not any(t.gain > IN_DOUBT for t in tried):
        return done
    tell("another look", 0, 0)
    tried = sorted([*tried, *refits(neighbours(listed, tried, refits.asked))], key=order)
    tried, new = _looked_again(now, tried, final, workers)
    tried.sort(key=order)
    if to_claim(tried, len(now.batches)).candidate.name not in new:
        return done  # what was refused once is not asked again
    return decided(bars, _with_unasked(tried, listed, refits, order))


def _looked_again(
    now: Fitted, tried: Sequence[Tried], final: Sequence[Tried], workers: Workers
) -> tuple[list[Tried], set[str]]:
    """All that was tried, the next few taken on though they gain little, and the names of these.

    A refit of one step may end far from its optimum: heat to a floor gained 30 nats so, and 731 fitted on.
    """
    known = {t.candidate.plain for t in final}
    more = [t for t in tried if t.fitted is not None and t.candidate.plain not in known and t.gain > LEFT]
    more = [t for t in more if t.candidate.mechanism != "coarse_network"][:AGAIN]
    done = compared(now, [*final, *workers.map(partial(taken_on, now), more)]) if more else list(final)
    rest = [t for t in tried if not any(t is f for f in [*final, *more])]
    return [*done, *rest], {t.candidate.name for t in more}


def _with_unasked(tried: Sequence[Tried], listed: Shortlist, refits: Refits, order: Order) -> list[Tried]:
    """What a decision is made of: refits and, behind them, those that look like one; a finer network first."""
    return coarse_first([*tried, *sorted(unasked(listed, refits.asked, tried), key=order)])


def _unscreened(some: Sequence[Candidate], first: int) -> list[Work]:
    """What no screen sees; each is a cluster of its own, numbered down from the first."""
    return [(Scored(c, 0.0, 0, 0.0, {}, 0.0, -1), first - k) for k, c in enumerate(some)]


def _close(member: Tried, tried: Sequence[Tried], order: Order) -> bool:
    """Whether it might be the best of all, were it refitted."""
    like = next(t for t in tried if t.cluster == member.cluster)
    standing = -order(member)[1] > -order(tried[0])[1] - CLOSE
    return standing or (like is tried[0] and like.gain - member.gain < ALIKE * like.gain)


def _order(temperature: float) -> Order:
    """Refits first, then by what is left-out and plausible."""
    return lambda t: (t.fitted is None, -t.standing(temperature))
