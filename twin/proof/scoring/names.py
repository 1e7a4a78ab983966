"""Names that mean the same mechanism: what stands for unlisted, and laws whose equations agree but for a constant.

No recording of any kind could tell the members of a group apart, so a finding may use any of them. Where telling names
apart is the question itself, in confounded cases, the reported set must hold the key's own name.
"""

from __future__ import annotations

from twin.proof.scoring.answer_key import TrueTerm

UNLISTED = "unlisted"
FREE = ("free_flux", "free_shift")  # the regressions that stand in for physics of no listed mechanism
SAME = (
    frozenset({"guide_friction", "nut_friction", "screw_bearing"}),  # heat in proportion to the feed
)
SAME_IF_SWITCHED = (
    frozenset({"cabinet_heat", "electrical_heat"}),  # constant heat while one channel is 1
)


def counted_as(mechanism: str | None) -> str:
    """The mechanism's own name; None, and what stands for it, is what no list has."""
    return UNLISTED if mechanism is None or mechanism in FREE else mechanism


def means(named: str | None, term: TrueTerm) -> bool:
    """Whether a name that is told means the term's mechanism."""
    pair = {counted_as(named), counted_as(term.mechanism)}
    groups = SAME + (SAME_IF_SWITCHED if term.driver else ())
    return len(pair) == 1 or any(pair <= group for group in groups)
