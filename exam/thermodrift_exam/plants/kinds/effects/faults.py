"""Effects on recordings alone: displacements that the file lacks, faults of sensors and of clocks."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.kinds.effects.base import Effect, Seen
from thermodrift_exam.plants.kinds.plant import Dice, KindPlant


class Path(Effect):
    """A growth or bending that the file leaves out of an error; slightly curved, as joints are."""

    kind = "error"

    def drawn(self, plant: KindPlant, dice: Dice, growth: str = "", mechanism: str = "") -> None:
        self.growth = plant.growths[growth]
        self.place, self.mechanism, self.withholds = self.growth.channel, mechanism, frozenset({growth})
        self.words = f"the machine file leaves out {growth}"
        self.watch, self.curve = {"path": self.growth.weights_um_per_K}, dice.even(-0.15, 0.15)
        others = [g.channel for n, g in plant.growths.items() if n.split("@")[0] == growth.split("@")[0]]
        self.also = tuple(dict.fromkeys(c for c in others if c != self.place))

    def displaced(self, seen: Seen, size: float) -> Mapping[str, Array]:
        path = seen.watched["path"] - seen.watched["path"][seen.zero]
        scale = float(np.abs(path).max()) or 1.0
        return {self.place: size * path * (1.0 + self.curve * np.abs(path) / scale)}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        if self.growth.tilt is not None:
            return {"gain": (size * self.growth.lumped_um_per_K, "um/K")}
        return {"gain": (size * float(self.growth.weights_um_per_K.sum()), "um/K")}


class Jumps(Effect):
    """A shaft that moves at once with its speed, by a power near two."""

    mechanism = "speed_shift"
    kind = "error"
    words = "the shaft moves with the speed"

    def drawn(
        self, plant: KindPlant, dice: Dice, driver: str = "spindle_rpm", um: tuple[float, float] = (2.0, 8.0)
    ) -> None:
        self.driver, self.top = driver, plant.rated
        self.um, self.exponent = dice.sign() * dice.span(*um), dice.even(1.5, 2.4)

    def displaced(self, seen: Seen, size: float) -> Mapping[str, Array]:
        return {self.place: size * self.um * (np.abs(seen.drive[str(self.driver)]) / self.top) ** self.exponent}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"shift": (size * self.um, "um"), "rated": (self.top, "rpm")}


class TestBar(Effect):
    """A bar in the nose that the room's air cools: late, between the two."""

    __test__ = False
    mechanism = "mandrel_fixture"
    kind = "error"
    words = "the test bar grows, late"

    def drawn(self, plant: KindPlant, dice: Dice, seat: str = "", um_per_K: tuple[float, float] = (0.8, 2.5)) -> None:
        self.um_per_K = dice.sign() * dice.span(*um_per_K)
        self.lag_s, self.share = dice.span(300.0, 2400.0), dice.even(0.5, 0.9)
        self.watch = {"seat": plant.mean(seat)}

    def displaced(self, seen: Seen, size: float) -> Mapping[str, Array]:
        air = next(iter(seen.air_degC.values()))
        bar = seen.smoothed(self.share * seen.watched["seat"] + (1.0 - self.share) * air, self.lag_s)
        return {self.place: size * self.um_per_K * bar}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"gain": (size * self.um_per_K, "um/K")}


class Reverses(Effect):
    """Unlisted: an error that follows the direction in which an axis moved last."""

    mechanism = None
    kind = "error"

    def drawn(self, plant: KindPlant, dice: Dice, driver: str = "feed", um: tuple[float, float] = (1.0, 5.0)) -> None:
        self.driver, self.um = driver, dice.sign() * dice.span(*um)
        self.form, self.words = ("linear", driver), f"the error shifts with the direction of {driver}"

    def displaced(self, seen: Seen, size: float) -> Mapping[str, Array]:
        feed = seen.drive[str(self.driver)]
        return {self.place: size * self.um * np.tanh(8.0 * feed / max(float(np.abs(feed).max()), 1e-9))}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"shift": (size * self.um, "um")}


class _Sensor(Effect):
    """A fault of one sensor; its place is a body, of which it takes a sensor."""

    kind = "sensor"

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        own = [s for s in plant.sensors if s.body == self.place] or list(plant.sensors)
        self.sensor = dice.pick(own)
        self.place, self.sign = self.sensor.channel, dice.sign()
        self.more(plant, dice)

    def more(self, plant: KindPlant, dice: Dice) -> None:
        """Draws its own attributes."""


class Late(_Sensor):
    """A sensor that has come loose: two lags one after the other, 1 to 20 min in all."""

    mechanism = "sensor_lag"
    words = "a sensor follows late"

    def more(self, plant: KindPlant, dice: Dice) -> None:
        self.largest, self.second = 1200.0 / 300.0, dice.even(0.0, 0.4)

    def reads(self, seen: Seen, size: float) -> Mapping[str, Array]:
        if size <= 0:
            return {}
        first = seen.smoothed(seen.temps_degC[self.place], 300.0 * size * (1.0 - self.second))
        return {self.place: seen.smoothed(first, 300.0 * size * self.second) if self.second > 0.05 else first}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"lag": (300.0 * size + self.sensor.lag_s, "s")}


class Drifts(_Sensor):
    """A sensor that leaves its place in a run, fast at first."""

    mechanism = "sensor_drift"
    words = "a sensor drifts"

    def more(self, plant: KindPlant, dice: Dice) -> None:
        self.power, self.K = dice.even(0.75, 1.15), dice.span(0.2, 0.8) / plant.setting.hours[1]

    def reads(self, seen: Seen, size: float) -> Mapping[str, Array]:
        hours = np.clip(seen.time_s, 0.0, None)[:, None] / 3600.0
        return {self.place: seen.temps_degC[self.place] + self.sign * size * self.K * hours**self.power}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"rate": (self.sign * size * self.K, "K/h")}


class Bonded(_Sensor):
    """A sensor that shows some of the air's temperature."""

    mechanism = "sensor_bonding"
    words = "a sensor is badly bonded"
    largest = 4.5

    def more(self, plant: KindPlant, dice: Dice) -> None:
        self.air_share = 0.2

    def reads(self, seen: Seen, size: float) -> Mapping[str, Array]:
        air, own = next(iter(seen.air_degC.values())), seen.temps_degC[self.place]
        return {self.place: own + self.air_share * size * (air - own)}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"bonding": (1.0 - self.air_share * size, "1")}


class Offset(_Sensor):
    """A sensor that shows the same error from some run on."""

    mechanism = "sensor_offset"
    words = "a sensor is off by a constant"

    def more(self, plant: KindPlant, dice: Dice) -> None:
        self.K, self.from_share = dice.span(0.2, 1.0), dice.pick((0.0, 0.0, 0.3))

    def reads(self, seen: Seen, size: float) -> Mapping[str, Array]:
        own = seen.temps_degC[self.place]
        after = np.arange(own.shape[1]) >= int(self.from_share * own.shape[1])
        return {self.place: own + self.sign * size * self.K * after}

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"offset": (self.sign * size * self.K, "K")}


class Swapped(_Sensor):
    """Two sensors of different bodies with exchanged names; any size but 0 enables it."""

    mechanism = "sensor_swap"
    words = "two sensors are exchanged"

    needs_clean = True

    def more(self, plant: KindPlant, dice: Dice) -> None:
        self.body_of = {s.channel: s.body for s in plant.sensors}
        self.partner = self.place

    def prepare(self, seen: Seen, wanted_K: float) -> None:
        """The pair whose readings differ by about the requested amount."""
        of = {n: v[seen.zero :] for n, v in seen.temps_degC.items()}
        pairs = [(a, b) for a, b in combinations(of, 2) if self.body_of[a] != self.body_of[b]]
        away = [abs(np.log(max(float(np.sqrt(((of[a] - of[b]) ** 2).mean())), 1e-9) / wanted_K)) for a, b in pairs]
        self.place, self.partner = pairs[int(np.argmin(away))]
        self.also = (self.partner,)

    def reads(self, seen: Seen, size: float) -> Mapping[str, Array]:
        if size <= 0:
            return {}
        return {self.place: seen.temps_degC[self.partner], self.partner: seen.temps_degC[self.place]}


class Skewed(Effect):
    """All error channels, or one sensor where there are none, on a clock of their own."""

    mechanism = "time_skew"
    words = "a clock is off"

    def drawn(self, plant: KindPlant, dice: Dice) -> None:
        own = [s.channel for s in plant.sensors if s.body == self.place] or [plant.sensors[0].channel]
        every = plant.errors if plant.errors and dice.chance(0.4) else (str(dice.pick(own)),)
        self.channels, self.delay_s = every, dice.sign() * 100.0
        self.kind, self.largest = ("error", 3.0) if every == plant.errors else ("sensor", 3.0)
        self.place, self.also = every[0], tuple(every[1:])

    def ahead_s(self, size: float) -> Mapping[str, float]:
        return dict.fromkeys(self.channels, self.delay_s * size)

    def values(self, size: float) -> dict[str, tuple[float, str]]:
        return {"delay": (self.delay_s * size, "s")}
