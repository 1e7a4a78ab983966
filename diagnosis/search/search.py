"""The search: effects are added one at a time, each chosen by full refits, until none is probable enough."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from threadpoolctl import threadpool_limits

from data.errors import InputError, WorkError
from data.processes import Processes
from diagnosis.candidates.free_forms import Form, candidate_of, free_forms
from diagnosis.contracts import Candidate, Fitted, Tried, with_parts
from diagnosis.fitting.fitted import left_out_rows, refitted, relearned, structured, unharmed, worsened
from diagnosis.localisation.balance import impossible
from diagnosis.policy import POLICY
from diagnosis.screening.screen import Screen, proposed, screen
from diagnosis.search.claims import Round, fall, null_quantile, trust
from diagnosis.search.refits import Progress, odds_of, refits, shortlist
from twin.schema import TwinPart


@dataclass(frozen=True)
class Search:
    """All rounds; the last one accepted nothing, or the limit was reached.

    `dropped` numbers the rounds whose effect later effects made needless.
    """

    baseline: Fitted
    final: Fitted
    rounds: tuple[Round, ...]
    dropped: tuple[int, ...] = ()

    @property
    def accepted(self) -> tuple[Round, ...]:
        return tuple(r for k, r in enumerate(self.rounds) if r.accepted and k not in self.dropped)


def search(baseline: Fitted, workers: Processes | None = None, progress: Progress | None = None) -> Search:
    """Forward until nothing more is accepted; then effects that later ones made needless are taken out."""
    tell, workers = progress or (lambda step, n, of: None), workers or Processes()
    now = baseline
    rounds: list[Round] = []
    while len(rounds) <= POLICY.max_effects:
        done = one_round(now, workers, tell, rounds[-1].screen if rounds else None)
        rounds.append(done)
        if len(rounds) == 1:
            baseline = done.before
        if not done.accepted or done.best is None:
            now = done.before
            break
        now = _again(done.best.fitted)
    return _without_needless(Search(baseline, now, tuple(rounds)))


def _again(fitted: Fitted) -> Fitted:
    """The fit with an effect more, under the covariance of refined twins that have it too: a law of the list is as
    coarse as a body, and what it leaves is no further effect."""
    try:
        return replace(structured(fitted, fitted.runs), weight=fitted.weight)
    except WorkError:
        return fitted  # no refined twin can be simulated there: under what those of before show


def one_round(
    now: Fitted, workers: Processes, tell: Progress, before: Screen | None = None, listed: bool = True
) -> Round:
    """One effect named and accepted, or none; free forms stand in for what no list names, alone if not `listed`."""
    tell("screen", 0, 0)
    forms = _forms(now)
    every = [*(proposed(now) if listed else ()), *(candidate for candidate, _ in forms.values())]
    seen = screen(now, every, before)
    odds = odds_of(now, seen)
    null = seen.null_gains(odds)
    tried = refits(now, seen, shortlist(now, seen, odds), odds, workers, tell)
    now, tried = _fair(now, tried)
    known = {n: f for n, (_, f) in forms.items()}
    return decided(Round(now, seen, tuple(tried), null, 0.0, False, forms=known))


def decided(done: Round, vetoed: bool = True) -> Round:
    """A round whose claim is the first of its likeliest that may be made; else the first that was judged. `vetoed`:
    none is made that predicts a channel worse."""
    strange = frozenset(i.channel for i in impossible(done.before))
    able = [t for t in done.tried if _resolves(t, strange)]
    likely = [*able, *(t for t in done.tried if t not in able)][: max(POLICY.settled, len(able))]
    settled = [_settled(done.before, t) for t in likely]
    first = sorted(settled, key=lambda t: (not _resolves(t, strange), -t.standing))
    done = replace(done, tried=(*first, *(t for t in done.tried if t not in likely)))
    judged: list[Round] = []
    may = odds_of(done.before, done.screen) if first else {}
    for t in first[: POLICY.claims_judged]:
        judged.append(_judged(done, t, may, strange, vetoed))
        if judged[-1].accepted:
            return judged[-1]
    return judged[0] if judged else done


def _forms(now: Fitted) -> dict[str, tuple[Candidate, Form]]:
    body = next(iter(now.part.bodies), "")
    every = [(candidate_of([f], body), f) for f in free_forms(now.machine, now.part, now.batches)]
    return {c.name: (c, f) for c, f in every if c.name not in now.part.mechanisms}


def _settled(now: Fitted, t: Tried) -> Tried:
    """A refit under the covariance that is likeliest for it, as the fit before is under its own: structure may have
    stood in for an effect."""
    fitted = relearned(t.fitted)
    return replace(t, fitted=fitted, gain=fitted.log_evidence - now.log_evidence, by_run=fitted.foretold - now.foretold)


def _resolves(t: Tried, before: frozenset[str]) -> frozenset[str]:
    """Channels that show what the fit before cannot do whatever its values, and that this one can."""
    return before - {i.channel for i in impossible(t.fitted)} if before else frozenset()


def _judged(done: Round, t: Tried, may: Collection[str], impossible_now: frozenset[str], vetoed: bool) -> Round:
    """The round with `t` as its claim: probable enough, and no channel predicted worse.

    What structure alone gains is asked of the machine with the claim: without it, what it explains is in every twin.
    `may`: names of the candidates that may be claimed.
    """
    rest = [o for o in done.tried if o is not t]
    seen = screen(t.fitted, [s.candidate for s in done.screen.scored], done.screen)
    done = replace(done, null=seen.null_gains(may))
    fallen = fall(done.before, t.fitted)
    resolved = _resolves(t, impossible_now)
    probable = POLICY.max_probability if resolved else trust(fallen)
    enough = probable >= POLICY.claim_min_probability and (bool(resolved) or t.gain > done.threshold)
    raised: Mapping[str, tuple[float, float]] = {}
    if enough and vetoed:
        fitted, raised = unharmed(done.before, t.fitted)
        t = replace(t, fitted=fitted)
        if resolved:  # what makes it possible must also show it
            enough = bool(worsened(left_out_rows(fitted), left_out_rows(done.before)))
    return replace(
        done, tried=(t, *rest), trust=probable, accepted=enough and not raised, fall=fallen, raised=raised,
        resolved=resolved,
    )  # fmt: skip


def _fair(now: Fitted, tried: list[Tried]) -> tuple[Fitted, list[Tried]]:
    """The fit before as good as the best refit is without its candidate, so that no gain is due to a better start."""
    for t in tried[: POLICY.claims_judged]:
        try:
            back = refitted(t.fitted, now.part)
        except (InputError, WorkError):
            continue  # where it has gone with the effect, no machine without it is
        more = back.log_evidence - now.log_evidence
        if more > POLICY.telling_nats:
            lost = back.foretold - now.foretold
            tried = [replace(o, gain=o.gain - more, by_run=o.by_run - lost) for o in tried]
            now = back
    return now, sorted(tried, key=lambda t: -t.standing)


def _without_needless(done: Search) -> Search:
    """Effects taken out, one at a time, whose loss of evidence is no more than structure gains."""
    for _ in range(POLICY.max_effects):
        rounds = [(k, r) for k, r in enumerate(done.rounds) if r.accepted and k not in done.dropped]
        if len(rounds) < 2:
            return done
        for k, r in rounds[:-1]:
            assert r.best is not None
            try:
                rest = refitted(done.final, without(done.final.part, r.best.candidate, done.baseline.part))
            except (InputError, WorkError):
                continue
            loss = done.final.log_evidence - rest.log_evidence
            if loss < null_quantile(r.null) and not worsened(left_out_rows(done.final), left_out_rows(rest)):
                done = replace(done, final=rest, dropped=(*done.dropped, k))
                break
        else:
            return done
    return done


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
