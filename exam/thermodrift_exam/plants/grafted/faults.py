"""Faults applied to real readings: a sensor that drifts, lags, is loose or swapped, a clock, a shift."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from scipy.signal import lfilter

from data.arrays import Array
from data.batch import Batch
from thermodrift_exam.plants.grafted.base import Graft, Setting, room_degC
from thermodrift_exam.plants.real import Term, windows

RATED_RPM = 5000.0


class OneSensor(Graft):
    """A fault of one sensor."""

    words: ClassVar[str]

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        self.channel = str(rng.choice(self.suited(setting)))
        self.sign = float(rng.choice([-1.0, 1.0]))

    def suited(self, setting: Setting) -> list[str]:
        return setting.sensors()

    def parameters(self) -> dict[str, tuple[float, str]]:
        raise NotImplementedError

    def faulty(self, batch: Batch, true_degC: Array) -> Array:
        raise NotImplementedError

    def shown(self, number: int, batch: Batch) -> Mapping[str, Array]:
        return {self.channel: self.faulty(batch, batch.values(self.channel))}

    def term(self) -> Term:
        return Term(
            self.key, self.key, ("sensor", self.channel), parameters=self.parameters(), words=self.words, size=self.size
        )


class SensorDrift(OneSensor):
    """A linear drift in every run."""

    key = "sensor_drift"
    words = "a sensor drifts"

    @property
    def rate_K_per_h(self) -> float:
        return 0.25 * self.sign * self.size

    def parameters(self) -> dict[str, tuple[float, str]]:
        return {"rate": (self.rate_K_per_h, "K/h")}

    def faulty(self, batch: Batch, true_degC: Array) -> Array:
        return true_degC + self.rate_K_per_h * batch.time_s / 3600.0


class SensorLag(OneSensor):
    """A sensor that has come loose and follows late, in addition to the lag that it always had."""

    key = "sensor_lag"
    words = "a sensor follows late"

    @property
    def lag_s(self) -> float:
        return 600.0 * self.size

    def parameters(self) -> dict[str, tuple[float, str]]:
        return {"lag": (self.lag_s, "s")}

    def faulty(self, batch: Batch, true_degC: Array) -> Array:
        known = np.flatnonzero(np.isfinite(true_degC))
        whole = np.interp(np.arange(len(true_degC)), known, true_degC[known])
        keep = float(np.exp(-batch.step_s / self.lag_s))
        late = lfilter([1 - keep], [1, -keep], whole, zi=[keep * whole[0]])[0]
        return np.where(np.isfinite(true_degC), late, np.nan)


class SensorBonding(OneSensor):
    """A sensor that the room's air cools."""

    key = "sensor_bonding"
    words = "a sensor is badly bonded"

    def suited(self, setting: Setting) -> list[str]:
        """Those for which the file has no such share."""
        return [c for c in setting.sensors() if "bonding" not in setting.twin["sensors"][c]]

    @property
    def share(self) -> float:
        return 1.0 - 0.15 * self.size

    def parameters(self) -> dict[str, tuple[float, str]]:
        return {"bonding": (self.share, "1")}

    def faulty(self, batch: Batch, true_degC: Array) -> Array:
        air = room_degC(self.setting.twin, batch)
        return air + self.share * (true_degC - air)


class SensorSwap(Graft):
    """Two sensors of different bodies with exchanged names; any size but 0 enables it."""

    key = "sensor_swap"

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        at = {c: s["at"] for c, s in setting.twin.get("sensors", {}).items()}
        names = setting.sensors()
        pairs = [(a, b) for k, a in enumerate(names) for b in names[k + 1 :] if at.get(a, a) != at.get(b, b)]
        self.one, self.other = pairs[int(rng.integers(len(pairs)))]

    def shown(self, number: int, batch: Batch) -> Mapping[str, Array]:
        return {self.one: batch.values(self.other), self.other: batch.values(self.one)}

    def term(self) -> Term:
        also = [("sensor", self.other)]
        return Term(self.key, self.key, ("sensor", self.one), also=also, words="two sensors exchanged", size=self.size)


class TimeSkew(Graft):
    """The probes' clock against that of the temperatures: they show now what happens `delay` later."""

    key = "time_skew"

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        self.delay_s = float(rng.choice([-1.0, 1.0])) * 300.0 * size
        self.probes = setting.machine.names("error")

    def shown(self, number: int, batch: Batch) -> Mapping[str, Array]:
        """Held at the start, where the machine rested; nothing is known beyond the end."""
        seen_s = batch.time_s + self.delay_s
        out = {}
        for probe in self.probes:
            values = batch.values(probe)
            known = np.isfinite(values)
            shown = np.interp(seen_s, batch.time_s[known], values[known], right=np.nan)
            gap = np.interp(seen_s, batch.time_s, known.astype(float)) < 1.0
            out[probe] = np.where(gap, np.nan, shown)
        return out

    def term(self) -> Term:
        first, *others = (("error", p) for p in self.probes)
        return Term(
            self.key, self.key, first, also=others, parameters={"delay": (self.delay_s, "s")},
            words="the clock of the probes is off", size=self.size,
        )  # fmt: skip


class SpeedShift(Graft):
    """The shaft moves with the speed squared, in one probe's direction."""

    key = "speed_shift"

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        self.probe = str(rng.choice(setting.machine.names("error")))
        self.shift_um = float(rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 4.0)) * size

    def shown(self, number: int, batch: Batch) -> Mapping[str, Array]:
        turns = (batch.values("spindle_rpm") / RATED_RPM) ** 2
        return {self.probe: batch.values(self.probe) + self.shift_um * (turns - turns[0])}

    def term(self) -> Term:
        turning = [b.values("spindle_rpm") > 0 for b in self.setting.batches]
        return Term(
            self.key, self.key, ("error", self.probe), driver="spindle_rpm", size=self.size,
            parameters={"shift": (self.shift_um, "um"), "rated": (RATED_RPM, "rpm")},
            active=windows(self.setting.batches, turning), words="the shaft moves with the speed",
        )  # fmt: skip
