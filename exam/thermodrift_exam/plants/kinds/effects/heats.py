"""Heats that the machine file lacks: cabinet, pump, sun, guides, windage, withheld losses, and unlisted ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data.arrays import Array, Mask
from thermodrift_exam.plants.kinds.effects.base import Effect, Seen
from thermodrift_exam.plants.kinds.plant import Dice, KindPlant, Source
from thermodrift_exam.plants.kinds.runs import Now


class Heat(Effect):
    """`watts` times a shape of the drivers into a few cells on one side of a body."""

    watts: float

    def drawn(self, plant: KindPlant, dice: Dice, watts: tuple[float, float] = (40.0, 150.0)) -> None:
        cells = plant.bodies[self.place]
        few = dice.rng.permutation(cells)[: max(1, len(cells) // dice.whole(1, 3))]
        self.share = plant.share(self.place, np.sort(few))
        self.mean = plant.mean(self.place)
        self.watts = dice.span(*watts)
        self.shaped(plant, dice)

    def shaped(self, plant: KindPlant, dice: Dice) -> None:
        """Draws the attributes of its shape."""

    def level(self, cells_degC: Array, now: Now) -> Array:
        """Of the full power, (C,)."""
        raise NotImplementedError

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        at = np.flatnonzero(self.share)
        out[at] += self.share[at, None] * (self.watts * size * self.level(cells_degC, now))


class Cabinet(Heat):
    """Switched on some time before each run: its own metal warms first. A `running` channel may switch it."""

    mechanism = "cabinet_heat"
    words = "waste heat of a cabinet"

    def drawn(
        self, plant: KindPlant, dice: Dice, watts: tuple[float, float] = (40.0, 150.0), running: str | None = None
    ) -> None:
        self.driver = running
        super().drawn(plant, dice, watts)

    def shaped(self, plant: KindPlant, dice: Dice) -> None:
        self.on_since_s, self.warm_s = dice.pick((300.0, 1800.0, 5400.0, 1e6)), dice.span(300.0, 2400.0)

    def level(self, cells_degC: Array, now: Now) -> Array:
        if self.driver is not None:
            return now.drive[self.driver]
        since_s = now.time_s + self.on_since_s
        risen = 1.0 - np.exp(-since_s / self.warm_s) if since_s > 0 else 0.0
        return np.full(cells_degC.shape[1], risen)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"heat": (self.watts * size, "W")}


class Pump(Heat):
    """On and off by a clock of its own, from 3 min to 2 h; its oil rounds the edges."""

    mechanism = "hydraulic_unit"
    words = "a pump that cycles"

    def shaped(self, plant: KindPlant, dice: Dice) -> None:
        longest_min = min(120.0, 20.0 * plant.setting.hours[0])
        self.period_s = 60.0 * dice.span(3.0, longest_min)
        self.duty, self.edge = dice.even(0.2, 0.65), dice.even(0.01, 0.04)
        if self.period_s < 3.0 * plant.setting.row_s:
            self.same_as = (("cabinet_heat", "node", self.place),)
        self.phase = 0.0 if dice.chance(0.6) else dice.even(0.0, 1.0)

    def level(self, cells_degC: Array, now: Now) -> Array:
        turn = (now.time_s / self.period_s + self.phase) % 1.0
        on = 0.5 * (np.tanh(turn / self.edge) - np.tanh((turn - self.duty) / self.edge))
        return np.full(cells_degC.shape[1], on + 0.5 * (1.0 + np.tanh((turn - 1.0) / self.edge)))

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"heat": (self.watts * size, "W"), "duty": (self.duty, "1"), "period": (self.period_s / 60.0, "min")}


class Sun(Heat):
    """Between two hours of the day, flatter than a half sine: through a window."""

    mechanism = "sun"
    words = "sunlight on one side"

    def shaped(self, plant: KindPlant, dice: Dice) -> None:
        self.rise_h, self.set_h, self.flat = dice.even(7.0, 9.5), dice.even(13.0, 17.0), dice.even(0.5, 1.4)

    def _up(self, now: Now) -> Array:
        return (now.clock_h - self.rise_h) / (self.set_h - self.rise_h)

    def active(self, now: Now) -> Mask:
        up = self._up(now)
        return np.asarray((up > 0) & (up < 1))

    def level(self, cells_degC: Array, now: Now) -> Array:
        return np.sin(np.pi * np.clip(self._up(now), 0.0, 1.0)) ** self.flat

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"power": (self.watts * size, "W"), "rise": (self.rise_h, "h"), "set": (self.set_h, "h")}


class ByDriver(Heat):
    """By a driver's size to a power: guides, belts, seals, windage, heaters, conductors."""

    def drawn(
        self, plant: KindPlant, dice: Dice, watts: tuple[float, float] = (40.0, 150.0), driver: str = "",
        mechanism: str = "", exponent: tuple[float, float] = (1.0, 1.0), words: str = "", stribeck: float = 0.0,
        same_as: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self.driver, self.mechanism, self.words = driver, mechanism, words
        self.exponent, self.stribeck = dice.even(*exponent), stribeck * dice.even(0.3, 1.0)
        self.top = plant.drivers[driver].high
        self.same_as = tuple((m, "node", self.place) for m in same_as)
        super().drawn(plant, dice, watts)

    def level(self, cells_degC: Array, now: Now) -> Array:
        x = np.abs(now.drive[str(self.driver)]) / self.top
        return x**self.exponent * (1.0 + self.stribeck * np.exp(-8.0 * x)) * (x > 0)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        watts = self.watts * size
        known = {
            "belt_loss": {"power": (watts, "W"), "exponent": (self.exponent, "1"), "rated": (self.top, "rpm")},
            "guide_friction": {"friction": (watts * 60e3 / self.top / 5000.0, "1"), "load": (5000.0, "N")},
            "electrical_heat": {"gain": (watts / self.top, "W")},
            "ohmic_heat": {"resistance": (watts / self.top**2, "ohm")},
        }
        return known.get(str(self.mechanism), {})


class Withheld(Effect):
    """A heat of every plant of this kind that the machine file leaves out."""

    def drawn(self, plant: KindPlant, dice: Dice, source: str = "", mechanism: str = "", driver: str = "") -> None:
        self.source: Source = plant.sources[source]
        self.mechanism, self.driver = mechanism, driver
        self.withholds = frozenset({source})
        self.words = f"the machine file leaves out {source}"

    def heat_W(self, out: Array, cells_degC: Array, now: Now, size: Array) -> None:
        out += np.multiply.outer(self.source.share, size * self.source.power_W(now.drive))

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        for stated in self.source.stated.values():
            scaled = {k: (size * v, unit) for k, (v, unit) in stated.free.items() if unit in ("W", "ohm")}
            numbers = {k: str(v).partition(" ") for k, v in stated.fixed.items()}
            return scaled | {k: (float(n), u or "1") for k, (n, _, u) in numbers.items() if k == "rated"}
        return {}


class Product(Heat):
    """Unlisted: a driver times the body's excess over a temperature, saturating far above it."""

    mechanism = None

    def drawn(
        self, plant: KindPlant, dice: Dice, watts: tuple[float, float] = (40.0, 150.0), driver: str = "",
        signed: bool = False,
    ) -> None:  # fmt: skip
        self.driver, self.top, self.above_degC = driver, plant.drivers[driver].high, dice.even(16.0, 22.0)
        self.signed = signed
        self.form = ("product", driver)
        self.words = f"power by {driver} times the excess of {self.place} over {self.above_degC:.0f} degC"
        super().drawn(plant, dice, watts)

    def level(self, cells_degC: Array, now: Now) -> Array:
        excess_K = self.mean @ cells_degC - self.above_degC
        x = now.drive[str(self.driver)] / self.top
        return (x if self.signed else np.abs(x)) * excess_K / (10.0 + 0.2 * np.abs(excess_K))

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"power": (self.watts * size, "W")}


class Cross(Heat):
    """Unlisted: the product of two drivers."""

    mechanism = None

    def drawn(
        self, plant: KindPlant, dice: Dice, watts: tuple[float, float] = (40.0, 150.0), driver: str = "",
        other: str = "", exponent: tuple[float, float] = (0.9, 1.2),
    ) -> None:  # fmt: skip
        self.driver, self.other, self.exponent = driver, other, dice.even(*exponent)
        self.tops = plant.drivers[driver].high, plant.drivers[other].high
        self.form = ("square_cross" if self.exponent > 1.5 else "cross", driver, other)
        self.words = f"power by {driver} times {other}"
        super().drawn(plant, dice, watts)

    def active(self, now: Now) -> Mask:
        return np.asarray((now.drive[str(self.driver)] != 0) & (now.drive[self.other] != 0))

    def level(self, cells_degC: Array, now: Now) -> Array:
        one, other = np.abs(now.drive[str(self.driver)]) / self.tops[0], np.abs(now.drive[self.other]) / self.tops[1]
        return one**self.exponent * other

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"power": (self.watts * size, "W")}


class Plateau(Effect):
    """Unlisted: a body that takes up a latent heat about one temperature, as a grease or wax that melts."""

    mechanism = None
    largest = 12.0

    needs_clean = True

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        self.cells, self.wide_K, self.latent_K = plant.bodies[self.place], dice.even(0.8, 2.0), dice.span(4.0, 15.0)
        self.level, self.watch = dice.even(0.55, 0.85), {"body": plant.mean(self.place)}

    def prepare(self, seen: Seen, wanted_K: float) -> None:
        """At a temperature that the body passes in many runs."""
        self.at_degC = float(np.quantile(seen.watched["body"][seen.zero :], self.level))
        self.words = f"{self.place} takes up a latent heat about {self.at_degC:.0f} degC"

    def slowness(self, cells_degC: Array, size: Array) -> Array | None:
        out = np.ones_like(cells_degC)
        x = (cells_degC[self.cells] - self.at_degC) / self.wide_K
        out[self.cells] += size * self.latent_K / self.wide_K / (2.0 * np.cosh(np.clip(x, -30, 30)) ** 2)
        return out

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"latent": (size * self.latent_K, "K"), "temperature": (self.at_degC, "degC")}


class WrongCapacity(Effect):
    """No physics is missing; the capacity of one body exceeds that of the file, far beyond its prior."""

    mechanism = "wrong_parameter"
    words = "a heat capacity is stated wrong"
    largest = 5.0

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        self.cells, self.least = plant.bodies[self.place], float(np.expm1(4.0 * plant.setting.mass_error))

    def slowness(self, cells_degC: Array, size: Array) -> Array | None:
        out = np.ones_like(cells_degC)
        out[self.cells] += size
        return out

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"factor": (1.0 + size, "1")}


class WrongHeat(Effect):
    """No physics is missing; one heat is larger than in the file, far beyond its prior."""

    mechanism = "wrong_parameter"
    words = "a heat is stated wrong"
    largest = 5.0

    def drawn(self, plant: KindPlant, dice: Dice, source: str = "") -> None:
        self.source, self.least = source, float(np.expm1(3.0 * plant.setting.file_error))
        own = [b for b, c in plant.bodies.items() if plant.sources[source].share[c].sum() > 0.02]
        self.also = (*plant.sources[source].stated, *(b for b in own if b != self.place))

    def factor(self, source: str, cells_degC: Array, now: Now, size: Array) -> Array | None:
        return 1.0 + size if source == self.source else None

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"factor": (1.0 + size, "1")}
