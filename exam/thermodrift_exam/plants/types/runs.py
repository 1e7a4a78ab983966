"""Runs of a simulated machine as a measuring system would have recorded them, with the scatter of a real year.

Every random number is drawn even if its range is empty, so that a smaller scatter changes nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from data.arrays import Array
from data.batch import Batch, Channel
from data.errors import InputError
from plants.sample.sample_year import (
    ANNUAL_MEAN_DEGC,
    FRICTION_SCATTER,
    PROBE_NOISE_UM,
    PROBE_STEP_UM,
    ROOM_DRIFT_K,
    ROOM_RIPPLE_K,
    SENSOR_BONDING,
    START_OFFSET_K,
    START_OFFSET_SHAPE,
    STEP_S,
    TEMPERATURE_STEP_K,
    sensor_degC,
)
from plants.sample.thermal_machine import ThermalMachine

MACHINE_SHARE = 0.2  # by which machines of one type differ in every conductance, capacity and heat
SENSOR_OFFSET_K = 0.2
DRIFT_OVER_S = 6 * 3600.0
ROOM = "room"


@dataclass(frozen=True)
class Scatter:
    """Scatter of runs: room drift over 6 h, ripple, start of the slow castings against the room, friction ±.

    A start is ``least + span · Beta(a, a)``, a per part of `START_OFFSET_SHAPE`.
    """

    drift_K: tuple[float, float] = ROOM_DRIFT_K
    ripple_K: float = ROOM_RIPPLE_K
    start_K: tuple[float, float] = START_OFFSET_K
    friction: float = FRICTION_SCATTER


@dataclass(frozen=True)
class SimulatedRun:
    """One run before it is recorded: `stages` of (seconds, rpm) one after the other, and its share of the scatter."""

    batch_id: str
    stages: tuple[tuple[float, float], ...]
    start_degC: float
    drift_K_per_h: float
    ripple_K: float
    ripple_period_s: tuple[float, float]
    slow_start_K: Mapping[str, float]  # by part: bed, column, table
    friction: float

    @classmethod
    def drawn(
        cls,
        batch_id: str,
        stages: Sequence[tuple[float, float]],
        start_degC: float,
        rng: np.random.Generator,
        scatter: Scatter | None = None,
    ) -> SimulatedRun:
        """A run with its scatter drawn."""
        s = scatter or Scatter()
        low_K, high_K = s.start_K
        return cls(
            batch_id,
            tuple(stages),
            start_degC,
            drift_K_per_h=float(rng.uniform(*s.drift_K)) * 3600.0 / DRIFT_OVER_S,
            ripple_K=s.ripple_K,
            ripple_period_s=(float(rng.uniform(1500, 3600)), float(rng.uniform(600, 1500))),
            slow_start_K={
                part: low_K + (high_K - low_K) * float(rng.beta(a, a)) for part, a in START_OFFSET_SHAPE.items()
            },
            friction=1.0 + s.friction * float(rng.uniform(-1.0, 1.0)),
        )

    @property
    def duration_s(self) -> float:
        return float(sum(seconds for seconds, _ in self.stages))

    def speed_rpm(self, time_s: Array) -> Array:
        """Speed of the step that starts at each time; 0 behind the end."""
        ends = np.cumsum([seconds for seconds, _ in self.stages])
        speeds = np.array([*(rpm for _, rpm in self.stages), 0.0])
        out: Array = speeds[np.searchsorted(ends, time_s, side="right")]
        return out

    def room_degC(self, time_s: Array) -> Array:
        """Room temperature: a drift and a ripple of two periods."""
        first, second = (np.sin(2 * np.pi * time_s / p) for p in self.ripple_period_s)
        return np.asarray(
            self.start_degC + self.drift_K_per_h * time_s / 3600.0 + self.ripple_K * (0.6 * first + 0.4 * second)
        )

    @property
    def floor_degC(self) -> float:
        """Annual mean plus half of the day's deviation from it."""
        return ANNUAL_MEAN_DEGC + (self.start_degC - ANNUAL_MEAN_DEGC) / 2


@dataclass(frozen=True)
class MachineType:
    """A type of machine: its network, which channel stands at which body (`room`: the air), and its slow castings.

    `slow_bodies` names the bodies of every part that starts away from the room (bed, column, table).
    """

    machine: ThermalMachine
    sensors: Mapping[str, str]
    slow_bodies: Mapping[str, Sequence[str]]

    def drawn(self, rng: np.random.Generator, sample_s: float) -> Rig:
        """One machine of the type: every conductance, capacity and heat ±20 %, sensor offsets within ±0.2 K.

        Raises:
            InputError: a sampling step that is no whole number of the simulation's steps.
        """
        if sample_s <= 0 or sample_s % STEP_S:
            raise InputError(f"simulated runs: sample_s {sample_s:g}; expected a whole number of steps of {STEP_S:g} s")
        machine = self.machine.scattered(rng, MACHINE_SHARE)
        offset_K = {name: float(rng.uniform(-SENSOR_OFFSET_K, SENSOR_OFFSET_K)) for name in self.sensors}
        return Rig(replace(self, machine=machine), offset_K, sample_s)


@dataclass(frozen=True)
class Rig:
    """One machine with its instruments, read every `sample_s`.

    Sensors lag 60 s, see a twentieth of the air, have an offset of their own and show 0.1 K; probes have 0.7 µm of
    noise and show 1 µm.
    """

    of: MachineType
    offset_K: Mapping[str, float]
    sample_s: float

    def record(self, runs: Sequence[SimulatedRun], rng: np.random.Generator) -> list[Batch]:
        """Simulate the runs at once and read the instruments; a batch per run, marked as simulated.

        The first row is the machine at its start; a row shows the speed of the step that ends there.
        """
        machine = self.of.machine
        steps = int(max(r.duration_s for r in runs) / STEP_S)
        time_s = np.arange(steps + 1, dtype=float) * STEP_S
        room_degC = np.stack([r.room_degC(time_s) for r in runs], axis=1)
        speed_rpm = np.stack([r.speed_rpm(time_s[:-1]) for r in runs], axis=1)
        body_degC = machine.simulate(
            speed_rpm,
            (room_degC[:-1] + room_degC[1:]) / 2,
            np.array([r.floor_degC for r in runs]),
            np.stack([self._start_degC(r) for r in runs]),
            np.array([r.friction for r in runs]),
            STEP_S,
        )
        ended_rpm = np.concatenate([np.zeros((1, len(runs))), speed_rpm])
        error_um = machine.error_um(body_degC - body_degC[0], ended_rpm)
        shown = {
            name: self.offset_K[name]
            + sensor_degC(room_degC if body == ROOM else body_degC[..., machine.place[body]], room_degC, SENSOR_BONDING)
            for name, body in self.of.sensors.items()
        }
        every = int(self.sample_s / STEP_S)
        batches = []
        for b, run in enumerate(runs):
            rows = slice(0, int(run.duration_s / STEP_S) + 1, every)
            columns = {"time_s": time_s[rows]}
            columns |= {n: _stepped(v[rows, b], TEMPERATURE_STEP_K) for n, v in shown.items()}
            columns["spindle_rpm"] = ended_rpm[rows, b]
            for name, values in error_um.items():
                noisy = values[rows, b] + rng.normal(0.0, PROBE_NOISE_UM, len(columns["time_s"]))
                columns[name] = _stepped(noisy, PROBE_STEP_UM)
            batches.append(Batch("simulated", run.batch_id, pd.DataFrame(columns), self.channels, simulated=True))
        return batches

    @property
    def channels(self) -> dict[str, Channel]:
        """Sensors, the spindle's speed, the machine's errors."""
        out = {
            name: Channel(name, "ambient" if body == ROOM else "temperature", "degC", TEMPERATURE_STEP_K)
            for name, body in self.of.sensors.items()
        }
        out["spindle_rpm"] = Channel("spindle_rpm", "driver", "rpm", 1.0)
        return out | {name: Channel(name, "error", "um", PROBE_STEP_UM) for name in self.of.machine.um_per_K}

    def _start_degC(self, run: SimulatedRun) -> Array:
        machine = self.of.machine
        start = np.full(len(machine.bodies), run.start_degC)
        for part, offset_K in run.slow_start_K.items():
            for body in self.of.slow_bodies.get(part, ()):
                start[machine.place[body]] += offset_K
        return start


def _stepped(values: Array, step: float) -> Array:
    """Rounded to the instrument's step; + 0.0 turns a negative zero into zero."""
    return np.asarray(np.rint(values / step) * step + 0.0)
