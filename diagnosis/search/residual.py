"""The residual of the search: does it follow something that no listed mechanism is?"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce

import pandas as pd

from diagnosis.candidates.discretisation import never_reported
from diagnosis.candidates.free_forms import Form, candidate_of, free_forms, phrases
from diagnosis.candidates.library import own_bodies
from diagnosis.contracts import Candidate, Fitted, Scored, Tried
from diagnosis.findings.conclude import activity, usual_size
from diagnosis.findings.report_data import Estimate, Found, Rms, listed, place_label
from diagnosis.fitting.fitted import left_out_rows, worsened
from diagnosis.fitting.regression import Memory, whiter
from diagnosis.localisation.where_when import Located
from diagnosis.policy import POLICY
from diagnosis.screening.screen import alone, proposed, screens, slackened
from diagnosis.search.acceptance import trust
from diagnosis.search.decision import Criteria, evaluated
from diagnosis.search.probability import probability_cap
from diagnosis.search.refits import optimised, refit
from diagnosis.search.search import Search
from diagnosis.search.shortlist import moved
from twin.calibration.identifiability import Interval
from twin.schema import TwinPart


@dataclass(frozen=True)
class Terms:
    """An effect of no listed mechanism as a refit has it, whatever it gains."""

    forms: tuple[Form, ...]
    tried: Tried

    @property
    def fitted(self) -> Fitted:
        """The network with it."""
        assert self.tried.fitted is not None
        return self.tried.fitted

    @property
    def name(self) -> str:
        return self.tried.candidate.name


@dataclass(frozen=True)
class UnlistedEffect(Terms):
    """An accepted effect of no listed mechanism; it had to gain `threshold` nats."""

    threshold: float

    @property
    def _switched(self) -> Candidate:
        """The candidate with the drivers that all of its terms share: it is at work while they run."""
        part = self.tried.candidate.part
        assert part is not None
        shared = {"level": all(f.level for f in self.forms), "other": all(f.other for f in self.forms)}
        stated = part.drivers if isinstance(part.drivers, Mapping) else {}
        drivers = {role: name for role, name in stated.items() if shared[role]}
        return replace(self.tried.candidate, part=part.model_copy(update={"drivers": drivers or None}))

    def flux(self, located: Located) -> pd.DataFrame:
        """Its series over time, free of any form."""
        return located.over_time("heat" if self.forms[0].heat else "displacement", self.forms[0].where.name)

    def found(
        self, part: TwinPart, intervals: Mapping[str, Interval], rms: Sequence[Rms], caps: tuple[str, ...]
    ) -> Found:
        """As a finding: its terms, and its watts or displacement."""
        c, batches = self.tried.candidate, len(self.fitted.batches)
        head = f"mechanisms.{self.name}."
        stated = {n.removeprefix(head): i for n, i in intervals.items() if n.startswith(head)}
        regime, windows = activity(self.fitted, self._switched)
        return Found(
            mechanism=c.mechanism,
            where=c.where,
            place=place_label(c.where, part),
            parameters={n: Estimate(i.value, i.unit, i.low, i.high) for n, i in stated.items()},
            probability=min(trust(self.tried), probability_cap(self.fitted.runs)),
            name=self.name,
            context=f"it follows {listed([f.label for f in self.forms])}",
            regime=regime,
            windows=windows,
            rms=tuple(rms),
            caps=caps,
            evidence={
                "gain_nats": self.tried.gain,
                "threshold_nats": self.threshold,
                "batches_improved": self.tried.improved,
                "batches": batches,
                "follows": phrases(self.forms, {n: i.value for n, i in stated.items()}),
            },
            size=Estimate(usual_size(self.fitted, c), "W" if self.forms[0].heat else "um"),
        )


def unlisted_effect(done: Search, seed: int = 0) -> UnlistedEffect | None:
    """The residual as a few terms at one place, or None: noise, or what follows nothing known.

    It must meet the criteria of a listed mechanism, and gain clearly more than any of those does there.
    """
    least = POLICY.unlisted_min_gain_ratio * max(
        (t.gain for t in done.rounds[-1].tried if t.fitted is not None), default=0.0
    )
    return _left(done, lambda best: best.tried.gain > least, seed, None)


def in_place_of_listed(
    done: Search, left: UnlistedEffect | None, seed: int = 0
) -> tuple[Search, UnlistedEffect] | None:
    """One effect of no listed mechanism in place of all that was accepted, and the search without that; None where it
    does not predict batches left out by far better, or as well as it and they together do.

    A listed mechanism may take over a part of what it is not; only the search's baseline shows it whole.
    """
    bare = replace(done, final=done.baseline, rounds=(replace(done.rounds[0], accepted=False),), dropped=())
    both = done.final if left is None else left.fitted

    def better(own: Terms) -> bool:
        memory = reduce(whiter, (f.memory for f in (done.baseline, both, own.fitted)))
        none, them, it = (float(alone(f, memory).base_score()[0]) for f in (done.baseline, both, own.fitted))
        return it > (
            none + POLICY.unlisted_min_gain_ratio * (them - none) if left is None else them - POLICY.even_odds_gain_nats
        )

    listed_best = max((r.best for r in done.accepted if r.best is not None), key=lambda t: t.gain)
    own = _left(bare, better, seed, listed_best.candidate)
    return None if own is None else (bare, own)


def _left(
    done: Search, enough: Callable[[Terms], bool], seed: int, better_than: Candidate | None
) -> UnlistedEffect | None:
    """The effect, if it gains enough and no less than a listed mechanism would have to."""
    now, last = done.final, done.rounds[-1]
    every = free_forms(now.machine, now.part, now.batches)
    best = strongest(now, every, better_than)
    if best is None or best.tried.gain < POLICY.even_odds_gain_nats or not enough(best):
        return None
    columns = last.screen.columns(never_reported(proposed(now), now))
    verdict = evaluated(Criteria(now, last.screen, last.null, columns, seed), [best.tried], best.tried)
    if not verdict.accepted:
        return None
    whole = completed(now, best, every)
    if worsened(left_out_rows(now), left_out_rows(whole.fitted)):
        whole = best
    return UnlistedEffect(whole.forms, whole.tried, verdict.threshold)


def strongest(now: Fitted, every: Sequence[Form], better_than: Candidate | None = None) -> Terms | None:
    """The term that gains most of those that the screen thinks best, fitted to its optimum; of equals the simplest.

    Only those count that gain more in the screen than the candidate `better_than`.
    """
    screened = _promising(now, every, better_than=better_than)
    tried = [one for f, s in screened if (one := _refitted(now, (f,), s)) is not None]
    best = _best(now, tried)
    if best is None:
        return None
    alike = [one for one in best if one.tried.gain > best[0].tried.gain - POLICY.term_min_gain_nats]
    return min(alike, key=lambda one: every.index(one.forms[0]))


def completed(now: Fitted, left: Terms, every: Sequence[Form]) -> Terms:
    """The effect with further terms, as long as each gains enough on batches left out."""
    while len(left.forms) < POLICY.unlisted_max_terms:
        joint = [f for f in every if f.goes_with(left.forms)]
        needed = max(POLICY.term_min_gain_nats, POLICY.term_min_gain_share * left.tried.gain)
        known = dict(zip((p.name for p in left.fitted.problem.network.parameters), left.fitted.values, strict=True))
        sizes = {f.role: float(known[f"mechanisms.{left.name}.{f.role}"]) for f in left.forms}
        more = [
            one
            for f, s in _promising(left.fitted, joint, needed)
            if (one := _refitted(now, (*left.forms, f), replace(s, amplitudes=sizes | s.amplitudes, moves=())))
        ]
        best = _best(now, more)
        if best is None or best[0].tried.gain < left.tried.gain + needed:
            return left
        left = best[0]
    return left


def _best(now: Fitted, tried: Sequence[Terms]) -> list[Terms] | None:
    """The terms that may gain most, at their optimum, best first."""
    most = max((one.tried.gain for one in tried), default=0.0)
    close = [
        one
        for one in tried
        if one.tried.gain
        > max(POLICY.unlisted_close_gain_share * most, POLICY.finalist_min_null_share * POLICY.even_odds_gain_nats)
    ]
    taken = [replace(one, tried=optimised(now, one.tried)) for one in close]
    return sorted(taken, key=lambda one: -one.tried.gain) or None


def _promising(
    now: Fitted,
    forms: Sequence[Form],
    least: float = POLICY.unlisted_min_screen_gain_nats,
    better_than: Candidate | None = None,
) -> list[tuple[Form, Scored]]:
    """The best terms of two screens, with filtered and with unfiltered rows."""
    own = {c.name: (f, c) for f in forms for c in [candidate_of([f], own_bodies(now.part)[0])]}
    every = [*slackened(now), *(c for _, c in own.values())]
    if better_than is not None and all(c.name != better_than.name for c in every):
        every.append(better_than)
    out: dict[str, tuple[Form, Scored]] = {}
    for seen in screens(now, every, [now.memory, Memory.none(len(now.problem.channels))]):
        needed = max(
            [least, *(s.gain for s in seen.scored if better_than is not None and s.candidate.name == better_than.name)]
        )
        best = [s for s in seen.scored if s.candidate.name in own and s.gain > needed][: POLICY.unlisted_refits]
        out = {s.candidate.name: (own[s.candidate.name][0], moved(s, seen.evidence)) for s in best} | out
    return list(out.values())


def _refitted(now: Fitted, forms: tuple[Form, ...], s: Scored) -> Terms | None:
    """The network with these terms as one mechanism, begun where the screen says; None where it cannot be simulated."""
    name = f"unlisted_{forms[0].where.name}"
    while name in now.part.mechanisms:
        name += "_"
    c = replace(candidate_of(forms, own_bodies(now.part)[0]), name=name)
    tried = refit(now, replace(s, candidate=c))
    return None if tried is None else Terms(forms, tried)
