"""Whether a place that is named is the true one, one that means the same, or one beside it."""

from __future__ import annotations

from collections.abc import Mapping

from twin.proof.scoring.answer_key import Spot, TrueTerm


def exact(named: Spot, term: TrueTerm) -> bool:
    """The term's own place or one of `also`. A link is the same whichever end its name begins with."""
    return any(same_place(named, place) for place in (term.where, *term.also))


def near(named: Spot, term: TrueTerm, body_of: Mapping[str, str]) -> bool:
    """Exact, or beside it: a touching body, a link that ends at the true place, an end of the true link.

    A sensor stands for its body (`body_of`). Error channels and other sensors' faults have no neighbours.
    """
    if exact(named, term):
        return True
    ends = {end for place in (term.where, *term.also) for end in _ends(place, body_of)}
    own = _ends(named, body_of)
    touching = set(term.neighbours) if named.kind != "link" else set()
    return bool(own & (ends | touching))


def same_place(one: Spot, other: Spot) -> bool:
    """Of one name and, where both are told, of one kind."""
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
