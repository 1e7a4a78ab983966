"""Physics that is never an answer: the machine file states it as a constant or by a simple law."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from twin.plants.effects.base import Effect
from twin.plants.machine import Plant


@dataclass(frozen=True)
class Stated:
    """An entry of the machine file's mechanisms: `free` values with units are guessed by the engineer."""

    name: str
    law: str
    drivers: str
    into: str
    free: Mapping[str, tuple[float, str]]
    fixed: Mapping[str, str] = field(default_factory=dict)


class Everyday(Effect):
    """Works as an effect does, at size 1."""

    @classmethod
    def fits(cls, plant: Plant) -> bool:
        """Whether this plant has it."""
        return True

    def stated(self) -> Stated | None:
        """What the machine file says of it beside the constants of links and exposures."""
        return None
