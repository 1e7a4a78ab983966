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
        return Answer(self.mechanism, self.kind, self.channel, {"amount": (self.size, "1")}, self.also)


class MotorLoss(_Withheld):
    key = mechanism = withholds = "motor_loss"
    has = frozenset({"motor_loss"})
    driver = "spindle_rpm"
    kind, channel = "node", "motor"


class ColumnBending(_Withheld):
    key = mechanism = "column_bending"
    withholds = "bending"
    has = frozenset({"bending"})
    channel, also = "y", ("z",)


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
