"""The search: one effect after the other, each named by full refits and accepted on batches left out, or none."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from data.errors import InputError, WorkError
from twin.calibration.fit_problem import Array
from twin.diagnosis.proposals.candidate import Candidate
from twin.diagnosis.proposals.coarse import coarse_candidates
from twin.diagnosis.proposals.slack import no_news
from twin.diagnosis.rounds.acceptance import flipped_gains, flipped_threshold, sign_p, stands_out
from twin.diagnosis.rounds.fitted import Fitted, refitted, settle
from twin.diagnosis.rounds.null import Null
from twin.diagnosis.rounds.null_beside import null_beside
from twin.diagnosis.rounds.null_cache import cached_null
from twin.diagnosis.rounds.refits import (
    Tried,
    compared,
    mates,
    moved,
    refit,
    short_ones_on,
    shortlist,
    taken_on,
    with_clusters,
    with_sharp,
)
from twin.diagnosis.rounds.revise import second_thoughts
from twin.diagnosis.rounds.seats import at_best_seats
from twin.diagnosis.rounds.trust import EVEN, LEAST_FINER, least_gain
from twin.diagnosis.rounds.workers import Workers
from twin.diagnosis.scoring.exchanged import suspects
from twin.diagnosis.scoring.memory import Memory
from twin.diagnosis.scoring.screen import Scored, Screen, alone, best_variants, proposed, screens

MOST_EFFECTS = 4
IN_DOUBT = 20.0  # nats of a refit from which a finer network might be why
IMPROVED = 0.75  # share of the left-out batches that must improve
WORTH_A_CLAIM = 0.5  # of the highest gain: what improves most batches is asked before what improves a few by more
RESTARTS = 2  # times that a round is done, where a refit shows that the baseline had stopped short
BETTER = 2.0  # nats by which it must have
LITTLE = 0.3  # of a gain: a baseline that stopped short by no more would have led to the same
FINALISTS, HOPEFUL = 4, 0.25  # refits taken on to their optimum, if they gain this share of the structural null's
MEMBERS = 2  # that are refitted too: of those that look like a refit the likeliest
CLOSE, ALIKE = 2.0, 0.15  # if they stand no further below the best, or one step in the screen made the difference
SWAP = 0.5  # of an effect's gain: what gained as much may take its place when all others are in
APART = 0.4  # of a gain: what gains as much beside another is none of it
UNLIKELY = 20.0  # odds of nothing against it, with rows counted as for its rivals, at which nothing is claimed
NEXT = 2  # that are asked after one whose own null speaks against it
FINER = 0.9  # of the best gain: a finer network that gains as much comes first

Progress = Callable[[str, int, int], None]
Order = Callable[[Tried], tuple[bool, float]]


@dataclass(frozen=True)
class Round:
    """One round: all that was tried, best first, and what it took to be accepted."""

    before: Fitted
    screen: Screen
    tried: tuple[Tried, ...]
    threshold: float
    null: Null
    flipped: Array
    accepted: bool
    sign_p: float = 1.0
    beside: Null | None = None  # the null of the best where the fit has it
    density: float = 0.0  # of batches left out, in nats, where the fit has it

    @property
    def scatter(self) -> float:
        """By how much structure alone moves the best's amplitude, in its unit; 0 where that is not known."""
        if self.beside is None or self.best is None:
            return 0.0
        return self.beside.scatter(self.best.candidate.name, self.density)

    @property
    def best(self) -> Tried | None:
        return self.tried[0] if self.tried else None


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
    every_news = [s for s in seen.scored if s.candidate.name not in loose and s.candidate.mechanism != "sensor_swap"]
    columns = seen.columns(loose)
    news = best_variants(every_news)
    null = cached_null(cache, now, seen.evidence, columns, seed, lambda n, of: tell("structural null", n, of))
    order = _order(null.temperature)
    base = alone(now, now.memory)
    sharp_news = best_variants([s for s in sharp.scored if s.candidate.name not in loose])
    worth, clusters, chosen = with_sharp(shortlist(news, seen.evidence), sharp_news, sharp.evidence)
    swapped = [_unscreened(c) for c in suspects(now, every)]
    work = [*(worth[k] for k in chosen), *swapped]
    tried = _refits(
        now, work, [*(clusters[k] for k in chosen), *(-2000 - k for k in range(len(swapped)))], workers, tell
    )
    tried = short_ones_on(now, tried, workers)
    more = mates(tried, worth, clusters, chosen)
    tried += _refits(now, [worth[k] for k in more], [clusters[k] for k in more], workers, tell)
    chosen = [*chosen, *more]
    if any(t.gain > IN_DOUBT for t in tried):
        plain = alone(now, none)  # a slow misfit in full: that is what is too coarse
        left = plain.mean_squares(plain.left_out())[0]
        coarse = [_unscreened(c) for c in coarse_candidates(now, left)]
        tried += _refits(now, coarse, [-1000 - k for k in range(len(coarse))], workers, tell)
    tried.sort(key=order)
    before = float(base.base_score()[0])
    n_final = sum(t.gain > HOPEFUL * null.threshold(before, name=t.candidate.name) for t in tried[:FINALISTS])
    cluster = {s.candidate.name: k for s, k in zip(worth, clusters, strict=True)}
    seated, others = at_best_seats(tried, n_final, every_news, partial(_seated, now, seen, cluster, workers, tell))
    final = compared(now, list(workers.map(partial(taken_on, now), seated)))
    tried = sorted([*final, *others], key=order)
    members = with_clusters(tried, worth, clusters, chosen) if n_final else []
    close = sorted((m for m in members if _close(m, tried, order)), key=order)[:MEMBERS]
    fitted = zip(close, workers.map(partial(refit, now), [m.scored for m in close]), strict=True)
    again = [replace(t, cluster=m.cluster) for m, t in fitted if t is not None]
    if again:
        rest = [t for t in tried if not any(t is f for f in final)]
        final = compared(now, [*final, *workers.map(partial(taken_on, now), again)])
        tried = sorted([*final, *rest], key=order)
        chosen = [*chosen, *(k for k, s in enumerate(worth) if any(s is m.scored for m in close))]
    tried = coarse_first([*tried, *sorted(with_clusters(tried, worth, clusters, chosen), key=order)])
    if not tried or tried[0].fitted is None:
        name = tried[0].candidate.name if tried else ""
        least = max(null.threshold(before, name=name), EVEN)
        return Round(now, seen, tuple(tried), least, null, np.zeros((0, 0)), False)
    best = to_claim(tried, len(now.batches))
    ask = partial(asked, now, seen, null, tried, columns, seed)
    if best.gain > least_gain(best, len(now.batches)) and best.candidate.mechanism != "coarse_network":
        finer = _apart(now, best, tried, len(now.batches))
        if finer is not None and (done := ask(finer)).accepted:
            return done
    first = ask(best)
    if first.accepted or best.gain <= EVEN or best.candidate.mechanism == "coarse_network":
        return first
    # What structure may make of one effect, and of what imitates it, is not said of another that stands beside it.
    for other in elsewhere(best, tried, len(now.batches)):
        better = next(n for n, t in enumerate(tried) if t is other)
        like = other.cluster == best.cluster
        rest = [
            replace(t, barred=True) if n < better or (t.cluster == best.cluster and not like) else t
            for n, t in enumerate(tried)
        ]
        if (done := asked(now, seen, null, rest, columns, seed, other)).accepted:
            return done
    return first


def elsewhere(first: Tried, tried: Sequence[Tried], batches: int) -> list[Tried]:
    """Further finalists that may be claimed where the first may not: with it in, they gain nearly as much, or they look
    like it and gain more where each counts rows as its own fit remembers them."""
    out: list[Tried] = []
    for t in effects_of(tried, batches):
        like = t.cluster == first.cluster
        if len(out) < NEXT and t is not first and (t.gain > first.gain if like else _beside(first, t)):
            out.append(t)
    return out


def effects_of(tried: Sequence[Tried], batches: int) -> list[Tried]:
    """The finalists that gain what a claim takes; no finer network."""
    return [
        t
        for t in tried
        if t.fitted is not None
        and t.candidate.mechanism != "coarse_network"
        and agreed_on(t, batches)
        and t.gain > least_gain(t, batches)
    ]


def asked(
    now: Fitted, seen: Screen, null: Null, tried: Sequence[Tried], columns: Mapping[str, int], seed: int, best: Tried
) -> Round:
    """The round with this one of those tried as its best, and whether it is accepted."""
    assert best.fitted is not None
    n = len(now.batches)
    after = alone(best.fitted, now.memory)
    flipped = flipped_gains(seen.evidence, after, list(columns.values()), seed)
    agreed = agreed_on(best, n)
    beside = null_beside(now, best.fitted, best.candidate, seed) if agreed and best.gain > EVEN else None
    own, density = (null, float(after.base_score()[0])) if beside is None else beside
    structure = own.threshold(density, name=best.candidate.name)
    if best.candidate.mechanism == "coarse_network":
        structure = 0.0  # what structure makes is what it is for
    which = list(columns).index(best.candidate.name) if best.candidate.name in columns else None
    least = least_gain(best, n if agreed else best.improved)  # else the bar of one that all batches agree on
    threshold = max(structure, flipped_threshold(flipped, n, which), least)
    accepted = best.gain > threshold and agreed and not _unlikely(best, threshold, null.temperature)
    tried = (best, *(t for t in tried if t is not best))
    return Round(now, seen, tried, threshold, null, flipped, accepted, sign_p(best.improved, n), own, density)


def _unlikely(best: Tried, threshold: float, temperature: float) -> bool:
    """Whether nothing would be far likelier, where its rows count as its rivals' do.

    Its own memory may make many rows of a few: a lever that gained 240 nats so gained 96 beside its rivals.
    """
    if best.candidate.mechanism == "coarse_network":
        return False
    return threshold - best.level > temperature * float(np.log(UNLIKELY))


def _apart(now: Fitted, best: Tried, tried: Sequence[Tried], batches: int) -> Tried | None:
    """A finer network that neither the best effect nor the next explains, taken on; None where there is none.

    What heat or a lever really adds makes a network look too coarse, and with it in that is over; castings stay too
    coarse whatever is added, and an effect is better judged where they are not.
    """
    finer = [t for t in tried if t.candidate.mechanism == "coarse_network" and t.fitted is not None]
    agreed = [t for t in finer if t.gain > LEAST_FINER and agreed_on(t, batches)]
    effects = [best, *(t for t in effects_of(tried, batches) if t.cluster != best.cluster)][: 1 + NEXT]
    for first in sorted(agreed, key=lambda t: -t.gain)[:2]:
        if all(_beside(effect, first, LEAST_FINER) for effect in effects):
            return taken_on(now, first)
    return None


def _beside(first: Tried, t: Tried, least: float = EVEN) -> bool:
    """Whether it gains much of what it does alone, and no less than `least` nats, in a fit that has the first."""
    assert first.fitted is not None
    beside = refit(first.fitted, t.scored)
    return beside is not None and beside.gain > max(APART * t.gain, least)


def _unscreened(c: Candidate) -> Scored:
    return Scored(c, 0.0, 0, 0.0, {}, 0.0, -1)


def _refits(
    now: Fitted, work: Sequence[Scored], clusters: Sequence[int], workers: Workers, tell: Progress
) -> list[Tried]:
    """Those that can be simulated, in full."""
    out = []
    for n, t in enumerate(workers.map(partial(refit, now), work)):
        tell("refit", n + 1, len(work))
        if t is not None:
            out.append(replace(t, cluster=clusters[n]))
    return out


def _seated(
    now: Fitted, seen: Screen, cluster: Mapping[str, int], workers: Workers, tell: Progress, some: Sequence[Scored]
) -> list[Tried]:
    """Those that were no more than screened; outside the shortlist each is a cluster of its own."""
    numbers = [cluster.get(s.candidate.name, -3000 - s.column) for s in some]
    return _refits(now, [moved(s, seen.evidence) for s in some], numbers, workers, tell)


def _close(member: Tried, tried: Sequence[Tried], order: Order) -> bool:
    """Whether it might be the best of all, were it refitted."""
    like = next(t for t in tried if t.cluster == member.cluster)
    standing = -order(member)[1] > -order(tried[0])[1] - CLOSE
    return standing or (like is tried[0] and like.gain - member.gain < ALIKE * like.gain)


def agreed_on(t: Tried, batches: int) -> bool:
    """Whether most batches improve and its size stands out from nothing."""
    return bool(t.improved >= IMPROVED * batches and stands_out(t))


def to_claim(tried: Sequence[Tried], batches: int) -> Tried:
    """Of refits, best first, the first that improves most batches, stands out and gains enough; else the best."""
    for t in tried[:FINALISTS]:
        if t.fitted is not None and agreed_on(t, batches) and t.gain > least_gain(t, batches):
            return t if t.gain > WORTH_A_CLAIM * tried[0].gain else tried[0]
    return tried[0]


def coarse_first(tried: list[Tried]) -> list[Tried]:
    """A finer network is the simpler explanation: physics goes first only where it gains clearly more."""
    enough = FINER * (tried[0].level if tried else 0.0)
    finer = [t for t in tried if t.candidate.mechanism == "coarse_network" and t.level > enough > 0]
    return finer[:1] + [t for t in tried if t not in finer[:1]]


def _order(temperature: float) -> Order:
    """Refits first, then by what is left-out and plausible."""
    return lambda t: (t.fitted is None, -t.standing(temperature))
