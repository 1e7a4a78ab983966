"""Heats grafted on real runs: nearly linear effects, at bodies without bearing heat."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from data.arrays import Array, Mask
from data.batch import Batch
from thermodrift_exam.plants.grafted.base import ROOM, Graft, Setting, room_degC
from thermodrift_exam.plants.grafted.frame import Clockwork, Frame, Push, draw_frame, on_channels, response
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.real import Place, Term, linked, windows

PEAK_K = 1.5  # what a heat of size 1 adds at most to a sensor of its body
RATED_RPM = 2000.0
GROUND_DEGC, FOLLOWS = 18.0, 0.5
COOL = ("column", "bed", "base", "saddle", "slide", "cast", "cover_a", "cover_b", "cover_h")


class Heat(Graft):
    """A heat into one body, as strong as `PEAK_K` times its size at that body's sensors."""

    mechanism: ClassVar[str | None]
    bodies: ClassVar[tuple[str, ...]] = COOL
    unit: ClassVar[tuple[str, str]]  # the amplitude's name and unit
    driver: ClassVar[str | None] = None
    alike: ClassVar[tuple[str, ...]] = ()
    words: ClassVar[str]

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        seen = {s["at"] for c, s in setting.twin["sensors"].items() if c in setting.sensors()}
        self.body = str(rng.choice([b for b in self.bodies if b in seen]))
        self.clock = Clockwork.of(setting.batches)
        self.frame: Frame = draw_frame(setting.twin, stream(setting.seed, "frame"))

    def unit_push(self) -> Push:
        """The action of an amplitude of 1."""
        raise NotImplementedError

    def shape(self) -> dict[str, tuple[float, str]]:
        """The parameters other than the amplitude."""
        return {}

    def acting(self, batch: Batch) -> Mask:
        """Rows at which it acts, (rows,)."""
        return np.ones(batch.n_rows, bool)

    @cached_property
    def _unit_rise(self) -> Array:
        """Of an amplitude of 1, to first order, K, (rows, N, B)."""
        push = self.unit_push()
        return response(self.frame, Push(push.drive_W, {}, push.spread), self.clock)

    @cached_property
    def amplitude(self) -> float:
        """The amplitude whose response at the sensors of the body has the requested size, to first order."""
        rise = self._unit_rise
        own = [s.bonding * rise[:, s.cell] for s in self.frame.placements.values() if s.body == self.body]
        inside = np.arange(len(rise))[:, None] < np.array([b.n_rows for b in self.setting.batches])
        return PEAK_K * self.size / max(float(np.abs(o[inside]).max()) for o in own)

    @cached_property
    def added(self) -> dict[str, Array]:
        """By channel, (rows, B)."""
        push = self.unit_push().times(self.amplitude)
        rise = response(self.frame, push, self.clock) if push.more_W_per_K else self.amplitude * self._unit_rise
        return on_channels(self.frame, rise)

    def shown(self, number: int, batch: Batch) -> Mapping[str, Array]:
        return {c: batch.values(c) + a[: batch.n_rows, number] for c, a in self.added.items()}

    def term(self) -> Term:
        name, unit = self.unit
        acting = [self.acting(b) for b in self.setting.batches]
        always = all(a.all() for a in acting)
        place: Place = ("node", self.body)
        return Term(
            self.key, self.mechanism, place, parameters={name: (self.amplitude, unit), **self.shape()},
            neighbours=linked(self.setting.twin, self.body), words=f"{self.words}: {self.body}", size=self.size,
            active="always" if always else windows(self.setting.batches, acting), driver=self.driver,
            same_as=[(law, place) for law in self.alike],
        )  # fmt: skip

    def mapping(self) -> dict[str, str]:
        f = self.frame
        cells = {c: f"cell {p.cell % len(f.bodies[p.body])} of {p.body}" for c, p in f.placements.items()}
        return cells | {c: f"means of {', '.join(g)}" for c, g in f.gains_um_per_K.items()}


class CabinetHeat(Heat):
    """A cabinet that is switched on up to two hours before each run and stays on."""

    key = mechanism = "cabinet_heat"
    unit = ("heat", "W")
    words = "waste heat of a cabinet"

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        super().drawn(setting, size, rng)
        self.ahead_s = 3600.0 * rng.uniform(0.0, 2.0, len(setting.batches))

    def unit_push(self) -> Push:
        return Push({self.body: (self.clock.middle_s[:, None] > -self.ahead_s).astype(float)})


class HydraulicUnit(Heat):
    """A pump that cycles from each run's start."""

    key = mechanism = "hydraulic_unit"
    unit = ("heat", "W")
    bodies = ("base", "saddle", "cast", "slide", "cover_a", "cover_h")
    words = "a pump that runs by turns"

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        super().drawn(setting, size, rng)
        self.period_min, self.duty = float(rng.integers(40, 91)), float(rng.uniform(0.25, 0.6))

    def shape(self) -> dict[str, tuple[float, str]]:
        return {"duty": (self.duty, "1"), "period": (self.period_min, "min")}

    def _on(self, time_s: Array) -> Mask:
        return (time_s >= 0) & ((time_s / (60.0 * self.period_min)) % 1.0 < self.duty)

    def unit_push(self) -> Push:
        on = self._on(self.clock.middle_s).astype(float)
        return Push({self.body: np.repeat(on[:, None], len(self.setting.batches), axis=1)})


class FloorSink(Heat):
    """Exchange of the bed or its base with the ground, which follows the room's first reading by half."""

    key = mechanism = "floor_sink"
    unit = ("conductance", "W/K")
    bodies = ("bed", "base")
    words = "heat to the floor"

    def shape(self) -> dict[str, tuple[float, str]]:
        return {"temperature": (GROUND_DEGC, "degC"), "follow": (FOLLOWS, "1")}

    def unit_push(self) -> Push:
        twin, batches = self.setting.twin, self.setting.batches
        room = twin["surroundings"][ROOM]["channel"]
        ground = np.array([GROUND_DEGC + FOLLOWS * (b.values(room)[0] - GROUND_DEGC) for b in batches])
        lead_K = ground - self.clock.means([surface_degC(self.setting, self.body, b) for b in batches])
        return Push({self.body: lead_K}, {self.body: np.ones_like(lead_K)})


class Sun(Heat):
    """The sun on one face between two hours of the day; the hours at which the runs begin are drawn."""

    key = mechanism = "sun"
    unit = ("power", "W")
    bodies = ("column", "cover_a", "cover_b", "cover_h", "base")
    words = "the sun on one face"

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        super().drawn(setting, size, rng)
        self.rise_h, self.set_h = float(rng.uniform(8.0, 10.0)), float(rng.uniform(13.0, 15.0))

    def shape(self) -> dict[str, tuple[float, str]]:
        return {"rise": (self.rise_h, "h"), "set": (self.set_h, "h")}

    def _height(self, batch: Batch, time_s: Array) -> Array:
        assert batch.start is not None
        clock_h = (batch.start.hour + batch.start.minute / 60.0 + time_s / 3600.0) % 24.0
        up = (clock_h - self.rise_h) / (self.set_h - self.rise_h)
        return np.where((up > 0) & (up < 1), np.sin(np.pi * np.clip(up, 0.0, 1.0)), 0.0)

    def acting(self, batch: Batch) -> Mask:
        return self._height(batch, batch.time_s) > 0

    def unit_push(self) -> Push:
        return Push({self.body: np.stack([self._height(b, self.clock.middle_s) for b in self.setting.batches], axis=1)})


class BeltLoss(Heat):
    """Heat by the speed at a body where the file has none."""

    key = mechanism = "belt_loss"
    unit = ("power", "W")
    bodies = ("column", "cover_h", "cast", "slide")
    driver = "spindle_rpm"
    alike = ("motor_loss", "bearing_viscous", "bearing_load")
    words = "losses of the belt"

    def shape(self) -> dict[str, tuple[float, str]]:
        return {"exponent": (1.5, "1"), "rated": (RATED_RPM, "rpm")}

    def acting(self, batch: Batch) -> Mask:
        return np.asarray(batch.values("spindle_rpm") > 0)

    def unit_push(self) -> Push:
        speed = self.clock.held([b.values("spindle_rpm") for b in self.setting.batches])
        return Push({self.body: (speed / RATED_RPM) ** 1.5})


class UnlistedWarmSpeed(Heat):
    """Unlisted: heat by the speed times the room's excess over 20 degC."""

    key = "unlisted_warm_speed"
    mechanism = None
    unit = ("power", "W")
    bodies = ("column", "cover_h", "slide", "saddle")
    driver = "spindle_rpm times room"
    words = "power (n / 2000 rpm) (T_room - 20 degC) / 10 K"

    def acting(self, batch: Batch) -> Mask:
        return np.asarray(batch.values("spindle_rpm") > 0)

    def unit_push(self) -> Push:
        twin, batches = self.setting.twin, self.setting.batches
        speed = self.clock.held([b.values("spindle_rpm") for b in batches]) / RATED_RPM
        room = self.clock.means([room_degC(twin, b) for b in batches])
        return Push({self.body: speed * (room - 20.0) / 10.0})


class Draught(Heat):
    """A gate that opens at the same point of every run: colder air at all that the room cools, and more of it."""

    key = mechanism = "draught"
    unit = ("factor", "1")
    words = "a gate opens for a while"

    def drawn(self, setting: Setting, size: float, rng: np.random.Generator) -> None:
        super().drawn(setting, size, rng)
        self.body = ROOM
        self.start_min, self.duration_min = int(rng.integers(60, 200)), int(rng.integers(20, 46))
        self.factor, self.drop_K = 1.0 + 0.5 * size, 2.0 * size

    def shape(self) -> dict[str, tuple[float, str]]:
        return {
            "start": (self.start_min / 60.0, "h"), "duration": (self.duration_min, "min"), "drop": (self.drop_K, "K"),
        }  # fmt: skip

    @cached_property
    def amplitude(self) -> float:
        return self.factor

    def _open(self, time_s: Array) -> Mask:
        since_s = time_s - 60.0 * self.start_min
        return (since_s >= 0) & (since_s < 60.0 * self.duration_min)

    def acting(self, batch: Batch) -> Mask:
        return self._open(batch.time_s)

    @cached_property
    def added(self) -> dict[str, Array]:
        twin, batches, clock = self.setting.twin, self.setting.batches, self.clock
        room = clock.means([room_degC(twin, b) for b in batches])
        opened = self._open(clock.middle_s)[:, None]
        seen = {s["at"] for s in twin["sensors"].values()}
        drive, more = {}, {}
        for body, conductance in self.frame.room_W_per_K.items():
            if body not in seen:
                continue
            lead_K = room - clock.means([surface_degC(self.setting, body, b) for b in batches])
            drive[body] = opened * conductance * (self.factor * (lead_K - self.drop_K) - lead_K)
            more[body] = opened * conductance * (self.factor - 1.0) * np.ones_like(lead_K)
        return on_channels(self.frame, response(self.frame, Push(drive, more, spread=True), clock))

    def term(self) -> Term:
        return replace(super().term(), also=[("link", key) for key in self.setting.twin["exposures"]])


def surface_degC(setting: Setting, body: str, batch: Batch) -> Array:
    """Mean reading of the sensors of a body in a run, over those with values, (rows,)."""
    shown = [batch.values(c) for c, s in setting.twin["sensors"].items() if s["at"] == body]
    known = [v for v in shown if np.isfinite(v).mean() > 0.5]
    return np.asarray(np.mean([np.where(np.isfinite(v), v, np.nanmean(v)) for v in known], axis=0))
