"""The search: one effect after the other, each named by full refits and accepted on batches left out, or none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from data.errors import InputError, WorkError
from twin.calibration.fit_problem import Array
from twin.diagnosis.candidate import Candidate
from twin.diagnosis.evidence import Evidence
from twin.diagnosis.fitted import Fitted, refitted, settle
from twin.diagnosis.null import Null, structural_null
from twin.diagnosis.priors import log_prior, start_values
from twin.diagnosis.screen import Scored, Screen, alone, proposed, screen
from twin.diagnosis.slack import slack

MOST_EFFECTS = 4
REFITS, FEWEST = 8, 4  # of each round, one of each cluster
HOPELESS = 0.3  # of the best refit's gain: what the screen gives less is not refitted
LIKE = 0.95  # |cos| of signatures beyond which recordings cannot tell two candidates apart
WORTH = 0.5  # nats in the screen that are worth a refit
IMPROVED = 0.75  # share of the left-out batches that must improve
FLIPS = 60

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Tried:
    """A candidate after its full refit (or, without one, by the screen alone): gain in nats on batches left out.

    `cluster` numbers candidates that these recordings cannot tell apart; `log_prior` is of its size.
    """

    scored: Scored
    gain: float
    improved: int
    cluster: int
    log_prior: float
    fitted: Fitted | None = None

    @property
    def candidate(self) -> Candidate:
        return self.scored.candidate


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

    @property
    def best(self) -> Tried | None:
        return self.tried[0] if self.tried else None


@dataclass(frozen=True)
class Search:
    """All rounds; the last one accepted nothing, or there were as many as allowed."""

    baseline: Fitted
    final: Fitted
    rounds: tuple[Round, ...]
    deleted: tuple[str, ...] = field(default=())

    @property
    def accepted(self) -> tuple[Round, ...]:
        return tuple(r for r in self.rounds if r.accepted)


def search(baseline: Fitted, seed: int = 0, progress: Progress | None = None) -> Search:
    """Forward until nothing more is accepted."""
    now, rounds = baseline, []
    null: Null | None = None
    for _ in range(MOST_EFFECTS + 1):
        done = one_round(now, null, seed, progress)
        null = done.null
        rounds.append(done)
        if not done.accepted or len(rounds) > MOST_EFFECTS:
            break
        assert done.best is not None and done.best.fitted is not None
        tell = progress or (lambda step, n, of: None)
        tell("settle", len(rounds), MOST_EFFECTS)
        now = settle(done.best.fitted)
    return Search(baseline, now, tuple(rounds))


def one_round(now: Fitted, null: Null | None, seed: int, progress: Progress | None) -> Round:
    """Screen, cluster, refit, score, decide."""
    tell = progress or (lambda step, n, of: None)
    every = proposed(now)
    tell("screen", 0, 0)
    seen = screen(now, every)
    loose = slack(every)
    news = [s for s in seen.scored if s.candidate.name not in loose]
    alarm = [s.column for s in news if s.column >= 0]
    if null is None:
        null = structural_null(now, seen.evidence, alarm, seed, lambda n, of: tell("structural null", n, of))
    inflation = now.state.noise.inflation
    base = alone(now, inflation)
    tried = _tried(now, base, news, seen.evidence, inflation, tell)
    if not tried:
        return Round(now, seen, (), null.threshold(float(base.base_score()[0])), null, np.zeros(0), False)
    best = tried[0]
    after = alone(best.fitted, inflation) if best.fitted else base
    flipped = _flipped(seen.evidence, after, alarm, seed)
    threshold = max(null.threshold(float(after.base_score()[0])), _gumbel(flipped))
    n = len(now.batches)
    accepted = best.gain > threshold and best.improved >= IMPROVED * n
    return Round(now, seen, tuple(tried), threshold, null, flipped, accepted, _sign_p(best.improved, n))


def _tried(
    now: Fitted,
    base: Evidence,
    news: Sequence[Scored],
    evidence: Evidence,
    inflation: Array,
    tell: Progress,
) -> list[Tried]:
    """The best of every cluster refitted, the others as the screen has them, by gain and plausible size."""
    worth = [s for s in news if s.gain > WORTH][: 6 * REFITS]
    clusters = _clusters(worth, evidence)
    chosen: list[int] = []
    out: list[Tried] = []
    for k, s in enumerate(worth):
        best = max((t.gain for t in out), default=0.0)
        if len(chosen) >= REFITS or (len(chosen) >= FEWEST and s.gain < HOPELESS * best):
            break
        if any(clusters[k] == clusters[j] for j in chosen):
            continue
        chosen.append(k)
        tell("refit", len(chosen), REFITS)
        done = _refit(now, s, base, inflation)
        if done is not None:
            out.append(Tried(s, done[1], done[2], clusters[k], log_prior(s, done[0]), done[0]))
    best_in = {t.cluster: t for t in out}
    for k, s in enumerate(worth):
        if k not in chosen and clusters[k] in best_in:  # as much worse as the screen says
            like = best_in[clusters[k]]
            gain = like.gain - max(0.0, like.scored.gain - s.gain)
            out.append(Tried(s, gain, s.improved, clusters[k], log_prior(s, None)))
    refits = sorted((t for t in out if t.fitted is not None), key=lambda t: -(t.gain + t.log_prior))
    return refits + sorted((t for t in out if t.fitted is None), key=lambda t: -(t.gain + t.log_prior))


def _refit(now: Fitted, s: Scored, base: Evidence, inflation: Array) -> tuple[Fitted, float, int] | None:
    values, at = start_values(s, now)
    try:
        fitted = refitted(now, s.candidate.applied(now.part, values), at)
    except (InputError, WorkError):
        return None
    after = alone(fitted, inflation)
    gain = float(after.base_score()[0] - base.base_score()[0])
    return fitted, gain, improved(base, after)


def improved(before: Evidence, after: Evidence) -> int:
    """Left-out batches whose squares fall, each channel in units of what is left of it afterwards."""
    left, right = before.left_out(), after.left_out()
    unit = np.maximum(np.nan_to_num(after.mean_squares(right)[0], nan=1.0), 1.0)
    count = 0
    for b, a, e, f in zip(before.batches, after.batches, left, right, strict=True):
        old = (e[:, 0] ** 2 / (before.weight * unit)[b.channel] / before.rows[b.channel]) @ before.count[b.channel]
        new = (f[:, 0] ** 2 / (after.weight * unit)[a.channel] / after.rows[a.channel]) @ after.count[a.channel]
        count += int(new < old)
    return count


def _clusters(worth: Sequence[Scored], evidence: Evidence) -> list[int]:
    """A number for every candidate, the same for those whose signatures agree with the first of their cluster."""
    columns = [s.column for s in worth if s.column >= 0]
    like = evidence.likeness(columns) if columns else np.zeros((0, 0))
    place = {c: k for k, c in enumerate(columns)}
    heads: list[int] = []
    out = []
    for s in worth:
        if s.column < 0:
            out.append(-1 - len(out))
            continue
        k = place[s.column]
        head = next((h for h in heads if like[k, place[h]] > LIKE), None)
        if head is None:
            heads.append(s.column)
            head = s.column
        out.append(heads.index(head))
    return out


def _flipped(evidence: Evidence, after: Evidence, alarm: Sequence[int], seed: int) -> Array:
    """Largest gains (FLIPS,) when what the best candidate leaves over takes a random sign in every batch.

    What agrees between batches is gone, what varies stays: the wild cluster bootstrap with the effect in the model
    (Cameron, Gelbach and Miller 2008), over the whole family of candidates (Westfall and Young 1993).
    """
    left = after.left_out()
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(len(left), FLIPS))
    scale = np.sqrt(evidence.weight / after.weight)
    targets = [
        e * scale[b.channel][:, None] * s for b, e, s in zip(evidence.batches, left, signs, strict=True)
    ]
    return np.asarray(evidence.gains(targets)[0][:, list(alarm)].max(axis=1))


def _gumbel(gain: Array, share: float = 0.99) -> float:
    scale = float(np.std(gain, ddof=1)) * np.sqrt(6.0) / np.pi
    return float(np.mean(gain)) - scale * (np.euler_gamma + float(np.log(-np.log(share))))


def _sign_p(better: int, n: int) -> float:
    """Chance of so many improved batches if improving were a coin's toss (Fisher's sign test)."""
    from scipy.stats import binom

    return float(binom.sf(better - 1, n, 0.5))
