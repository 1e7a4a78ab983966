"""One round of the search: screen, refit, take the best on, decide; and look again before nothing is claimed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from twin.calibration.fit_problem import Array
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.proposals.coarse import coarse_candidates
from twin.diagnosis.proposals.slack import no_news
from twin.diagnosis.rounds.decision import FINALISTS, Bars, Round, coarse_first, decided, to_claim
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.rounds.null_cache import cached_null
from twin.diagnosis.rounds.refits import Refits, Tried, Work, compared, short_ones_on, taken_on
from twin.diagnosis.rounds.seats import at_best_seats
from twin.diagnosis.rounds.shortlist import Shortlist, mates, moved, neighbours, shortlist, unasked, with_sharp
from twin.diagnosis.rounds.workers import Progress, Workers
from twin.diagnosis.scoring.exchanged import suspects
from twin.diagnosis.scoring.memory import Memory
from twin.diagnosis.scoring.screen import Scored, alone, best_variants, proposed, screens

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
