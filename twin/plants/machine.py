"""A plant: the structure with its heat sources, what moves the tool and where the sensors sit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from twin.plants.casting import Array
from twin.plants.growth import Growth
from twin.plants.structure import Part, Structure

FEATURES = ("feed", "coolant", "walls", "layers", "motor_loss", "bending", "growth", "mandrel")
Law = Literal["viscous", "load", "motor"]


@dataclass(frozen=True)
class Source:
    """Heat of the spindle: `watts` at the rated speed by law (viscous, load: one; motor: idle, linear, quadratic).

    `share` (N,) says into which nodes it goes and adds up to 1; `shaft` and `housing` are where a bearing's inner and
    outer ring sit.
    """

    law: Law
    watts: tuple[float, ...]
    share: Array
    amount: float = 1.0
    shaft: Part | None = None
    housing: Part | None = None


@dataclass(frozen=True)
class Sensor:
    """A temperature channel: its node, how late and how wrong it shows it."""

    channel: str
    body: str
    cell: int
    lag_s: float
    offset_K: float
    drift_K_per_h: float = 0.0


@dataclass(frozen=True)
class Layout:
    """What a kind of plant draws of a machine: its castings, cut up, and what their rises do to the tool."""

    structure: Structure
    growths: tuple[Growth, ...]


@dataclass(frozen=True)
class Plant:
    """A whole machine; `features` are those of `FEATURES` that it has."""

    structure: Structure
    rated_rpm: float
    sources: Mapping[str, Source]
    growths: tuple[Growth, ...]
    sensors: tuple[Sensor, ...]
    features: frozenset[str]

    def part(self, body: str) -> Part:
        return self.structure.bodies[body]

    def body_like(self, *wanted: str) -> str:
        """The first of these bodies that this plant has."""
        return next(b for b in wanted if b in self.structure.bodies)
