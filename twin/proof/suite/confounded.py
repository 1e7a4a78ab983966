"""Pairs that a case's recordings cannot tell apart: what makes them alike, and what else the truth might be.

A new one is a line in `PAIRS`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

ALWAYS: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "cabinet_heat": ("hydraulic_unit",), "pump_heat": ("electrical_heat", "hydraulic_unit"),
    "guide_friction": ("nut_friction", "screw_bearing"),
})  # fmt: skip
"""By effect the mechanisms that are the same equation under another name, in every recording."""


@dataclass(frozen=True)
class Pair:
    """`rivals` are, by what a case may lack, the mechanisms that mean the same at its place where the shop has this
    `habit` (None: any) and the machine file states `stated` and not `unstated`.
    """

    rivals: Mapping[str, tuple[str, ...]]
    habit: str | None = None
    stated: frozenset[str] = frozenset()
    unstated: frozenset[str] = frozenset()

    @property
    def truths(self) -> tuple[str, ...]:
        return tuple(self.rivals)

    def holds(self, options: Mapping[str, Any]) -> bool:
        """Whether a case of these options has the pair."""
        stated = set(options["has"])
        habit = self.habit in (None, options["habit"])
        return habit and self.stated <= stated and not self.unstated & stated

    def imposed(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """The options, made so that it holds."""
        has = sorted((set(options["has"]) | self.stated) - self.unstated)
        lacks = sorted((set(options["lacks"]) | self.unstated) - self.stated)
        return {**options, "habit": self.habit or options["habit"], "has": has, "lacks": lacks}


PAIRS: Mapping[str, Pair] = MappingProxyType({
    "nose": Pair(
        {"spindle_growth": ("mandrel_fixture",), "mandrel": ("spindle_growth",)},
        habit="long_runs", unstated=frozenset({"growth", "mandrel"}),
    ),
    "one_speed": Pair(
        {"motor_loss": ("belt_loss", "bearing_viscous", "bearing_load")},
        habit="one_speed", unstated=frozenset({"motor_loss"}),
    ),
    "pump": Pair(
        {"pump_heat": ("electrical_heat", "hydraulic_unit"), "cabinet_heat": ("electrical_heat", "hydraulic_unit")},
        habit="coolant_always", stated=frozenset({"coolant"}),
    ),
    "walls": Pair({"radiation": ("natural_convection",)}, habit="walls_as_room", stated=frozenset({"walls"})),
    "feed": Pair({"guide_friction": ("nut_friction", "screw_bearing")}, stated=frozenset({"feed"})),
})  # fmt: skip


def rivals_of(effect: str, options: Mapping[str, Any]) -> list[str]:
    """Mechanisms that mean the same as an effect where these options hold, sorted."""
    here = [pair.rivals.get(effect, ()) for pair in PAIRS.values() if pair.holds(options)]
    return sorted({*ALWAYS.get(effect, ()), *(mechanism for rivals in here for mechanism in rivals)})


def ambiguous(options: Mapping[str, Any]) -> set[str]:
    """Effects that these options make alike to another."""
    return {effect for pair in PAIRS.values() if pair.holds(options) for effect in pair.truths}
