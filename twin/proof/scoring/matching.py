"""Which finding is which true term, and which claims are false.

A finding is a term's when the mechanism is the same (`names`) and the place is the true one or beside it. One finding
claims one term: a second name for the same thing is a false claim. Under the verdict "undecidable" a finding claims
its whole reported set; in confounded cases a partner is as true as the term. Rivals and sensor faults are claims too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from twin.diagnosis.telling.findings import Finding, Findings
from twin.proof.scoring.answer_key import AnswerKey, Spot, TrueTerm
from twin.proof.scoring.names import means
from twin.proof.scoring.places import exact, near, same_place
from twin.proof.scoring.reported_set import reported_set


@dataclass(frozen=True)
class Matches:
    """Findings numbered best first; `of_term` the number that claims a term, or None; `false` those of no term.

    `beside` is, for a term that none claims, the finding that took its stead: at its place, else the next that is left.
    """

    findings: tuple[Finding, ...]
    of_term: tuple[int | None, ...]
    beside: tuple[int | None, ...]
    false: tuple[int, ...]


def spot(finding: Finding) -> Spot:
    return Spot(finding.where.kind, finding.where.name)


def names_term(mechanism: str, place: Spot, term: TrueTerm, body_of: Mapping[str, str]) -> bool:
    """Same mechanism, and at the place or beside it."""
    return means(mechanism, term) and near(place, term, body_of)


def matches(findings: Findings | None, key: AnswerKey, body_of: Mapping[str, str]) -> Matches:
    """Each finding, best first, to a term that none has yet; the right place before one beside it."""
    given = tuple(findings.findings) if findings is not None else ()
    of_term: list[int | None] = [None] * len(key.terms)
    free = set(range(len(given)))

    def take(fits: Sequence[Sequence[bool]]) -> None:
        for n in range(len(given)):
            term = next((k for k, own in enumerate(of_term) if own is None and fits[n][k]), None)
            if n in free and term is not None:
                of_term[term] = n
                free.discard(n)

    take([[means(f.mechanism, t) and exact(spot(f), t) for t in key.terms] for f in given])
    take([[names_term(f.mechanism, spot(f), t, body_of) for t in key.terms] for f in given])
    undecidable = findings is not None and findings.verdict == "undecidable"
    true_too = {n for n in free if _partner(given[n], key.terms) or (undecidable and _ties(given[n], key, body_of))}
    left = sorted(free)
    beside: list[int | None] = []
    for t, own in zip(key.terms, of_term, strict=True):
        at_place = [n for n in left if near(spot(given[n]), t, body_of)]
        stead = next(iter(at_place or left), None) if own is None else None
        beside.append(stead)
        left = [n for n in left if n != stead]
    return Matches(given, tuple(of_term), tuple(beside), tuple(sorted(free - true_too)))


def _partner(finding: Finding, terms: Sequence[TrueTerm]) -> bool:
    """Whether these recordings cannot tell it from a true term, by the key."""
    return any(
        finding.mechanism == mechanism and same_place(place, spot(finding))
        for t in terms
        for mechanism, place in t.partners
    )


def _ties(finding: Finding, key: AnswerKey, body_of: Mapping[str, str]) -> bool:
    return any(names_term(m, place, t, body_of) for m, place in reported_set(finding) for t in key.terms)
