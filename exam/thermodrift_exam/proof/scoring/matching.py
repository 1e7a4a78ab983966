"""Assignment of findings to true terms, and the false claims.

A finding matches a term if the mechanism is the same (`names`) and the place is the true one or adjacent. A term takes
one finding at each place that it acts on; a second name for the same effect is a false claim. Under the verdict
"undecidable" a finding claims its whole reported set; in confounded cases a partner is as true as the term.
Alternatives and faults are claims too.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import pi

from diagnosis.findings.schema import Finding, Findings
from diagnosis.policy import POLICY
from thermodrift_exam.proof.scoring.answer_key import AnswerKey, Spot, TrueTerm
from twin.mechanisms import MECHANISMS

UNLISTED = "unlisted"
FREE = ("free_flux", "free_shift")  # the regressions that describe physics of no listed mechanism
SAME = (
    frozenset({"guide_friction", "nut_friction", "screw_bearing"}),  # heat in proportion to the feed
    frozenset({"jacket_chiller", "coolant_jacket"}),  # a fluid at a set temperature that takes heat from a body
)
SAME_IF_SWITCHED = (
    frozenset({"cabinet_heat", "electrical_heat"}),  # constant heat while one channel is 1
)


def counted_as(mechanism: str | None) -> str:
    """The name of a mechanism; `UNLISTED` for None and for the regressions that describe unlisted physics."""
    return UNLISTED if mechanism is None or mechanism in FREE else mechanism


def means(named: str | None, term: TrueTerm) -> bool:
    """Whether a reported name means the mechanism of the term."""
    pair = {counted_as(named), counted_as(term.mechanism)}
    groups = SAME + (SAME_IF_SWITCHED if term.driver else ())
    return len(pair) == 1 or any(pair <= group for group in groups)


def exact(named: Spot, term: TrueTerm) -> bool:
    """The place of the term or one of `also`. The two ends of a link may be named in either order."""
    return any(same_place(named, place) for place in (term.where, *term.also))


def near(named: Spot, term: TrueTerm, body_of: Mapping[str, str]) -> bool:
    """Exact, or adjacent: a touching body, a link that ends at the true place, an end of the true link.

    A sensor represents its body (`body_of`). Error channels and faults of other sensors have no neighbours.
    """
    if exact(named, term):
        return True
    ends = {end for place in (term.where, *term.also) for end in _ends(place, body_of)}
    own = _ends(named, body_of)
    touching = set(term.neighbours) if named.kind != "link" else set()
    return bool(own & (ends | touching))


def same_place(one: Spot, other: Spot) -> bool:
    """Of one name and, where both are stated, of one kind."""
    kinds = not one.kind or not other.kind or one.kind == other.kind
    return kinds and (one.name == other.name or _parted(one) == _parted(other))


def _parted(spot: Spot) -> frozenset[str]:
    return frozenset(spot.name.split("-"))


def _ends(spot: Spot, body_of: Mapping[str, str]) -> set[str]:
    """The bodies of a place."""
    if spot.kind == "error":
        return set()
    if spot.name in body_of:
        return {body_of[spot.name]}
    return set() if spot.kind == "sensor" else set(spot.name.split("-"))


def reported_set(finding: Finding) -> list[tuple[str, Spot]]:
    """Mechanism and place of every explanation that the finding reports, its own first."""
    least = POLICY.named_min_probability_share * finding.probability
    own = [(finding.mechanism, Spot(finding.where.kind, finding.where.name))]
    others = [(a.mechanism, Spot(a.where.kind, a.where.name)) for a in finding.alternatives if a.probability >= least]
    return list(dict.fromkeys([*own, *others]))


@dataclass(frozen=True)
class Matches:
    """Findings numbered best first; `of_term` the number of the finding that matches a term, or None; `false` those
    that match none.

    `instead` is, for a term without a match, the finding reported in its stead: the one at its place, else the next
    one.
    """

    findings: tuple[Finding, ...]
    of_term: tuple[int | None, ...]
    instead: tuple[int | None, ...]
    false: tuple[int, ...]


def spot(finding: Finding) -> Spot:
    return Spot(finding.where.kind, finding.where.name)


def names_term(mechanism: str, place: Spot, term: TrueTerm, body_of: Mapping[str, str]) -> bool:
    """Same mechanism, and at the place or adjacent."""
    return means(mechanism, term) and near(place, term, body_of)


def matches(findings: Findings | None, key: AnswerKey, body_of: Mapping[str, str]) -> Matches:
    """Each finding, best first, to a term that none has yet; the right place before an adjacent one."""
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
    true_too = {
        n
        for n in free
        if _elsewhere(given[n], key, [None if own is None else spot(given[own]) for own in of_term])
        or _partner(given[n], key.terms)
        or (undecidable and _ties(given[n], key, body_of))
    }
    left = sorted(free)
    instead: list[int | None] = []
    for t, own in zip(key.terms, of_term, strict=True):
        at_place = [n for n in left if near(spot(given[n]), t, body_of)]
        stead = next(iter(at_place or left), None) if own is None else None
        instead.append(stead)
        left = [n for n in left if n != stead]
    return Matches(given, tuple(of_term), tuple(instead), tuple(sorted(free - true_too)))


def _elsewhere(finding: Finding, key: AnswerKey, found_at: Sequence[Spot | None]) -> bool:
    """Whether it names a term that another finding matches, at another place that the term acts on."""
    return any(
        at is not None and not same_place(at, spot(finding)) and means(finding.mechanism, t) and exact(spot(finding), t)
        for t, at in zip(key.terms, found_at, strict=True)
    )


def _partner(finding: Finding, terms: Sequence[TrueTerm]) -> bool:
    """Whether these recordings cannot distinguish it from a true term, by the key."""
    return any(
        finding.mechanism == mechanism and same_place(place, spot(finding))
        for t in terms
        for mechanism, place in t.partners
    )


def _ties(finding: Finding, key: AnswerKey, body_of: Mapping[str, str]) -> bool:
    return any(names_term(m, place, t, body_of) for m, place in reported_set(finding) for t in key.terms)


RATED_RPM = 6000.0  # at which effects of the speed are compared
Values = Mapping[str, float]
Sized = tuple[float | None, float | None, float | None]  # a value, and low and high of its 90 % interval
Reported = Mapping[str, tuple[float | None, tuple[float | None, float | None] | None]]  # by parameter the same


def _sun_W(p: Values) -> float:
    return p["power"] if "power" in p else p["irradiance"] * p["area"] * p["absorptivity"]


def _motor_W(p: Values) -> float:
    x = RATED_RPM / p.get("rated", RATED_RPM)
    return p["idle"] + p["linear"] * x + p["quadratic"] * x**2


def _convection(p: Values) -> float:
    return p["gain"] * (RATED_RPM / p.get("rated", RATED_RPM)) ** p.get("exponent", 2.0 / 3.0)


def _shift_um(p: Values) -> float:
    return p["shift"] * (RATED_RPM / p.get("rated", RATED_RPM)) ** 2


PRODUCTS: Mapping[str, Callable[[Values], float]] = {
    "sun": _sun_W,
    "guide_friction": lambda p: p["friction"] * p["load"],  # N, of P = F v
    "nut_friction": lambda p: 2e3 * pi * p["moment"] / p["lead"],
    "screw_bearing": lambda p: 2e3 * pi * p["moment"] / p["lead"],
    "radiation": lambda p: p["area"] * p["emissivity"],
    "rotating_convection": _convection,
    "speed_shift": _shift_um,
    "motor_loss": _motor_W,
    "draught": lambda p: p["factor"] * p["drop"],  # K: loss of a surface at room temperature, per W/K
    "stratification": lambda p: p["gradient"] * p.get("height", 1.0),
}


def amplitude(mechanism: str, values: Values) -> float | None:
    """The amplitude as one number; None where these values do not give it. Of several amplitudes a missing one is 0."""
    if mechanism not in MECHANISMS:
        return None
    off = dict(MECHANISMS[mechanism].off or {})
    try:
        if mechanism in PRODUCTS:
            return PRODUCTS[mechanism]({**(off if off.keys() & values.keys() else {}), **values})
        first = next(iter(off))
        return values[first] - off[first]
    except (KeyError, StopIteration, ZeroDivisionError):
        return None


def true_amplitude(term: TrueTerm) -> float | None:
    """The amplitude of the key."""
    values = {name: value for name, (value, _) in (term.parameters or {}).items()}
    return amplitude(term.mechanism, values) if term.mechanism else None


def found_amplitude(finding: Finding, scale_of: TrueTerm) -> Sized:
    """The amplitude of a finding."""
    reported = {name: (p.value, p.interval90) for name, p in finding.parameters.items()}
    return sized(finding.mechanism, reported, scale_of)


def sized(mechanism: str, parameters: Reported, scale_of: TrueTerm) -> Sized:
    """Value, low and high of the 90 % interval, in the quantity of the key; the interval is None if none is stated.

    From the key only the scale is taken (a rated speed), never a size. A product's interval is that of its
    first amplitude, the other values held; several amplitudes have none.
    """
    given = {name: v for name, (v, _) in (scale_of.parameters or {}).items()}
    stated = {name: value for name, (value, _) in parameters.items() if value is not None}
    fixed = {name: v for name, v in given.items() if name in _others(mechanism) and name not in stated}
    values = {**fixed, **stated}
    value = amplitude(mechanism, values)
    free = [name for name in _amplitudes(mechanism) if name in stated]
    interval = parameters[free[0]][1] if len(free) == 1 else None
    if value is None or interval is None or interval[0] is None or interval[1] is None:
        return value, None, None
    ends = [amplitude(mechanism, {**values, free[0]: end}) for end in interval if end is not None]
    known = sorted(e for e in ends if e is not None)
    return (value, known[0], known[-1]) if len(known) == 2 else (value, None, None)


def _amplitudes(mechanism: str) -> tuple[str, ...]:
    return tuple(MECHANISMS[mechanism].off or {}) if mechanism in MECHANISMS else ()


def _others(mechanism: str) -> set[str]:
    """A law's parameters other than its amplitudes."""
    if mechanism not in MECHANISMS:
        return set()
    return {s.name for s in MECHANISMS[mechanism].parameters} - set(_amplitudes(mechanism))


Windows = Sequence[tuple[str, float, float]]


def overlap(reported: Windows, true: Windows, length_s: Mapping[str, float]) -> float:
    """Intersection over union of both in time, over all batches; 0 where neither has any time (Jaccard 1912)."""
    one, other = _by_batch(reported, length_s), _by_batch(true, length_s)
    both = sum(_length(_common(one[b], other[b])) for b in length_s)
    either = sum(_length(one[b]) + _length(other[b]) for b in length_s) - both
    return both / either if either > 0 else 0.0


def always(length_s: Mapping[str, float]) -> list[tuple[str, float, float]]:
    """Every batch from its start to its end."""
    return [(batch, 0.0, seconds) for batch, seconds in length_s.items()]


def _by_batch(windows: Windows, length_s: Mapping[str, float]) -> dict[str, list[tuple[float, float]]]:
    """Merged, in order, within the batch."""
    out: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for batch, start, end in sorted(windows):
        if batch not in length_s:
            continue
        start, end = max(start, 0.0), min(end, length_s[batch])
        if out[batch] and start <= out[batch][-1][1]:
            out[batch][-1] = (out[batch][-1][0], max(end, out[batch][-1][1]))
        elif end > start:
            out[batch].append((start, end))
    return out


def _common(one: Sequence[tuple[float, float]], other: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(max(a, c), min(b, d)) for a, b in one for c, d in other if min(b, d) > max(a, c)]


def _length(windows: Sequence[tuple[float, float]]) -> float:
    return sum(end - start for start, end in windows)


JOINING = {"and", "times", "with", "x"}


def flagged(findings: Findings) -> bool:
    """Whether the verdict or a finding reports an unlisted effect."""
    return findings.verdict == "unlisted" or any(counted_as(f.mechanism) == UNLISTED for f in findings.findings)


def driver_right(findings: Findings, term: TrueTerm, body_of: Mapping[str, str]) -> bool:
    """Whether an unlisted finding at the place or adjacent names every channel that drives the term."""
    drivers = set(re.findall(r"[A-Za-z_]\w*", term.driver or "")) - JOINING
    return any(
        counted_as(f.mechanism) == UNLISTED and near(spot(f), term, body_of) and drivers <= _terms(f)
        for f in findings.findings
    )


def _terms(finding: Finding) -> set[str]:
    texts = [finding.statement, finding.equation, finding.when.regime, str(finding.evidence.get("follows", ""))]
    return set(re.findall(r"[A-Za-z_]\w*", " ".join([*texts, *finding.parameters])))
