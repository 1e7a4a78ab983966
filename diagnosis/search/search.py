"""The search: effects are added one at a time, then each is judged with all others in the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from threadpoolctl import threadpool_limits

from data.errors import InputError, WorkError
from data.processes import Processes
from diagnosis.candidates.free_forms import Form, candidate_of, free_forms
from diagnosis.contracts import Candidate, with_parts
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import refitted, relearned, restructured
from diagnosis.localisation.balance import impossible
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen, proposed, screen
from diagnosis.search.claims import Round, Tried, figures
from diagnosis.search.refits import Progress, odds_of, refits, shortlist
from twin.schema import TwinPart


@dataclass(frozen=True)
class Search:
    """The fit without effects, that with all that were claimed, and the rounds: of each effect, judged with the others
    in the model, and the last, which found nothing that is probable enough (unless the limit was reached)."""

    baseline: Fitted
    final: Fitted
    rounds: tuple[Round, ...]

    @property
    def accepted(self) -> tuple[Round, ...]:
        return tuple(r for r in self.rounds if r.accepted)


def search(baseline: Fitted, workers: Processes | None = None, progress: Progress | None = None) -> Search:
    """Effects are claimed one after the other; then each is judged, or replaced, with all others in the model: two
    effects may each be hidden by the other."""
    report, workers = progress or (lambda step, n, of: None), workers or Processes()
    rounds: list[Round] = []
    now = baseline
    while len(rounds) < POLICY.max_effects:
        rounds.append(one_round(now, workers, report, rounds[-1].screen if rounds else None))
        best = rounds[-1].best
        if best is None or not rounds[-1].accepted:
            break
        now = best.fitted
    first = rounds[0].before
    rounds, final = _judged_together(first, rounds, workers, report)
    return Search(first, final, tuple(rounds))


def _judged_together(
    baseline: Fitted, rounds: list[Round], workers: Processes, report: Progress
) -> tuple[list[Round], Fitted]:
    """The rounds, each with all other effects in its fit before, and the fit with those that are accepted."""
    claimed = [k for k, r in enumerate(rounds) if r.accepted]
    full = rounds[claimed[-1]].best.fitted if claimed else baseline  # type: ignore[union-attr]
    for k in claimed[:-1]:
        try:
            done = one_round(less(full, rounds[k], baseline), workers, report, rounds[k].screen)
        except (InputError, WorkError):
            continue  # no machine is without it
        if done.best is not None and done.best.fitted.log_evidence < full.log_evidence - POLICY.negligible_nats:
            continue  # the effects as they were claimed explain more
        rounds[k] = done
        full = done.best.fitted if done.best is not None else done.before
    if not any(r.accepted for r in rounds):
        return rounds, baseline
    for k in claimed:
        if not rounds[k].accepted:
            with suppress(InputError, WorkError):  # no machine is without it
                full = less(full, rounds[k], baseline)
    return rounds, full


def less(fitted: Fitted, done: Round, baseline: Fitted) -> Fitted:
    """The fit without the effect of a round.

    Raises:
        InputError, WorkError: it cannot be simulated without.
    """
    if done.best is None:
        return fitted
    return refitted(fitted, without(fitted.part, done.best.candidate, baseline.part))


def one_round(
    now: Fitted, workers: Processes, report: Progress, before: Screen | None = None, listed: bool = True
) -> Round:
    """What one effect more would explain, the likeliest first; free forms represent what no list names; they are the
    only candidates if not `listed`."""
    report("screen", 0, 0)
    forms = _forms(now)
    linear = [c for c, f in forms.values() if f.linear]
    seen = screen(now, [*(proposed(now) if listed else ()), *linear], before)
    places = list(dict.fromkeys(s.candidate.where for s in seen.scored))[: POLICY.form_places]
    more = [c for c, f in forms.values() if not f.linear and f.where in places]
    seen = screen(now, [*(s.candidate for s in seen.scored), *more], seen)
    odds = odds_of(now, seen)
    tried = refits(now, seen, shortlist(now, seen, odds), odds, workers, report)
    known = {n: f for n, (_, f) in forms.items()}
    return decided(Round(now, seen, tuple(tried), forms=known))


def decided(done: Round) -> Round:
    """A round with the gains of its explanations: first those that make possible what the recordings show, then the
    likeliest.

    Structure that is drawn without an effect lacks what the effect makes of gradients, and with it may imitate more.
    So the likeliest is confirmed, and the next one if it loses its place by that; after a few, the best of them stays.
    """
    if not done.tried:
        return done
    strange = frozenset(i.channel for i in impossible(done.before))
    before, anew = _fair(done.before, done.tried), None
    tried = [_against(before, t) for t in done.tried]
    for left in range(POLICY.confirmed, -1, -1):
        tried.sort(key=lambda t: (not _resolves(t, strange), not (left or t.confirmed), -t.score))
        first, found = tried[0], figures(before, tried)
        resolved = _resolves(first, strange)
        if not left or first.confirmed or resolved or found.probability < POLICY.claim_min_probability:
            break
        anew = anew or restructured(before)
        tried[0] = _confirmed(first, anew)
    return replace(done, before=before, tried=tuple(tried), figures=found, resolved=resolved)


def _confirmed(t: Tried, before: Fitted) -> Tried:
    """An explanation with what it gains at least: also where both fits are under structure of their own."""
    again = restructured(t.fitted).log_evidence - before.log_evidence
    return replace(t, gain=min(t.gain, again), confirmed=True)


def _fair(now: Fitted, tried: Sequence[Tried]) -> Fitted:
    """The fit before at the best optimum that is known without an effect: what the likeliest explanation has found on
    its way, and would keep without its effect, is no gain of that effect."""
    best, first = relearned(now), max(tried, key=lambda t: t.score)
    with suppress(InputError, WorkError):  # where it has gone with the effect, no machine without it is
        back = refitted(first.fitted, now.part)
        best = back if back.log_evidence > best.log_evidence else best
    return best


def _against(before: Fitted, t: Tried) -> Tried:
    gain, by_run = (
        t.fitted.log_evidence - before.log_evidence,
        t.fitted.log_predictive_density - before.log_predictive_density,
    )
    return replace(t, gain=gain, by_run=by_run, confirmed=False)


def _forms(now: Fitted) -> dict[str, tuple[Candidate, Form]]:
    body = next(iter(now.part.bodies), "")
    every = [(candidate_of([f], body), f) for f in free_forms(now.machine, now.part, now.batches)]
    return {c.name: (c, f) for c, f in every if c.name not in now.part.mechanisms}


def _resolves(t: Tried, before: frozenset[str]) -> frozenset[str]:
    """Channels that show what the fit before cannot do whatever its values, and that this one can and so gains."""
    return before - {i.channel for i in impossible(t.fitted)} if before and t.gain > 0 else frozenset()


def without(part: TwinPart, c: Candidate, original: TwinPart) -> TwinPart:
    """The twin part without an accepted candidate."""
    if c.change is None:
        return with_parts(part, {f"mechanisms.{c.name}": None})
    group, name = c.change.parameter.name.split(".")[:2]
    known: Mapping[str, object] = getattr(original, group)
    return with_parts(part, {f"{group}.{name}": known[name]} if name in known else {})  # type: ignore[dict-item]


def start_worker() -> None:
    """First call in a worker process: to find it here loads the search, since threads are limited of what is loaded."""
    threadpool_limits(limits=1)
