"""What every machine of this kind has and the machine file does not say."""

from __future__ import annotations

from typing import ClassVar

from twin.plants.effects.base import Answer, Effect


class _Withheld(Effect):
    """Physics of every machine of this kind that the machine file leaves out."""

    mechanism: ClassVar[str]
    channel: ClassVar[str]
    also: ClassVar[tuple[str, ...]] = ()
    kind: ClassVar[str] = "error"

    def answer(self) -> Answer:
        return Answer(self.mechanism, self.kind, self.channel, self.values(), self.also)

    def values(self) -> dict[str, tuple[float, str]]:
        """Of the mechanism's parameters those that the plant has as one number; of a path its gain."""
        own = [g for g in self.plant.growths if g.name == self.withholds and g.channel == self.channel]
        return {"gain": (self.size * float(sum(g.weights_um_per_K.sum() for g in own)), "um/K")}


class MotorLoss(_Withheld):
    key = mechanism = withholds = "motor_loss"
    has = frozenset({"motor_loss"})
    driver = "spindle_rpm"
    kind, channel = "node", "motor"

    def values(self) -> dict[str, tuple[float, str]]:
        watts = zip(("idle", "linear", "quadratic"), self.plant.sources["motor_loss"].watts, strict=True)
        return {**{k: (self.size * w, "W") for k, w in watts}, "rated": (self.plant.rated_rpm, "rpm")}


class ColumnBending(_Withheld):
    key = mechanism = "column_bending"
    withholds = "bending"
    has = frozenset({"bending"})
    channel, also = "y", ("z",)

    def values(self) -> dict[str, tuple[float, str]]:
        return {}  # between which bodies, and so per kelvin of what, the twin chooses


class SpindleGrowth(_Withheld):
    key = mechanism = "spindle_growth"
    withholds = "growth"
    has = frozenset({"growth"})
    channel = "z"


class Mandrel(_Withheld):
    key, mechanism = "mandrel", "mandrel_fixture"
    withholds = "mandrel"
    has = frozenset({"mandrel"})
    channel = "z"
