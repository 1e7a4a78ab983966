"""A true term as a candidate that the diagnosis could have proposed or described, begun at the key's own values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from twin.diagnosis.proposals.candidate import Candidate, Where
from twin.diagnosis.proposals.priors import start_values
from twin.diagnosis.rounds.fitted import Fitted
from twin.diagnosis.scoring.screen import Scored, Screen
from twin.diagnosis.unlisted.forms import OF_BODY, Form, Level, candidate_of
from twin.mechanisms import MECHANISMS
from twin.proof.scoring.answer_key import Spot, TrueTerm
from twin.proof.scoring.names import counted_as
from twin.proof.scoring.places import exact
from twin.quantity import Value
from twin.schema import TwinPart


def true_candidates(term: TrueTerm, seen: Screen, every: Sequence[Candidate]) -> list[Scored]:
    """The candidates at the term's place with its mechanism, best first in the screen.

    The key does not say by which channel the twin would drive it, or which bodies it would look at besides.
    """
    own = [s for s in seen.scored if _is(term, s.candidate)]
    own = [s for s in own if s.candidate.where.name == term.where.name] or own
    if own:
        return sorted(own, key=lambda s: -s.gain)
    unseen = next((c for c in every if _is(term, c)), None)  # what cannot be switched off has no signature
    return [] if unseen is None else [Scored(unseen, 0.0, 0, 0.0, {}, 0.0, -1)]


def open_shape(term: TrueTerm, s: Scored) -> bool:
    """Whether it has a shape that the key does not state: the screen saw it at one value of that alone."""
    return not set(s.candidate.shape) <= set(term.parameters or {})


def of_no_list(term: TrueTerm, fit: Fitted) -> Candidate | None:
    """The law of a heat that no list has, as the key states it; None where it states none or a driver is not recorded.

    It is the one of no list that `true_candidates` looks for among the candidates.
    """
    role, *drivers = term.form or ("",)
    if not role or not all(name in b.table.columns for name in drivers for b in fit.batches):
        return None
    level, other, *_ = (*(Level(name, "", 1.0, False) for name in drivers), None, None)
    body = term.where.name if role in OF_BODY else ""
    return candidate_of([Form(Where("node", term.where.name), role, level, other, body)])


def each_its_own(terms: Sequence[TrueTerm], choices: Sequence[Sequence[Scored]]) -> list[Scored | None]:
    """By term the first of its choices, none twice: of what two terms want, each has first what is driven as its key
    says. A cabinet's heat and a pump's at one body are two candidates of one mechanism."""
    wanted = Counter(own[0].candidate.name for own in choices if own)
    out: list[Scored | None] = []
    for term, own in zip(terms, choices, strict=True):
        twice = bool(own) and wanted[own[0].candidate.name] > 1
        first = sorted(own, key=lambda s: not _driven_as(term, s.candidate)) if twice else own
        taken = {s.candidate.name for s in out if s is not None}
        out.append(next((s for s in first if s.candidate.name not in taken), None))
    return out


def begun_at_truth(
    term: TrueTerm, s: Scored, now: Fitted, share: float = 1.0
) -> tuple[Mapping[str, Value], Mapping[str, float]]:
    """`start_values` of a refit, with the key's values to begin with, amplitudes at this share of them; priors are
    what a diagnosis would have."""
    c = s.candidate
    if c.mechanism not in MECHANISMS or c.change is not None:
        return start_values(s, now)
    mechanism = MECHANISMS[c.mechanism]
    known = {n: v for n, (v, _) in (term.parameters or {}).items() if n in {p.name for p in mechanism.parameters}}
    told = {a: known[a] - off for a, off in (mechanism.off or {}).items() if a in known}
    amplitudes = {a: share * v for a, v in {**s.amplitudes, **told}.items()}
    values, at = start_values(replace(s, amplitudes=amplitudes), now)
    shaped = {
        name: given.model_copy(update={"value": _said(known[name], mechanism.spec(name).unit), "prior": given.value})
        for name, given in values.items()
        if name in known and name not in (mechanism.off or {})
    }
    return {**values, **shaped}, at


def with_terms(
    part: TwinPart, terms: Sequence[TrueTerm], found: Sequence[Scored], now: Fitted, share: float = 1.0
) -> tuple[TwinPart, dict[str, float]]:
    """The twin part with these candidates in it, and where a refit begins; `share` as in `begun_at_truth`.

    Raises:
        ValueError: two of them take the same name.
    """
    at: dict[str, float] = {}
    for term, s in zip(terms, found, strict=True):
        values, begin = begun_at_truth(term, s, now, share)
        part = s.candidate.applied(part, values)
        at.update(begin)
    return part, at


def _driven_as(term: TrueTerm, c: Candidate) -> bool:
    """Whether it is driven by the channel that the key names; by none, where the key names none."""
    drivers = c.part.drivers if c.part is not None else None
    channels = set(drivers.values()) if isinstance(drivers, Mapping) else {drivers} - {None}
    return term.driver in channels if term.driver else not channels


def _is(term: TrueTerm, c: Candidate) -> bool:
    return counted_as(c.mechanism) == counted_as(term.mechanism) and exact(Spot(c.where.kind, c.where.name), term)


def _said(number: float, unit: str) -> str | float:
    return float(f"{number:.6g}") if unit == "1" else f"{number:.6g} {unit}"
