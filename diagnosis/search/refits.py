"""Full refits of the most promising candidates of a screen."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from data.errors import InputError, WorkError
from data.processes import Processes
from diagnosis.candidates.discretisation import slack
from diagnosis.candidates.priors import free_values, log_odds
from diagnosis.contracts import Candidate, CandidateKind, Scored
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import refitted
from diagnosis.localisation.balance import impossible
from diagnosis.policy import POLICY
from diagnosis.screening.exchanged import suspected_swaps
from diagnosis.screening.screen import Screen, one_of_each, similarity
from diagnosis.search.claims import Tried, least_relative_gain
from twin.compile import own_paths
from twin.mechanisms import MECHANISMS

Progress = Callable[[str, int, int], None]  # receives the step, how many of it are done, and of how many


def odds_of(now: Fitted, seen: Screen) -> dict[str, float]:
    """Log odds of every candidate that may be claimed, by name."""
    every = [s.candidate for s in seen.scored]
    own = [c for c in every if c.kind is not CandidateKind.SENSOR_SWAP]
    variants = Counter(c.mechanism for c in own if not c.variant_of)
    cost = POLICY.unlisted_term_cost_nats
    return {c.name: log_odds(c, now, variants[c.mechanism]) - cost * c.kind.is_unlisted for c in own}


def shortlist(now: Fitted, seen: Screen, odds: dict[str, float]) -> list[Scored]:
    """What is refitted: the best by gain and odds, few of a mechanism; paths of heat to bodies that show what without
    one is impossible, whatever they gain in one linear step; and labels that are plainly exchanged."""
    least = POLICY.refit_min_gain_share * least_relative_gain() * abs(now.log_evidence)
    ranked = sorted(
        (s for s in seen.scored if s.candidate.name in odds and s.gain > least),
        key=lambda s: (-(s.gain + odds[s.candidate.name]), s.candidate.name),
    )
    taken: Counter[str] = Counter()
    out: list[Scored] = []
    for s in one_of_each(ranked):
        if len(out) == POLICY.refits:
            break
        if taken[s.candidate.mechanism] < POLICY.refits_of_mechanism:
            taken[s.candidate.mechanism] += 1
            out.append(s)
    cold = {body for i in impossible(now) for body in i.bodies}
    out += [s for s in ranked_paths(now, seen, cold) if s not in out]
    return out + [Scored(c) for c in suspected_swaps(now, [s.candidate for s in seen.scored])]


def ranked_paths(now: Fitted, seen: Screen, cold: set[str]) -> list[Scored]:
    """Candidates at a body that bring heat to one of these from another, the best first, one of each law and place."""
    bodies = set(now.part.bodies)

    def joined(s: Scored) -> set[str]:
        part, where = s.candidate.part, s.candidate.where
        if (
            part is None
            or where.kind != "node"
            or not {"heat_W", "expand"} & set(MECHANISMS[s.candidate.mechanism].effects())
        ):
            return set()
        ports = part.at.values() if isinstance(part.at, Mapping) else [part.at]
        return {str(place) for place in (*ports, part.into)} & bodies

    listed = [s for s in seen.scored if s.candidate.mechanism in MECHANISMS]
    return one_of_each([s for s in listed if len(ends := joined(s)) > 1 and ends & cold])


def refits(
    now: Fitted, seen: Screen, work: Sequence[Scored], odds: dict[str, float], workers: Processes, report: Progress
) -> list[Tried]:
    """Those that can be simulated, the likeliest first."""
    clusters, sizes = _clusters(now, seen, work), slack([s.candidate for s in work], now)
    out = []
    for n, (s, fitted) in enumerate(zip(work, workers.map(partial(refit, now), work), strict=True)):
        report("refit", n + 1, len(work))
        if fitted is not None and not _usual(s.candidate, fitted, sizes):
            name, gain = s.candidate.name, fitted.log_evidence - now.log_evidence
            by_run = fitted.log_predictive_density - now.log_predictive_density
            out.append(Tried(s, fitted, gain, by_run, clusters.get(name, name), odds.get(name, 0.0)))
    return sorted(out, key=lambda t: -t.score)


def refit(now: Fitted, s: Scored) -> Fitted | None:
    """A fit with one candidate more; None where it cannot be simulated."""
    try:
        return refitted(now, s.candidate.applied(now.part, free_values(s, now)), fresh=True)
    except (InputError, WorkError):
        return None


def _usual(c: Candidate, fitted: Fitted, sizes: Mapping[str, float]) -> bool:
    """Whether it is an error that any sensor or length may have (`candidates.discretisation`), within its usual size:
    one that is larger than those of the others is no effect yet."""
    if c.name not in sizes or c.part is None:
        return False
    most = POLICY.usual_error_sd * sizes[c.name]
    own, parameters = own_paths(fitted.machine, fitted.part), fitted.problem.network.parameters
    values = {own.get(p.name, p.name): v for p, v in zip(parameters, fitted.values.tolist(), strict=True)}
    return all(abs(values[f"mechanisms.{c.name}.{a}"] - off) <= most for a, off in c.amplitudes.items())


def _clusters(now: Fitted, seen: Screen, work: Sequence[Scored]) -> dict[str, str]:
    """By name the first of those whose signature agrees with its own."""
    shown = [s for s in work if s.column >= 0]
    if not shown:
        return {}
    same = similarity(now, seen, shown) > POLICY.same_signature_cosine
    return {s.candidate.name: shown[int(same[k].argmax())].candidate.name for k, s in enumerate(shown)}
