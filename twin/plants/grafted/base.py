"""What a graft is: a known effect that real recordings are given; the room, speeds and all else in them are real.

To add one: a class in the file of its group and a line in `twin/plants/grafted/grafts.py`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from data.batch import Batch
from data.machine import Machine
from twin.plants.grafted.told import Array

FINE_K = 0.1  # a sensor of coarser steps shows no graft


@dataclass(frozen=True)
class Setting:
    """The machine, its real runs on their finest grid, and the frame's generator."""

    machine: Machine
    batches: Sequence[Batch]
    seed: int

    @property
    def twin(self) -> Mapping[str, Any]:
        return self.machine.twin or {}

    def sensors(self) -> list[str]:
        """Temperatures of fine steps that nearly every run has throughout."""
        return [
            n
            for n in self.machine.names("temperature")
            if (self.machine.channels[n].resolution or 0.0) <= FINE_K
            and all(np.isfinite(b.values(n)).mean() > 0.95 for b in self.batches)
        ]


class Graft:
    """An effect in real recordings; `size` 1 is about as strong as engineers meet it."""

    key: ClassVar[str]

    def __init__(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        self.setting, self.size = setting, size

    def term(self) -> dict[str, Any]:
        """Its term in the answer key."""
        raise NotImplementedError

    def shown(self, number: int, batch: Batch) -> Mapping[str, Array]:
        """Channels of the run of this number anew, each (rows,), before the instrument rounds them."""
        raise NotImplementedError

    def mapping(self) -> dict[str, str]:
        """Which part of the simulated response went on which real channel."""
        return {}
