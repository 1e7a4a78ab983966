"""Effects on recordings alone: a shift of the shaft by speed, faults of sensors and clocks, a wrong value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from data.arrays import Array
from thermodrift_exam.plants.effects.base import Answer, Effect
from thermodrift_exam.plants.structure import Plant, Sensor, links_W_per_K


class SpeedShift(Effect):
    """The balls' centrifugal load moves the shaft with the speed squared (Harris and Kotzalas 2006)."""

    key = "speed_shift"
    driver = "spindle_rpm"

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        self.shift_um = float(rng.choice([-1.0, 1.0]) * rng.uniform(4.0, 8.0)) * size

    def answer(self) -> Answer:
        values = {"shift": (self.shift_um, "um"), "rated": (self.plant.rated_rpm, "rpm")}
        return Answer(self.key, "error", "z", values, words="the shaft moves with the speed")

    def displaced_um(self, speed_rpm: Array) -> Mapping[str, Array]:
        return {"z": self.shift_um * (speed_rpm / self.plant.rated_rpm) ** 2}


class _OneSensor(Effect):
    """A fault of one sensor of the structure."""

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        self.channel = str(rng.choice([s.channel for s in plant.sensors]))
        self.sign = float(rng.choice([-1.0, 1.0]))

    def sensed(self, sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
        return tuple(self.faulty(s) if s.channel == self.channel else s for s in sensors)

    def faulty(self, sensor: Sensor) -> Sensor:
        raise NotImplementedError


class SensorDrift(_OneSensor):
    """A sensor with a linear drift in every run."""

    key = "sensor_drift"

    def answer(self) -> Answer:
        return Answer(self.key, "sensor", self.channel, {"rate": (0.25 * self.sign * self.size, "K/h")})

    def faulty(self, sensor: Sensor) -> Sensor:
        return replace(sensor, drift_K_per_h=0.25 * self.sign * self.size)


class SensorLag(_OneSensor):
    """A sensor that has come loose and follows late."""

    key = "sensor_lag"

    def answer(self) -> Answer:
        base_s = next(s.lag_s for s in self.plant.sensors if s.channel == self.channel)
        return Answer(self.key, "sensor", self.channel, {"lag": (base_s + 900.0 * self.size, "s")})

    def faulty(self, sensor: Sensor) -> Sensor:
        return replace(sensor, lag_s=sensor.lag_s + 900.0 * self.size)


class SensorSwap(Effect):
    """Two sensors with exchanged names; any size but 0 enables it."""

    key = "sensor_swap"

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        near = {"t_front", "t_motor", "t_rear"} & {s.channel for s in plant.sensors}
        far = {s.channel for s in plant.sensors} - near
        self.one, self.other = (str(rng.choice(sorted(group))) for group in (near, far))

    def answer(self) -> Answer:
        return Answer(self.key, "sensor", self.one, also=(self.other,), words="two sensors are exchanged")

    def sensed(self, sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
        if self.size == 0:
            return sensors
        by_name = {s.channel: s for s in sensors}
        exchanged = {self.one: by_name[self.other], self.other: by_name[self.one]}
        return tuple(replace(exchanged.get(s.channel, s), channel=s.channel) for s in sensors)


class TimeSkew(Effect):
    """The clock of the probes is off: all error channels are early or late together."""

    key = "time_skew"

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        self.delay_s = float(rng.choice([-1.0, 1.0]) * rng.uniform(240.0, 480.0)) * size

    def answer(self) -> Answer:
        return Answer(self.key, "error", "z", {"delay": (self.delay_s, "s")}, ("x", "y"), "the probe's clock is off")

    def ahead_s(self) -> Mapping[str, float]:
        return {c: self.delay_s for c in ("x", "y", "z")}


class WrongParameter(Effect):
    """No physics is missing; one joint of the machine file is wrong far beyond its prior spread."""

    key = "wrong_parameter"

    def drawn(self, plant: Plant, size: float, rng: np.random.Generator) -> None:
        joints = [pair for pair in links_W_per_K(plant.structure) if "mandrel" not in pair]
        self.link = "-".join(joints[int(rng.integers(len(joints)))])
        self.stated = 4.0 ** (size * float(rng.choice([-1.0, 1.0])))

    def answer(self) -> Answer:
        return Answer(
            self.key, "link", self.link, {"factor": (1.0 / self.stated, "1")}, words="a joint is stated wrong"
        )

    def misread(self) -> Mapping[str, float]:
        return {f"links.{self.link}": self.stated} if self.size else {}
