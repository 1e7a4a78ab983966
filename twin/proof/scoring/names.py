"""Names that mean the same mechanism: laws whose equations agree but for a constant, and what stands for unlisted."""

from __future__ import annotations

from collections.abc import Mapping

UNLISTED = "unlisted"

# Left: as a finding may say; right: what it counts as. No recording could tell the left from the right.
SAME: Mapping[str, str] = {
    "free_flux": UNLISTED,  # the regression that stands in for physics of no listed mechanism
    "free_shift": UNLISTED,
    "screw_bearing": "nut_friction",  # both 2 pi N M / 60; the place says which part of the drive it is
}


def counted_as(mechanism: str | None) -> str:
    """The one name of a mechanism; None is what no list has."""
    return UNLISTED if mechanism is None else SAME.get(mechanism, mechanism)
