"""A plant: the structure with its heat sources, what moves the tool and where the sensors sit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from twin.plants.casting import Array, Cells
from twin.plants.growth import Growth
from twin.plants.structure import Structure

FEATURES = ("feed", "coolant", "walls", "layers", "motor_loss", "bending", "growth", "mandrel")
Law = Literal["viscous", "load", "motor"]


@dataclass(frozen=True)
class Source:
    """Heat of the spindle: `watts` at the rated speed by law (viscous, load: one; motor: idle, linear, quadratic).

    `share` (N,) says into which cells it goes and adds up to 1; `film` and `housing` are the cells whose temperatures
    a bearing's lubricant and its outer ring have; `shaft` the inner ring's.
    """

    law: Law
    watts: tuple[float, ...]
    share: Array
    amount: float = 1.0
    shaft: Cells | None = None
    housing: Cells | None = None


@dataclass(frozen=True)
class Sensor:
    """A temperature channel: its cell, how late and how wrong it shows it."""

    channel: str
    body: str
    cell: int
    lag_s: float
    offset_K: float
    drift_K_per_h: float = 0.0


@dataclass(frozen=True)
class Plant:
    """A whole machine; `features` are those of `FEATURES` that it has."""

    structure: Structure
    rated_rpm: float
    sources: Mapping[str, Source]
    growths: tuple[Growth, ...]
    sensors: tuple[Sensor, ...]
    features: frozenset[str]

    def cells(self, body: str) -> Cells:
        return self.structure.bodies[body]

    def body_like(self, *wanted: str) -> str:
        """The first of these bodies that this plant has."""
        return next(b for b in wanted if b in self.structure.bodies)
