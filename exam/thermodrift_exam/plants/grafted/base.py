"""The interface of a graft: a known effect superposed on real recordings; everything else in them is real.

To add one: a class in the file of its group and a line in `GRAFTS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from data.machine import Machine
from data.registry import Registry
from thermodrift_exam.plants.real import Term

FACTORS = {
    "J/K": 1.0, "kJ/K": 1e3, "W/K": 1.0, "mW/K": 1e-3, "kW/K": 1e3, "um/K": 1.0, "K": 1.0, "1": 1.0, "": 1.0,
}  # fmt: skip
ROOM = "room"


def magnitude(entry: Any, where: str) -> float:
    """The value that "537 kJ/K", 0.94 or {value: …} stands for, in J/K, W/K, um/K, K or 1.

    Raises:
        InputError: no number, or a unit that is none of these.
    """
    given = entry["value"] if isinstance(entry, Mapping) else entry
    number, _, unit = str(given).strip().partition(" ")
    if unit.strip() not in FACTORS:
        raise InputError(f"grafted: {where}: unit {unit!r} is not known here; {closest(unit, FACTORS)}")
    try:
        return float(number) * FACTORS[unit.strip()]
    except ValueError:
        raise InputError(f"grafted: {where}: got {given!r}, expected a number with a unit such as '14 W/K'") from None


def ends(key: str) -> tuple[str, str]:
    """Both places of a link or exposure by its name: ``"bed-room"``."""
    one, _, other = key.partition("-")
    return one, other


def room_degC(twin: Mapping[str, Any], batch: Batch) -> Array:
    """The room's air as the twin part takes it: its channel and its offset, (rows,)."""
    room = twin["surroundings"][ROOM]
    offset_K = magnitude(room["offset"], "surroundings.room.offset") if "offset" in room else 0.0
    return np.asarray(batch.values(room["channel"]) + offset_K)


FINE_K = 0.1  # a coarser sensor does not resolve a graft


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
    """An effect in real recordings; `size` 1 is about the strength met in practice."""

    key: ClassVar[str]

    def __init__(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        self.setting, self.size = setting, size
        self.drawn(setting, size, rng)

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        """Draws the free attributes of this effect; a subclass sets them here."""

    def term(self) -> Term:
        """Its term in the answer key."""
        raise NotImplementedError

    def shown(self, number: int, batch: Batch) -> Mapping[str, Array]:
        """Changed channels of the run of this number, each (rows,), before the instrument rounds them."""
        raise NotImplementedError

    def mapping(self) -> dict[str, str]:
        """Part of the simulated response added to each real channel."""
        return {}


GRAFTS = Registry(
    "graft",
    {
        "cabinet_heat": "thermodrift_exam.plants.grafted.heats:CabinetHeat",
        "hydraulic_unit": "thermodrift_exam.plants.grafted.heats:HydraulicUnit",
        "floor_sink": "thermodrift_exam.plants.grafted.heats:FloorSink",
        "sun": "thermodrift_exam.plants.grafted.heats:Sun",
        "belt_loss": "thermodrift_exam.plants.grafted.heats:BeltLoss",
        "draught": "thermodrift_exam.plants.grafted.heats:Draught",
        "unlisted_warm_speed": "thermodrift_exam.plants.grafted.heats:UnlistedWarmSpeed",
        "speed_shift": "thermodrift_exam.plants.grafted.faults:SpeedShift",
        "time_skew": "thermodrift_exam.plants.grafted.faults:TimeSkew",
        "sensor_drift": "thermodrift_exam.plants.grafted.faults:SensorDrift",
        "sensor_lag": "thermodrift_exam.plants.grafted.faults:SensorLag",
        "sensor_bonding": "thermodrift_exam.plants.grafted.faults:SensorBonding",
        "sensor_swap": "thermodrift_exam.plants.grafted.faults:SensorSwap",
    },
)
