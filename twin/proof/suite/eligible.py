"""Which effects a case may have: those that its plant can show and that its machine file does not state."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from twin.plants.effects import EFFECTS

FAULTS = ("sensor_drift", "sensor_lag", "sensor_swap", "time_skew", "wrong_parameter")
IDLE = "idle"  # a decoy that is no term: recorded switches that drive nothing
UNLISTED = tuple(key for key in EFFECTS if key.startswith("unlisted"))
AMBIGUOUS = ("guide_friction",)  # another mechanism has the same equation: only where the kind is "confounded"


def possible(key: str, options: Mapping[str, Any]) -> bool:
    """Whether the plant of these options can have the effect: `has` are the features that its file states."""
    kind, stated = EFFECTS[key], set(options["has"])
    if kind.withholds:
        return kind.withholds not in stated and kind.has - {kind.withholds} <= stated
    return kind.has <= stated


def effects(options: Mapping[str, Any], without: Collection[str] = ()) -> list[str]:
    """Listed physics that a case may have, sorted."""
    others = {*FAULTS, *UNLISTED, *AMBIGUOUS, *without}
    return sorted(key for key in EFFECTS if key not in others and possible(key, options))


def decoys(options: Mapping[str, Any]) -> list[str]:
    """Faults of a recording or of the file; `IDLE` where there are switches that drive nothing."""
    return sorted([*FAULTS, *([IDLE] if options["idle"] else [])])


def unlisted(options: Mapping[str, Any]) -> list[str]:
    """What no list of mechanisms has, sorted."""
    return sorted(key for key in UNLISTED if possible(key, options))
