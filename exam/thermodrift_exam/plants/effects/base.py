"""The interface of an effect of a plant: physics, or a fault of a recording, that the machine file does not state.

To add one: a class in the file of its group and a line in `plants/effects/__init__.py`; override what it changes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from thermodrift_exam.plants.runs import Now
from thermodrift_exam.plants.structure import Plant, Sensor


@dataclass(frozen=True)
class Answer:
    """The right answer: mechanism (None: unlisted), place, values with units.

    `also` are places that mean the same; `parameters` is the equation's, in the mechanism's own names. `form` describes
    an unlisted effect: the parameter of `free_flux` or `free_shift`, the channel of its level and of the other driver.
    """

    mechanism: str | None
    kind: str
    name: str
    parameters: Mapping[str, tuple[float, str]] = field(default_factory=dict)
    also: tuple[str, ...] = ()
    words: str = ""
    form: tuple[str, ...] = ()


class Effect:
    """An effect in a plant; `size` 1 is about the strength met in practice, 0 no effect."""

    key: ClassVar[str]
    has: ClassVar[frozenset[str]] = frozenset()  # features that the plant must have for it
    withholds: ClassVar[str | None] = None  # the feature that the machine file leaves out
    driver: ClassVar[str | None] = None  # the channel that switches it

    def __init__(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        self.plant, self.size = plant, size
        self.drawn(plant, size, rng)

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        """Draws the free attributes of this effect; a subclass sets them here."""

    def answer(self) -> Answer:
        """The answer: mechanism, place and values."""
        raise NotImplementedError

    def active(self, now: Now) -> NDArray[np.bool_]:
        """Whether it is active, (B,): its driver runs, its gate is open; always, if nothing switches it."""
        return np.ones(len(now.room_degC), bool) if self.driver is None else now.driver(self.driver) != 0

    def add_heat_W(self, heat_W: Array, cells_degC: Array, now: Now) -> None:
        """Adds to the heat into the cells in place; both (N, B)."""

    def friction(self, source: str, cells_degC: Array, now: Now) -> Array | float:
        """Factor of the heat of a source, (B,)."""
        return 1.0

    def displaced_um(self, speed_rpm: Array) -> Mapping[str, Array]:
        """Added to error channels, in the shape of `speed_rpm` (K, B)."""
        return {}

    def sensed(self, sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
        """The sensors with the fault."""
        return sensors

    def ahead_s(self) -> Mapping[str, float]:
        """Advance of the clock of a channel, s."""
        return {}

    def amount(self, feature: str) -> float:
        """Factor of a withheld feature of the plant."""
        return self.size if feature == self.withholds else 1.0

    def misread(self) -> Mapping[str, float]:
        """Parameters of the machine file that are wrong by a factor, by dotted path below `twin`."""
        return {}


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
