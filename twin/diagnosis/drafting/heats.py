"""What a driver's heat may be: one law by the driver's unit, its size at the driver's top."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.machine import Machine

Array = NDArray[np.float64]

HELD_W = 300.0  # the one heat that is held: some kilowatts of spindle lose a few hundred watts at their highest speed
SPREAD = 1.0  # of a heat's logarithm
EXPONENT, EXPONENT_SPREAD = 1.5, 0.3  # friction and windage grow with speed as n^1 to n^2.5
GUIDE_FRICTION = 0.1


@dataclass(frozen=True)
class Driven:
    """A driver whose heat the draft can state: its law, how heat grows with it (`exponent`), its largest size."""

    name: str  # of the mechanism
    driver: str
    unit: str
    law: str
    exponent: float
    top: float

    def share(self, level: Array) -> Array:
        """The heat over that at the top, for levels of any shape."""
        size = np.maximum(level, 0.0) if self.law in ("electrical_heat", "cutting_heat") else np.abs(level)
        return np.asarray((size / self.top) ** self.exponent)

    @property
    def scalable(self) -> bool:
        """Whether its heat can be held at any round value."""
        return self.law != "cutting_heat"

    def parameters(self, heat_W: float, held: bool) -> dict[str, Any]:
        """The law's parameters with this heat at the driver's top, held or with a prior."""

        def free(value: float, unit: str) -> Any:
            text = f"{value:.4g} {unit}"
            return text if held else {"value": text, "spread": SPREAD}

        top = f"{self.top:.6g}"
        if self.law == "belt_loss":
            exponent = {"value": EXPONENT, "spread": EXPONENT_SPREAD}
            return {"power": free(heat_W, "W"), "exponent": exponent, "rated": f"{top} rpm"}
        if self.law == "guide_friction":
            load_N = float(np.clip(heat_W / (GUIDE_FRICTION * self.top / 60e3), 2.0, 9e5))
            return {"friction": GUIDE_FRICTION, "load": free(load_N, "N")}
        if self.law == "ohmic_heat":
            return {"resistance": free(heat_W / self.top**2, "ohm")}
        if self.law == "cutting_heat":
            return {"share": {"value": float(f"{np.clip(heat_W / self.top, 0.01, 0.9):.3g}"), "spread": SPREAD}}
        return {"gain": free(heat_W / self.top, "W")}


LAWS: Mapping[str, tuple[str, float]] = {
    "rpm": ("belt_loss", EXPONENT),
    "mm/min": ("guide_friction", 1.0),
    "A": ("ohmic_heat", 2.0),
    "W": ("cutting_heat", 1.0),
    "1": ("electrical_heat", 1.0),
    "%": ("electrical_heat", 1.0),
}


def driven(machine: Machine, tops: Mapping[str, float]) -> tuple[list[Driven], list[str]]:
    """The drivers that some law takes, and words on those that none does."""
    out, words = [], []
    for driver, name in zip(tops, plain_names([f"heat_of_{d}" for d in tops]), strict=True):
        unit = machine.channels[driver].unit
        if unit in LAWS:
            out.append(Driven(name, driver, unit, *LAWS[unit], tops[driver]))
        else:
            words.append(f"driver {driver} is in {unit}, which no drafted heat grows with: it warms nothing there")
    return out, words


def plain_names(channels: Sequence[str], taken: Sequence[str] = ()) -> tuple[str, ...]:
    """Names that a machine file allows, after channels: letters, digits, underscores, each its own and none taken."""
    out: list[str] = []
    for channel in channels:
        plain = "".join(c if c.isalnum() and c.isascii() else "_" for c in channel)
        plain = plain if plain[:1].isalpha() else f"at_{plain}"
        while plain in (*out, *taken):
            plain += "_2"
        out.append(plain)
    return tuple(out)
