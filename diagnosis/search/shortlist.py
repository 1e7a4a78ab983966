"""What a screen finds worth a refit: the best, the best of other mechanisms, and what only rows in full show."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.candidates.priors import log_prior
from diagnosis.contracts import Scored, Tried
from diagnosis.screening.evidence import Evidence
from diagnosis.search.refits import FELL, MATES, PROMISED, Work, grows

BEST, KINDS = 5, 7  # refits of a round: the best of all, and with the best of every other mechanism
MORE, STRONG = 3, 0.25  # more of these if they gain this share of the best: a strong effect has many imitators
SHARP, WELL = 2, 0.1  # more at errors, where every row counts in full, if they gain this share of the best there
PLACES, THERE = 2, 3  # that are looked at again before nothing is claimed, and what is refitted at each
LIKE = 0.95  # |cos| of signatures beyond which recordings cannot tell two candidates apart
WORTH = 0.5  # nats in the screen that are worth a look
# And a refit, beyond the first few: in 112 development cases no true effect that gained 60 nats in its refit had less
# than 26 in the screen.
PROMISING, ANYWAY = 5.0, 2
LOOKED_AT = 80
SHAPED = 5.0  # nats in the screen that each parameter beside the size must be worth


@dataclass(frozen=True)
class Shortlist:
    """What a screen finds worth a look, the best first.

    Attributes:
        worth: the candidates, as the screen scored them.
        clusters: of each a number, the same for those that these recordings cannot tell apart.
        chosen: which of them are refitted, one of each cluster.
    """

    worth: tuple[Scored, ...]
    clusters: tuple[int, ...]
    chosen: tuple[int, ...]

    def work(self, which: Sequence[int]) -> list[Work]:
        """Those of these numbers, to be refitted."""
        return [(self.worth[k], self.clusters[k]) for k in which]

    def cluster(self, s: Scored) -> int:
        """The number of its cluster; outside the shortlist each is one of its own."""
        of_name = {one.candidate.name: k for one, k in zip(self.worth, self.clusters, strict=True)}
        return of_name.get(s.candidate.name, -3000 - s.column)


def shortlist(news: Sequence[Scored], evidence: Evidence) -> Shortlist:
    """What is worth a look, its clusters, and which to refit.

    A baseline bent far by what it lacks shows little in the screen, so every mechanism may send its best.
    """
    worth = sorted((s for s in news if s.gain > WORTH), key=_promise)[:LOOKED_AT]
    worth = [moved(s, evidence) for s in worth]
    clusters = _clusters(worth, evidence)
    best = max((s.gain for s in worth), default=0.0)
    chosen: list[int] = []
    seen: set[tuple[str, str]] = set()
    for k, s in enumerate(worth):
        most = KINDS + (MORE if s.gain > STRONG * best else 0)
        if len(chosen) >= most or (len(chosen) >= ANYWAY and s.gain < PROMISING):
            break
        kind = s.candidate.mechanism, s.candidate.where.kind
        new = kind not in seen
        if (len(chosen) < BEST or new) and not any(clusters[k] == clusters[j] for j in chosen):
            chosen.append(k)
            seen.add(kind)
    return Shortlist(tuple(worth), tuple(clusters), tuple(chosen))


def with_sharp(first: Shortlist, sharp: Sequence[Scored], evidence: Evidence) -> Shortlist:
    """A shortlist with the best at errors of other mechanisms where every row counts in full.

    What is missing makes rows remember each other; filtered by that memory, the sharp trace of a shift or of a clock
    that is late may be gone. (A slow one, unfiltered, passes for thousands of rows.)
    """
    refitted = [first.worth[k].candidate for k in first.chosen]
    seen = {(c.mechanism, c.where.kind) for c in refitted}
    ranked = [s for s in sorted(sharp, key=_promise) if s.column >= 0 and s.gain > WORTH][:LOOKED_AT]
    own = _clusters(ranked, evidence)
    known = {own[k] for k, s in enumerate(ranked) if s.candidate.name in {c.name for c in refitted}}
    more: list[Scored] = []
    for k, s in enumerate(ranked):
        kind = s.candidate.mechanism, s.candidate.where.kind
        if len(more) >= SHARP or s.gain < WELL * ranked[0].gain:
            break
        if kind[1] == "error" and kind not in seen and own[k] not in known:
            seen.add(kind)
            known.add(own[k])
            more.append(moved(s, evidence))
    names = {s.candidate.name for s in more}
    kept = [k for k, s in enumerate(first.worth) if s.candidate.name not in names]
    last = max(first.clusters, default=-1)
    return Shortlist(
        (*(first.worth[k] for k in kept), *more),
        (*(first.clusters[k] for k in kept), *(last + 1 + k for k in range(len(more)))),
        (*(kept.index(k) for k in first.chosen), *(len(kept) + k for k in range(len(more)))),  # none of `more`
    )


def moved(s: Scored, evidence: Evidence) -> Scored:
    """With the way that the parameters go when it takes over what they had been bent for."""
    if s.column < 0:
        return s
    amplitude = max(s.amplitudes.values(), key=abs, default=0.0)
    return replace(s, moves=tuple((-amplitude * evidence.shadow[:, s.column]).tolist()))


def mates(listed: Shortlist, tried: Sequence[Tried]) -> list[Work]:
    """What to refit though another mechanism speaks for its cluster: that one fell in its refit, or it multiplies a
    heat, which a linear step shows at a fraction of what it comes to.

    Two laws that look alike in one linear step part when they are fitted: a clock that is late is not a shift.
    """
    out: list[int] = []
    for t in sorted(tried, key=lambda t: -t.scored.gain):
        fell = t.gain < FELL * t.scored.gain
        same = [k for k, cluster in enumerate(listed.clusters) if cluster == t.cluster and k not in listed.chosen]
        other = [(k, s) for k in same if (s := listed.worth[k]).candidate.mechanism != t.candidate.mechanism]
        out += [k for k, s in other if s.gain > PROMISED and (fell or grows(s.candidate))][:1]
    return listed.work(out[:MATES])


def neighbours(listed: Shortlist, tried: Sequence[Tried], asked: Collection[str]) -> list[Work]:
    """What else the screen saw at the places whose refits gain most, one of each cluster that was not asked.

    What is not linear shows little of itself in one step, and its place the more: natural convection at a motor had 2
    nats in the screen where radiation there had 56; fitted, 349 and 34.
    """
    best = sorted((t for t in tried if t.candidate.mechanism != "coarse_network"), key=lambda t: -t.gain)
    places = list(dict.fromkeys(t.candidate.where for t in best))[:PLACES]
    known = {t.cluster for t in tried}
    out: list[int] = []
    for place in places:
        there: list[int] = []
        for k, s in enumerate(listed.worth):
            if s.candidate.where == place and s.candidate.name not in asked and listed.clusters[k] not in known:
                there.append(k)
                known.add(listed.clusters[k])
        out += there[:THERE]
    return listed.work(out)


def unasked(listed: Shortlist, asked: Collection[str], tried: Sequence[Tried]) -> list[Tried]:
    """The others of each refitted cluster, as much worse as the screen says; `asked` are the names of what was given
    to a refit."""
    best_in: dict[int, Tried] = {}
    for t in tried:
        best_in.setdefault(t.cluster, t)
    out = []
    for s, cluster in listed.work(range(len(listed.worth))):
        if s.candidate.name not in asked and cluster in best_in:
            like = best_in[cluster]
            loss = max(0.0, like.scored.gain - s.gain)
            alike = None if like.alike is None else like.alike - loss
            out.append(
                Tried(s, like.gain - loss, s.improved, cluster, log_prior(s, like.fitted, like.scored), alike=alike)
            )
    return out


def _promise(s: Scored) -> tuple[float, str]:
    """Best first; of those that gain alike the one with the least freedom speaks for its cluster."""
    return SHAPED * len(s.candidate.shape) - s.gain, s.candidate.name


def _clusters(worth: Sequence[Scored], evidence: Evidence) -> list[int]:
    """A number for every candidate, the same for those whose signatures agree with the first of their cluster."""
    columns = [s.column for s in worth if s.column >= 0]
    like = evidence.likeness(columns) if columns else np.zeros((0, 0))
    place = {c: k for k, c in enumerate(columns)}
    heads: list[int] = []
    out: list[int] = []
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


SEATS = 6  # more that are refitted: in three cases the best stood third, fourth and seventh in the screen


def at_best_seats(
    tried: Sequence[Tried],
    n: int,
    scored: Sequence[Scored],
    refitted: Callable[[Sequence[Scored]], Sequence[Tried]],
) -> tuple[list[Tried], list[Tried]]:
    """The first `n`, each law of open shape at the seat where its refit gains most, and all others.

    Args:
        tried: refits, best first.
        scored: all that was screened, best first.
        refitted: gives the refits of those that can be simulated.
    """
    first, rest = list(tried[:n]), list(tried[n:])
    laws = list(dict.fromkeys(_law(t.scored) for t in first if _open(t.scored)))
    for law in laws:
        known = [t for t in tried if _law(t.scored) == law]
        names = {t.candidate.name for t in known}
        others = [s for s in scored if _law(s) == law and s.gain > WORTH and s.candidate.name not in names]
        seats = [*known, *refitted(others[:SEATS])]
        best = max(seats, key=lambda t: t.gain)
        at = next(k for k, t in enumerate(first) if _law(t.scored) == law)
        first = [best if k == at else t for k, t in enumerate(first) if k == at or _law(t.scored) != law]
        rest = [*(t for t in seats if t is not best), *(t for t in rest if _law(t.scored) != law)]
    return first, rest


def _law(s: Scored) -> tuple[str, str, str]:
    return s.candidate.mechanism, s.candidate.where.kind, s.candidate.where.name


def _open(s: Scored) -> bool:
    """Whether it has a shape, and places that it looks at or values of that shape among which the screen chose."""
    c = s.candidate
    return bool(c.shape) and c.part is not None and (c.part.at is not None or bool(c.variant_of))
