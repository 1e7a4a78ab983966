"""Axis recordings of the sample lathe: errors at 12 positions of X and Z while spindle and feed warm the machine.

Each run begins cold with one sweep, then runs at one spindle speed and one feed with repeated sweeps, in most runs also
during cooling. A sweep takes a reading every 10 s, X first, then Z. Between sweeps temperatures, speed, feed and the
spindle's own errors are logged every minute.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from plants.sample.sample_year import (
    FRICTION_SCATTER,
    PROBE_NOISE_UM,
    PROBE_STEP_UM,
    SENSOR_BONDING,
    STEP_S,
    TEMPERATURE_STEP_K,
    sensor_degC,
)
from plants.sample.thermal_machine import ThermalMachine
from thermodrift_exam.plants.types.lathe import AXES, LATHE, SLOW_BODIES, Drive, feed_heat_W
from thermodrift_exam.plants.types.runs import Scatter, SimulatedRun

SPEEDS_RPM, FEEDS_MM_PER_MIN = (1000, 1500, 2000), (500, 1000, 1500)
POSITIONS = 12
STANDING_S = 300.0  # cold, for the first sweep
RUN_S, COOL_DOWN_S = 4 * 3600.0, 5400.0
SWEEPS_MIN = (0, 15, 30, 50, 75, 105, 145, 190, 240, 265, 300)
LOG_S = 60.0
LASER_STEP_UM = 0.1
START_DEGC = (10.0, 30.0)
SCATTER = Scatter(start_K=(-1.5, 2.5))  # a lathe's bed is smaller than a machining centre's and follows the shop sooner
STROKE = 12.0  # the greater, the smaller the variation of strokes between runs
FIRST_DAY, DAYS = datetime(2025, 3, 3, 7, 0), 180

# The offsets belong to the machine and do not follow the seed.
SENSOR_OFFSET_K: Mapping[str, float] = MappingProxyType({
    "spindle_front": 0.11, "x_nut": -0.08, "z_nut": 0.15, "spindle_rear": -0.17, "headstock": 0.06,
    "spindle_motor": 0.19, "x_bearing": -0.05, "z_bearing": 0.13, "x_motor": -0.14, "z_motor": 0.02, "bed_left": -0.10,
    "bed_right": 0.09, "saddle": -0.02, "cross_slide": 0.17, "turret": -0.12, "enclosure": 0.07, "room": -0.04,
})  # fmt: skip
SPINDLE_ERRORS = tuple(f"{axis}_spindle" for axis in AXES)
COLUMNS = ("timestamp", *SENSOR_OFFSET_K, "spindle_rpm", "feed_mm_min", *SPINDLE_ERRORS,
           *(f"{axis}_{what}" for axis in AXES for what in ("position", "axis")))  # fmt: skip


@dataclass(frozen=True)
class AxisRun:
    """One run before it is recorded: when, how fast, and its share of the scatter."""

    start: datetime
    speed_rpm: int
    feed_mm_per_min: int
    scatter: SimulatedRun
    drives: Mapping[str, Drive]

    @property
    def name(self) -> str:
        return f"{self.start:%Y%m%d}_{self.speed_rpm}rpm_{self.feed_mm_per_min}mm.csv"

    @property
    def sweep_starts_s(self) -> list[float]:
        """When the sweeps begin, from the run's start."""
        last_s = self.scatter.duration_s - 2 * POSITIONS * STEP_S
        return [float(m * 60) for m in SWEEPS_MIN if m * 60 <= last_s]


def axis_runs(seed: int = 0, batches: int = 9) -> list[AxisRun]:
    """Runs by date from March to August: every speed with every feed, in mixed order; two in three cool down.

    Raises:
        InputError: a negative seed, or `batches` outside 1..90.
    """
    if seed < 0:
        raise InputError(f"sample axis: seed: got {seed}, expected 0 or more; choose another number")
    if not 1 <= batches <= 90:
        raise InputError(f"sample axis: batches: got {batches}, expected 1 to 90; choose a number in that range")
    rng = np.random.default_rng([seed, 180, 520])
    pairs = [(n, f) for n in SPEEDS_RPM for f in FEEDS_MM_PER_MIN]
    mixed = [pairs[i] for _ in range(-(-batches // len(pairs))) for i in rng.permutation(len(pairs))][:batches]
    levels_degC = np.linspace(*START_DEGC, batches) if batches > 1 else np.array([np.mean(START_DEGC)])
    runs = []
    for k, (rpm, feed) in enumerate(mixed):
        start = FIRST_DAY + timedelta(days=k * DAYS // batches, minutes=int(rng.integers(0, 120)))
        stages = [(STANDING_S, 0.0), (RUN_S, float(rpm))] + ([(COOL_DOWN_S, 0.0)] if k % 3 else [])
        start_degC = float(levels_degC[k] + rng.uniform(-2.0, 2.0))
        scatter = SimulatedRun.drawn(f"{start:%Y%m%d}", stages, start_degC, rng, SCATTER)
        runs.append(AxisRun(start, rpm, feed, scatter, {axis: _drive(rng) for axis in AXES}))
    return runs


def _drive(rng: np.random.Generator) -> Drive:
    first, second, third = rng.dirichlet(STROKE * np.array(Drive().shares))
    return Drive(float(1 + FRICTION_SCATTER * rng.uniform(-1.0, 1.0)), (float(first), float(second), float(third)))


@dataclass(frozen=True)
class AxisTruth:
    """Simulated quantities before any instrument; the longest run sets S.

    body_degC (S + 1, B, N), room_degC, speed_rpm and feed_mm_per_min (S + 1, B); a speed is that of the step that ends.
    """

    machine: ThermalMachine
    body_degC: Array
    room_degC: Array
    speed_rpm: Array
    feed_mm_per_min: Array

    def spindle_um(self) -> dict[str, Array]:
        """Errors of the spindle alone, ``x_spindle`` and ``z_spindle``, each (S + 1, B)."""
        return self.machine.error_um(self.body_degC - self.body_degC[0], self.speed_rpm)

    def axis_um(self, axis: str, step: NDArray[np.int64], run: int, position_mm: Array) -> Array:
        """Error between tool and workpiece at positions (n,) at steps (n,) of a run: spindle and screw together."""
        rises = self.body_degC[step, run] - self.body_degC[0, run]
        rise_K = {body: rises[:, i] for body, i in self.machine.place.items()}
        spindle = self.machine.error_um(rises, self.speed_rpm[step, run])[f"{axis}_spindle"]
        return np.asarray(spindle + AXES[axis].elongation_um(rise_K, position_mm))


def run_lathe(runs: Sequence[AxisRun], machine: ThermalMachine = LATHE) -> AxisTruth:
    """Simulate all runs in one pass, at 10 s."""
    steps = int(max(r.scatter.duration_s for r in runs) / STEP_S)
    time_s = np.arange(steps + 1, dtype=float) * STEP_S
    speed_rpm = np.stack([r.scatter.speed_rpm(time_s[:-1]) for r in runs], axis=1)
    feed = np.where(speed_rpm > 0, np.array([float(r.feed_mm_per_min) for r in runs]), 0.0)
    room_degC = np.stack([r.scatter.room_degC(time_s) for r in runs], axis=1)
    friction = np.array([r.scatter.friction for r in runs])
    start_degC = np.tile([[r.scatter.start_degC] for r in runs], len(machine.bodies))
    for k, run in enumerate(runs):
        for part, offset_K in run.scatter.slow_start_K.items():
            start_degC[k, [machine.place[b] for b in SLOW_BODIES[part]]] += offset_K
    floor_degC = np.array([r.scatter.floor_degC for r in runs])
    between_degC = (room_degC[:-1] + room_degC[1:]) / 2
    drives_W = feed_heat_W(machine, feed, {axis: [r.drives[axis] for r in runs] for axis in AXES})
    body_degC = machine.simulate(speed_rpm, between_degC, floor_degC, start_degC, friction, STEP_S, drives_W)
    still = np.zeros((1, len(runs)))
    return AxisTruth(machine, body_degC, room_degC, np.vstack([still, speed_rpm]), np.vstack([still, feed]))


def write_sample_axis(folder: Path, seed: int = 0, batches: int = 9, machine: ThermalMachine = LATHE) -> list[Path]:
    """Write the runs as CSV files, one a run, named by date, speed and feed; returns their paths by date.

    The same seed gives the same bytes. Every file starts with a line that calls it simulated. Temperatures are in degC
    to 0.1, spindle errors in µm to 1, axis errors in µm to 0.1, positions in mm.

    Raises:
        InputError: seed or `batches` out of range, or `folder` cannot be made or written.
    """
    runs = axis_runs(seed, batches)
    truth = run_lathe(runs, machine)
    shown = {
        name: sensor_degC(
            truth.room_degC if name == "room" else truth.body_degC[..., machine.place[name]],
            truth.room_degC,
            SENSOR_BONDING,
        )
        + offset
        for name, offset in SENSOR_OFFSET_K.items()
    }
    spindle_um = truth.spindle_um()
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for b, run in enumerate(runs):
            rng = np.random.default_rng([seed, b, run.start.timetuple().tm_yday])
            columns = _recorded(run, b, truth, {n: v[:, b] for n, v in (shown | spindle_um).items()}, rng)
            head = f"# simulated recording, thermodrift sample lathe, seed {seed}"
            rows = [head, ",".join(COLUMNS), *(",".join(row) for row in zip(*columns, strict=True))]
            path = folder / run.name
            path.write_text("\n".join(rows) + "\n", encoding="ascii", newline="\n")
            paths.append(path)
    except OSError as error:
        raise InputError(f"sample axis: {folder} cannot be written ({error}); give a folder that can be") from None
    return paths


def _recorded(
    run: AxisRun, b: int, truth: AxisTruth, series: Mapping[str, Array], rng: np.random.Generator
) -> list[list[str]]:
    """The file's columns as text, in the order of `COLUMNS`."""
    logged = np.arange(0, int(run.scatter.duration_s / STEP_S) + 1, int(LOG_S / STEP_S))
    first = np.array(run.sweep_starts_s) / STEP_S
    swept = (first[:, None] + np.arange(2 * POSITIONS)).astype(np.int64).ravel()
    rows = np.union1d(logged, swept)
    stamps = [f"{run.start + timedelta(seconds=int(r) * STEP_S):%Y-%m-%d %H:%M:%S}" for r in rows]
    out = [stamps, *(_text(series[n][rows], TEMPERATURE_STEP_K) for n in SENSOR_OFFSET_K)]
    out += [_text(driver[rows, b], 1.0) for driver in (truth.speed_rpm, truth.feed_mm_per_min)]
    on_log = np.isin(rows, logged)
    for name in SPINDLE_ERRORS:
        noisy = series[name][rows] + rng.normal(0.0, PROBE_NOISE_UM, len(rows))
        out.append(_text(np.where(on_log, noisy, np.nan), PROBE_STEP_UM))
    for k, (axis, part) in enumerate(AXES.items()):
        at_mm = np.round(np.linspace(*part.travel_mm, POSITIONS), 2)
        steps = (first[:, None] + np.arange(k * POSITIONS, (k + 1) * POSITIONS)).astype(np.int64).ravel()
        position_mm, error_um = np.full(len(rows), np.nan), np.full(len(rows), np.nan)
        here = np.searchsorted(rows, steps)
        position_mm[here] = np.tile(at_mm, len(first))
        error_um[here] = truth.axis_um(axis, steps, b, position_mm[here]) + rng.normal(0.0, PROBE_NOISE_UM, len(here))
        out += [_text(position_mm, 0.01), _text(error_um, LASER_STEP_UM)]
    return out


def _text(values: Array, step: float) -> list[str]:
    """Rounded to the instrument's step, empty where nothing was read; + 0.0 turns a negative zero into zero."""
    digits = max(0, round(-np.log10(step)))
    rounded = np.rint(values / step) * step + 0.0
    return ["" if v != v else f"{v:.{digits}f}" for v in rounded.tolist()]
