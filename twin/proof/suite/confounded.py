"""Pairs that a case's recordings cannot tell apart: what makes them alike, and what else the truth might be.

A new one is a line in `PAIRS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from twin.plants.effects import EFFECTS

Same = tuple[str, tuple[str, ...]]  # a place's name ("" means the effect's own), mechanisms


@dataclass(frozen=True)
class Pair:
    """`one` and `other` are effects whose signatures agree where the shop has this `habit`, the machine file states
    `stated` and not `unstated`.

    `truths` of them may be what a case lacks; `rivals` are mechanisms that mean the same at the truth's own place, or
    at the place given.
    """

    one: str
    other: str
    rivals: Mapping[str, tuple[str, ...]]  # by true effect
    habit: str = "ordinary"
    stated: frozenset[str] = frozenset()
    unstated: frozenset[str] = frozenset()

    @property
    def truths(self) -> tuple[str, ...]:
        return tuple(self.rivals)

    def holds(self, options: Mapping[str, Any]) -> bool:
        """Whether a case of these options has the pair."""
        stated = set(options["has"])
        return options["habit"] == self.habit and self.stated <= stated and not self.unstated & stated

    def imposed(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """The options, made so that it holds."""
        has = sorted((set(options["has"]) | self.stated) - self.unstated)
        lacks = sorted((set(options["lacks"]) | self.unstated) - self.stated)
        return {**options, "habit": self.habit, "has": has, "lacks": lacks}


PAIRS: Mapping[str, Pair] = MappingProxyType({
    "nose": Pair(
        "spindle_growth", "mandrel",
        {"spindle_growth": ("mandrel_fixture",), "mandrel": ("spindle_growth",)},
        unstated=frozenset({"growth", "mandrel"}),
    ),
    "one_speed": Pair(
        "motor_loss", "belt_loss",
        {"motor_loss": ("belt_loss", "bearing_viscous", "bearing_load")},
        habit="one_speed", unstated=frozenset({"motor_loss"}),
    ),
    "pump": Pair(
        "pump_heat", "cabinet_heat",
        {"pump_heat": ("hydraulic_unit",), "cabinet_heat": ("hydraulic_unit",)},
        habit="coolant_always", stated=frozenset({"coolant"}),
    ),
    "feed": Pair(
        "guide_friction", "nut_friction",
        {"guide_friction": ("nut_friction", "screw_bearing")},
        stated=frozenset({"feed"}),
    ),
})  # fmt: skip


def rivals_of(effect: str, options: Mapping[str, Any]) -> list[str]:
    """Mechanisms that mean the same as an effect where these options hold, sorted."""
    return sorted({m for pair in PAIRS.values() if pair.holds(options) for m in pair.rivals.get(effect, ())})


def ambiguous(options: Mapping[str, Any]) -> set[str]:
    """Effects that these options make alike to another."""
    return {e for pair in PAIRS.values() if pair.holds(options) for e in pair.truths if e in EFFECTS}
