"""The search: one effect after the other, each named by full refits and accepted on batches left out, or none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from data.errors import InputError, WorkError
from twin.diagnosis.rounds.decision import Round
from twin.diagnosis.rounds.fitted import Fitted, refitted, settle
from twin.diagnosis.rounds.looks import one_round
from twin.diagnosis.rounds.refits import Tried
from twin.diagnosis.rounds.revise import second_thoughts
from twin.diagnosis.rounds.trust import EVEN
from twin.diagnosis.rounds.workers import Progress, Workers
from twin.diagnosis.scoring.screen import alone

MOST_EFFECTS = 4
RESTARTS = 2  # times that a round is done, where a refit shows that the baseline had stopped short
BETTER = 2.0  # nats by which it must have
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
        if more < BETTER:
            return done
        fair = replace(done.best, gain=done.best.gain - more)
        done = replace(done, before=back, tried=(fair, *done.tried[1:]), accepted=fair.gain > done.threshold)
        if done.accepted and more < LITTLE * fair.gain:
            return done
        now = back
    return done
