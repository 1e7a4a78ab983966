"""What every machine does every day and a lumped file states as constants: never an answer, always there.

Surfaces exchange more where they are warmer, joints conduct with their pressure, the nut's heat travels along the
screw. To add one: an `Everyday` in a file of its own and a line here.
"""

from __future__ import annotations

from data.registry import Registry
from twin.plants.everyday.base import Everyday
from twin.plants.machine import Plant
from twin.plants.seeds import stream

EVERYDAY = Registry(
    "everyday physics",
    {
        "films": "twin.plants.everyday.films:Films",
        "joints": "twin.plants.everyday.joints:Joints",
        "nut": "twin.plants.everyday.nut:Nut",
    },
)


def everyday(plant: Plant, seed: int) -> list[Everyday]:
    """Everything of `EVERYDAY` that this plant has, its strength drawn from the case's seed."""
    kinds = [EVERYDAY[key] for key in EVERYDAY]
    return [kind(plant, 1.0, stream(seed, f"everyday {kind.key}")) for kind in kinds if kind.fits(plant)]
