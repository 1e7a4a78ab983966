"""The search: one effect after the other, each named by full refits and accepted on batches left out, or none."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from pydantic import BaseModel
from threadpoolctl import threadpool_limits

from data.arrays import Array
from data.errors import InputError, WorkError
from diagnosis.candidates.alternatives import coarse_candidates
from diagnosis.candidates.discretisation import no_news
from diagnosis.candidates.priors import start_values
from diagnosis.contracts import Candidate, Fitted, Scored, Tried, with_parts
from diagnosis.fitting.fitted import refitted, settle
from diagnosis.fitting.regression import Memory
from diagnosis.screening.exchanged import suspects
from diagnosis.screening.screen import alone, best_variants, proposed, screens
from diagnosis.search.acceptance import EVEN
from diagnosis.search.decision import FINALISTS, Bars, Round, coarse_first, decided, to_claim
from diagnosis.search.null import cached_null
from diagnosis.search.refits import Progress, Refits, Work, Workers, compared, short_ones_on, taken_on
from diagnosis.search.shortlist import (
    Shortlist,
    at_best_seats,
    mates,
    moved,
    neighbours,
    shortlist,
    unasked,
    with_sharp,
)
from twin.schema import TwinPart

TOO_COARSE = 20.0  # nats of a refit from which a network that is too coarse might be why
HOPEFUL = 0.25  # of the structural null's gain: finalists that gain as much are taken on to their optimum
MEMBERS = 2  # that are refitted too: of those that look like a refit the likeliest
CLOSE, ALIKE = 2.0, 0.15  # if they stand no further below the best, or one step in the screen made the difference
UNSETTLED = 20.0  # nats of a refit from which a round looks again before it claims nothing
AGAIN, LEFT = 2, 40.0  # refits that are taken on then, if they gain so many nats at least


@dataclass(frozen=True)
class Looks:
    """What the looks of a round share.

    Attributes:
        now: the fit before the round.
        listed: what the screen finds worth a refit.
        news: all that it scored and that is no slack, best first.
        suspected: candidates that no screen sees, to be refitted with the first.
        bars: what every claim is held to.
    """

    now: Fitted
    workers: Workers
    refits: Refits
    listed: Shortlist
    news: Sequence[Scored]
    suspected: Sequence[Candidate]
    bars: Bars

    def first(self) -> list[Tried]:
        """Refits of what is listed, of what else their gains speak for, and of finer networks, best first."""
        listed = self.listed
        tried = self.refits([*listed.work(listed.chosen), *_unscreened(self.suspected, -2000)])
        tried = short_ones_on(self.now, tried, self.workers)
        tried += self.refits(mates(listed, tried))
        if any(t.gain > TOO_COARSE for t in tried):
            tried += self.refits(_unscreened(coarse_candidates(self.now, self._slow_misfit()), -1000))
        return self.ranked(tried)

    def finalists(self, tried: Sequence[Tried]) -> tuple[list[Tried], list[Tried]]:
        """The best taken on to their optimum, and all others: each law at its best seat, and with those that look so
        like a refit that they might be the best of all."""
        n = sum(t.gain > HOPEFUL * self.bars.structure(t.candidate.name) for t in tried[:FINALISTS])
        first, others = at_best_seats(tried, n, self.news, self._seated)
        final = self.taken_on(first)
        if not n:
            return final, others
        tried = self.ranked([*final, *others])
        close = self.ranked(m for m in unasked(self.listed, self.refits.asked, tried) if self._close(m, tried))
        more = self.refits([(m.scored, m.cluster) for m in close[:MEMBERS]])
        return (self.taken_on(more, final) if more else final), others

    def again(self, tried: Sequence[Tried], final: Sequence[Tried]) -> Round | None:
        """The round decided on what else the screen saw at the places of the best; None where that is not what it
        would claim, for what was refused once is not asked again."""
        tried = self.ranked([*tried, *self.refits(neighbours(self.listed, tried, self.refits.asked))])
        more = _left_behind(tried, final)
        if not more:
            return None
        tried = self.ranked([*self.taken_on(more, final), *_but(tried, [*final, *more])])
        best = to_claim(tried, len(self.now.batches))
        return self.decided(tried) if best.candidate.name in {t.candidate.name for t in more} else None

    def taken_on(self, some: Sequence[Tried], beside: Sequence[Tried] = ()) -> list[Tried]:
        """Those beside and some that are taken on to their optimum, all compared with each other."""
        return compared(self.now, [*beside, *self.workers.map(partial(taken_on, self.now), some)])

    def decided(self, tried: Sequence[Tried]) -> Round:
        """Of refits, best first, and behind them of those that look like one; a finer network first."""
        like = self.ranked(unasked(self.listed, self.refits.asked, tried))
        return decided(self.bars, coarse_first([*tried, *like]))

    def ranked(self, tried: Iterable[Tried]) -> list[Tried]:
        """Refits first, then by what is left-out and plausible."""
        return sorted(tried, key=lambda t: (t.fitted is None, -self._standing(t)))

    def _standing(self, t: Tried) -> float:
        return t.standing(self.bars.null.temperature)

    def _seated(self, some: Sequence[Scored]) -> list[Tried]:
        return self.refits([(moved(s, self.bars.seen.evidence), self.listed.cluster(s)) for s in some])

    def _close(self, member: Tried, tried: Sequence[Tried]) -> bool:
        """Whether it might be the best of all, were it refitted."""
        like = next(t for t in tried if t.cluster == member.cluster)
        standing = self._standing(member) > self._standing(tried[0]) - CLOSE
        return standing or (like is tried[0] and like.gain - member.gain < ALIKE * like.gain)

    def _slow_misfit(self) -> Array:
        """What is left of the channels in full: that is what is too coarse."""
        plain = alone(self.now, Memory.none(len(self.now.problem.channels)))
        return plain.mean_squares(plain.left_out())[0]


def one_round(now: Fitted, seed: int, workers: Workers, tell: Progress, cache: Path | None = None) -> Round:
    """One effect named and accepted, or none."""
    looks = _screened(now, seed, workers, tell, cache)
    final, others = looks.finalists(looks.first())
    tried = looks.ranked([*final, *others])
    done = looks.decided(tried)
    if done.accepted or not any(t.gain > UNSETTLED for t in tried):
        return done
    tell("another look", 0, 0)
    return looks.again(tried, final) or done


def _screened(now: Fitted, seed: int, workers: Workers, tell: Progress, cache: Path | None) -> Looks:
    """What the screen sees and what it is held to; nothing is refitted yet."""
    every = proposed(now)
    tell("screen", 0, 0)
    seen, sharp = screens(now, every, [now.memory, Memory.none(len(now.problem.channels))])
    loose = no_news(every, now)
    # Labels that are exchanged are plainly wrong before a fit (`suspects`); after it, two that are right may gain.
    news = [s for s in seen.scored if s.candidate.name not in loose and s.candidate.mechanism != "sensor_swap"]
    sharp_news = [s for s in sharp.scored if s.candidate.name not in loose]
    columns = seen.columns(loose)
    null = cached_null(cache, now, seen.evidence, columns, seed, lambda n, of: tell("structural null", n, of))
    listed = shortlist(best_variants(news), seen.evidence)
    listed = with_sharp(listed, best_variants(sharp_news), sharp.evidence)
    bars = Bars(now, seen, null, columns, seed)
    return Looks(now, workers, Refits(now, workers, tell), listed, news, suspects(now, every), bars)


def _left_behind(tried: Sequence[Tried], final: Sequence[Tried]) -> list[Tried]:
    """The next few that are taken on though they gain little, none that was before at another value of its shape.

    A refit of one step may end far from its optimum: heat to a floor gained 30 nats so, and 731 fitted on.
    """
    known = {t.candidate.plain for t in final}
    more = [t for t in tried if t.fitted is not None and t.candidate.plain not in known and t.gain > LEFT]
    return [t for t in more if t.candidate.mechanism != "coarse_network"][:AGAIN]


def _but(tried: Sequence[Tried], some: Sequence[Tried]) -> list[Tried]:
    """All others."""
    return [t for t in tried if not any(t is one for one in some)]


def _unscreened(some: Sequence[Candidate], first: int) -> list[Work]:
    """What no screen sees; each is a cluster of its own, numbered down from the first."""
    return [(Scored(c, 0.0, 0, 0.0, {}, 0.0, -1), first - k) for k, c in enumerate(some)]


RIVALS = 2  # of each effect that are tried in its place
NEEDLESS = 0.5  # of its gain: what still loses more was not made needless by a later effect, however small it is
RIVAL_BETTER_NATS = 3.0  # nats by which a rival must fit better beside all others


@dataclass(frozen=True)
class Second:
    """An effect taken out, or replaced: how much worse the batches left out are predicted, in nats."""

    effect: int
    rival: Tried | None
    loss: float
    fitted: Fitted


@dataclass(frozen=True)
class _Work:
    effect: int
    part: TwinPart
    rival: Tried | None
    at: dict[str, float]


def second_thoughts(
    final: Fitted,
    effects: list[Tried],
    rivals: list[list[Tried]],
    original: TwinPart,
    least: float,
    temperature: float,
    workers: Workers,
) -> Second | None:
    """The best change of the set of effects, or None: an effect dropped whose loss is below `least` nats and well
    below what it gained when it was accepted, or a rival in its place that gains more than it is less plausible,
    `temperature` nats for each of log prior. Effects and rivals as the rounds tried them."""
    work = []
    for k, t in enumerate(effects):
        rest = without(final.part, t.candidate, original)
        work.append(_Work(k, rest, None, {}))
        for r in rivals[k][:RIVALS]:
            values, at = start_values(r.scored, final)
            try:
                work.append(_Work(k, r.candidate.applied(rest, values), r, dict(at)))
            except (ValueError, KeyError):
                continue
    score = float(alone(final, final.memory).base_score()[0])
    done = [s for s in workers.map(partial(_changed, final, score), work) if s is not None]
    return best_change(done, effects, least, temperature)


def best_change(done: Sequence[Second], effects: Sequence[Tried], least: float, temperature: float) -> Second | None:
    """Of changes that were fitted the one that costs least, if it may be made; as `second_thoughts`."""

    def due(s: Second) -> bool:
        if s.rival is None:
            return s.loss < min(least, NEEDLESS * effects[s.effect].gain)
        return s.loss + temperature * (effects[s.effect].log_prior - s.rival.log_prior) < -RIVAL_BETTER_NATS

    return min((s for s in done if due(s)), key=lambda s: s.loss, default=None)


def _changed(final: Fitted, score: float, w: _Work) -> Second | None:
    try:
        fitted = settle(refitted(final, w.part, w.at), steps=4, tolerance=0.05, rounds=2)
        loss = score - float(alone(fitted, final.memory).base_score()[0])
    except (InputError, WorkError):
        return None
    return Second(w.effect, w.rival, loss, fitted)


def without(part: TwinPart, c: Candidate, original: TwinPart) -> TwinPart:
    """The twin part as it would be had this candidate not been accepted."""
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


MOST_EFFECTS = 4
RESTARTS = 2  # times that a round is done, where a refit shows that the baseline had stopped short
REVISION_BETTER_NATS = 2.0  # nats by which it must have
LITTLE = 0.3  # of a gain: a baseline that stopped short by no more would have led to the same
SWAP = 0.5  # of an effect's gain: what gained as much may take its place when all others are in


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
        if more < REVISION_BETTER_NATS:
            return done
        fair = replace(done.best, gain=done.best.gain - more)
        done = replace(done, before=back, tried=(fair, *done.tried[1:]), accepted=fair.gain > done.threshold)
        if done.accepted and more < LITTLE * fair.gain:
            return done
        now = back
    return done


def start_worker() -> None:
    """First call in a worker process: to find it here loads the search, since threads are limited of what is loaded."""
    threadpool_limits(limits=1)
