"""Refits of a law at its other seats, where the screen saw it at one value of a shape that a refit must find.

A test bar may stand on the shaft, the nose or a bearing's ring. How late it follows tells them apart, and that is its
shape: in the screen every one is as late as the usual one, and the likeliest there need not be the likeliest fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from twin.diagnosis.rounds.refits import Tried
from twin.diagnosis.rounds.shortlist import WORTH
from twin.diagnosis.scoring.screen import Scored

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
