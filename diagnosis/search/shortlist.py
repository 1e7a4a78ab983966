"""The shortlist of a screen: the best, the best of other mechanisms, and what only unfiltered rows show."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from diagnosis.candidates.priors import log_prior
from diagnosis.contracts import Scored, Tried
from diagnosis.policy import POLICY
from diagnosis.screening.evidence import Evidence
from diagnosis.search.refits import Work, multiplies_heat


@dataclass(frozen=True)
class Shortlist:
    """The candidates of a screen that are clustered, the best first.

    Attributes:
        worth: the candidates, as the screen scored them.
        clusters: of each the name of the first of those that these recordings cannot distinguish from it.
        chosen: which of them are refitted, one of each cluster.
    """

    worth: tuple[Scored, ...]
    clusters: tuple[str, ...]
    chosen: tuple[int, ...]

    def work(self, which: Sequence[int]) -> list[Work]:
        """Those of these numbers, to be refitted."""
        return [(self.worth[k], self.clusters[k]) for k in which]

    def cluster(self, s: Scored) -> str:
        """Its cluster; outside the shortlist each is one of its own."""
        of_name = {one.candidate.name: k for one, k in zip(self.worth, self.clusters, strict=True)}
        return of_name.get(s.candidate.name, s.candidate.name)


def shortlist(news: Sequence[Scored], evidence: Evidence) -> Shortlist:
    """The shortlist of a screen.

    A baseline bent far by what it lacks shows little in the screen, so every mechanism may send its best.
    """
    worth = sorted((s for s in news if s.gain > POLICY.screen_min_gain_nats), key=_promise)[
        : POLICY.screened_candidates
    ]
    worth = [moved(s, evidence) for s in worth]
    clusters = _clusters(worth, evidence)
    best = max((s.gain for s in worth), default=0.0)
    chosen: list[int] = []
    seen: set[tuple[str, str]] = set()
    for k, s in enumerate(worth):
        most = POLICY.refits_with_other_mechanisms + (
            POLICY.refits_of_strong_mechanisms if s.gain > POLICY.strong_gain_share * best else 0
        )
        if len(chosen) >= most or (
            len(chosen) >= POLICY.refits_unconditional and s.gain < POLICY.refit_min_screen_gain_nats
        ):
            break
        kind = s.candidate.mechanism, s.candidate.where.kind
        new = kind not in seen
        if (len(chosen) < POLICY.refits_best or new) and not any(clusters[k] == clusters[j] for j in chosen):
            chosen.append(k)
            seen.add(kind)
    return Shortlist(tuple(worth), tuple(clusters), tuple(chosen))


def with_sharp(first: Shortlist, sharp: Sequence[Scored], evidence: Evidence) -> Shortlist:
    """The shortlist with the best candidates at errors, of other mechanisms, by a screen of unfiltered rows.

    A missing effect lengthens the memory of residuals; filtered by it, the sharp trace of a shift or of a late clock
    may be gone.
    """
    refitted = [first.worth[k].candidate for k in first.chosen]
    seen = {(c.mechanism, c.where.kind) for c in refitted}
    ranked = [s for s in sorted(sharp, key=_promise) if s.column >= 0 and s.gain > POLICY.screen_min_gain_nats][
        : POLICY.screened_candidates
    ]
    own = _clusters(ranked, evidence)
    known = {own[k] for k, s in enumerate(ranked) if s.candidate.name in {c.name for c in refitted}}
    more: list[Scored] = []
    for k, s in enumerate(ranked):
        kind = s.candidate.mechanism, s.candidate.where.kind
        if len(more) >= POLICY.sharp_refits or s.gain < POLICY.sharp_gain_share * ranked[0].gain:
            break
        if kind[1] == "error" and kind not in seen and own[k] not in known:
            seen.add(kind)
            known.add(own[k])
            more.append(moved(s, evidence))
    names = {s.candidate.name for s in more}
    kept = [k for k, s in enumerate(first.worth) if s.candidate.name not in names]
    return Shortlist(
        (*(first.worth[k] for k in kept), *more),
        (*(first.clusters[k] for k in kept), *(f"{s.candidate.name} by independent rows" for s in more)),
        (*(kept.index(k) for k in first.chosen), *(len(kept) + k for k in range(len(more)))),  # none of `more`
    )


def moved(s: Scored, evidence: Evidence) -> Scored:
    """With the linear step of the fit's parameters when the candidate enters."""
    if s.column < 0:
        return s
    amplitude = max(s.amplitudes.values(), key=abs, default=0.0)
    return replace(s, moves=tuple((-amplitude * evidence.shadow[:, s.column]).tolist()))


def cluster_mates(listed: Shortlist, tried: Sequence[Tried]) -> list[Work]:
    """Candidates of another mechanism to refit in the cluster of a refit.

    They are refitted where that refit fell short of the screen, or where they multiply a heat, of which a linear step
    shows only a fraction. Laws that look alike in one linear step may differ when they are fitted.
    """
    out: list[int] = []
    for t in sorted(tried, key=lambda t: -t.scored.gain):
        short = t.gain < POLICY.short_refit_gain_share * t.scored.gain
        same = [k for k, cluster in enumerate(listed.clusters) if cluster == t.cluster and k not in listed.chosen]
        other = [(k, s) for k in same if (s := listed.worth[k]).candidate.mechanism != t.candidate.mechanism]
        out += [
            k
            for k, s in other
            if s.gain > POLICY.continued_min_screen_gain_nats and (short or multiplies_heat(s.candidate))
        ][:1]
    return listed.work(out[: POLICY.continued_refits])


def neighbours(listed: Shortlist, tried: Sequence[Tried], requested: Collection[str]) -> list[Work]:
    """Further candidates at the places whose refits gain most, one of each cluster without a refit.

    An effect that is not linear shows little in the screen, while others at its place gain in its stead.
    """
    best = sorted((t for t in tried if t.candidate.kind.is_physics), key=lambda t: -t.gain)
    places = list(dict.fromkeys(t.candidate.where for t in best))[: POLICY.revisited_places]
    known = {t.cluster for t in tried}
    out: list[int] = []
    for place in places:
        there: list[int] = []
        for k, s in enumerate(listed.worth):
            if s.candidate.where == place and s.candidate.name not in requested and listed.clusters[k] not in known:
                there.append(k)
                known.add(listed.clusters[k])
        out += there[: POLICY.refits_per_revisited_place]
    return listed.work(out)


def not_refitted(listed: Shortlist, requested: Collection[str], tried: Sequence[Tried]) -> list[Tried]:
    """The others of each refitted cluster, as much worse as the screen says; `requested` are the names of those that
    went to a refit."""
    best_in: dict[str, Tried] = {}
    for t in tried:
        best_in.setdefault(t.cluster, t)
    out = []
    for s, cluster in listed.work(range(len(listed.worth))):
        if s.candidate.name not in requested and cluster in best_in:
            like = best_in[cluster]
            loss = max(0.0, like.scored.gain - s.gain)
            alike = None if like.alike is None else like.alike - loss
            out.append(
                Tried(s, like.gain - loss, s.improved, cluster, log_prior(s, like.fitted, like.scored), alike=alike)
            )
    return out


def _promise(s: Scored) -> tuple[float, str]:
    """Sort key, best first; of equal gains the candidate with the fewest shape parameters heads its cluster."""
    return POLICY.shape_min_gain_nats * len(s.candidate.shape) - s.gain, s.candidate.name


def _clusters(worth: Sequence[Scored], evidence: Evidence) -> list[str]:
    """The cluster of every candidate: the name of the first whose signature agrees with its own."""
    columns = [s.column for s in worth if s.column >= 0]
    like = evidence.likeness(columns) if columns else np.zeros((0, 0))
    place = {c: k for k, c in enumerate(columns)}
    heads: dict[int, str] = {}
    out: list[str] = []
    for s in worth:
        head = s.column
        if s.column >= 0:
            k = place[s.column]
            head = next((h for h in heads if like[k, place[h]] > POLICY.same_signature_cosine), s.column)
            heads.setdefault(head, s.candidate.name)
        out.append(heads.get(head, s.candidate.name))
    return out


def at_best_placements(
    tried: Sequence[Tried],
    n: int,
    scored: Sequence[Scored],
    refitted: Callable[[Sequence[Scored]], Sequence[Tried]],
) -> tuple[list[Tried], list[Tried]]:
    """The first `n`, each law of open shape at the placement where its refit gains most, and all others.

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
        others = [
            s
            for s in scored
            if _law(s) == law and s.gain > POLICY.screen_min_gain_nats and s.candidate.name not in names
        ]
        placements = [*known, *refitted(others[: POLICY.placement_refits])]
        best = max(placements, key=lambda t: t.gain)
        at = next(k for k, t in enumerate(first) if _law(t.scored) == law)
        first = [best if k == at else t for k, t in enumerate(first) if k == at or _law(t.scored) != law]
        rest = [*(t for t in placements if t is not best), *(t for t in rest if _law(t.scored) != law)]
    return first, rest


def _law(s: Scored) -> tuple[str, str, str]:
    return s.candidate.mechanism, s.candidate.where.kind, s.candidate.where.name


def _open(s: Scored) -> bool:
    """Whether it has a shape, and places or values of that shape among which the screen chose."""
    c = s.candidate
    return bool(c.shape) and c.part is not None and (c.part.at is not None or bool(c.variant_of))
