"""The interface of an effect of a kind: physics, or a fault of a recording, that the machine file does not state.

Its strength is a size of 0 or more: 0 is nothing, 1 a usual one. Sizes reach the heat balance as one number a column
(C,), since several variants of a case are integrated at once, and everything else as a number.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.signal import lfilter

from data.arrays import Array, Mask
from thermodrift_exam.plants.kinds.plant import Dice, KindPlant
from thermodrift_exam.plants.kinds.runs import Now

Places = tuple[str | dict[str, str], ...]


@dataclass(frozen=True)
class Seen:
    """One simulated variant of a case: time_s (M,) from the runs' starts, everything else (M, B).

    `temps_degC` are the sensors' readings, `watched` the quantities that the effect requests.
    """

    time_s: Array
    temps_degC: Mapping[str, Array]
    watched: Mapping[str, Array]
    air_degC: Mapping[str, Array]
    drive: Mapping[str, Array]
    zero: int  # the row of the start

    def smoothed(self, values: Array, lag_s: float) -> Array:
        """Through a first-order lag that starts settled, (M, B)."""
        return lagged(values, float(self.time_s[1] - self.time_s[0]), lag_s)


def lagged(values: Array, step_s: float, lag_s: float) -> Array:
    """A first-order lag that starts settled, exact for values that are straight between steps; (M, B)."""
    ratio = step_s / max(lag_s, 1e-3 * step_s)
    keep = float(np.exp(-ratio))
    mean = (1.0 - keep) / ratio
    settled = mean * values[:1]
    return np.asarray(lfilter([1.0 - mean, mean - keep], [1.0, -keep], values, axis=0, zi=settled)[0])


class Effect:
    """A subclass draws its free attributes in `drawn` and overrides the methods of its action."""

    mechanism: str | None
    kind: str = "node"
    place: str
    also: Places = ()
    words: str = ""
    form: tuple[str, ...] = ()
    driver: str | None = None  # the channel that switches it
    same_as: tuple[
        tuple[str, str, str], ...
    ] = ()  # mechanism, kind, name that the recordings may not distinguish from it
    least: float = 0.0  # size
    largest: float = 1e3
    withholds: frozenset[str] = frozenset()  # sources and growths of the plant that the file leaves out
    watch: Mapping[str, Array]  # rows (N,) of the cells that it must see

    needs_clean: ClassVar[bool] = False  # whether `prepare` must be called

    def __init__(self, key: str, plant: KindPlant, dice: Dice, place: str, **options: Any) -> None:
        self.key, self.plant, self.place = key, plant, place
        self.watch = {}
        self.drawn(plant, dice, **options)

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        """Draws the free attributes of this effect."""

    def prepare(self, seen: Seen, wanted_K: float) -> None:
        """Sets quantities that depend on the machine without the effect, for a visible response of `wanted_K`."""

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        """Values in the names and units of the mechanism, approximated where the formulas differ."""
        return {}

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        """Adds heat into the cells (N, C) in place."""

    def factor(self, source: str, cells_degC: Array, now: Now, size: Array) -> Array | None:
        """Factor of the heat of a source, (C,)."""
        return None

    def slowness(self, cells_degC: Array, size: Array) -> Array | None:
        """Capacities as multiples of the solid's, (N, C)."""
        return None

    def reads(self, seen: Seen, size: float) -> Mapping[str, Array]:
        """Readings of sensors that are wrong, by channel, (M, B)."""
        return {}

    def displaced(self, seen: Seen, size: float) -> Mapping[str, Array]:
        """Added to error channels, (M, B)."""
        return {}

    def ahead_s(self, size: float) -> Mapping[str, float]:
        """Advance of the clock of a channel, s."""
        return {}

    def active(self, now: Now) -> Mask:
        """Whether it is active at a moment, (C,): its driver runs, its gate is open."""
        anything = next(iter(now.air_degC.values()))
        if self.driver is None:
            return np.ones(anything.shape, bool)
        return np.asarray(now.drive[self.driver] != 0)
