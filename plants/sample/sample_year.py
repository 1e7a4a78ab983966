"""The sample year: recordings of the simulated machining centre, written as a measuring system would write them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from pathlib import Path
from types import MappingProxyType

import numpy as np
from scipy.signal import lfilter

from data.arrays import Array
from data.errors import InputError
from plants.sample.sample_machine import NODE, NODES, displacement_um, simulate

STEP_S = 10.0  # of the simulation
SAMPLE_S = 60.0  # of the recording
YEAR, WARMEST_DAY = 2025, 196  # 15 July
COLDEST_DEGC, WARMEST_DEGC = 2.9, 32.4
ANNUAL_MEAN_DEGC = (COLDEST_DEGC + WARMEST_DEGC) / 2
SPEEDS_RPM = (2000, 4000, 6000)
SPECTRUM_RPM, SPECTRUM_STAGE_S = (1500, 3000, 4500, 6000), 900.0
STANDING_S = 300.0  # before the spindle starts, so that the first samples show the machine at rest
RUN_S = 6 * 3600.0

# Scatter from batch to batch
ROOM_DRIFT_K, ROOM_RIPPLE_K = (-1.0, 5.0), 0.3
# Slow castings against the room: the machine never starts from equilibrium. Bell-shaped by a beta(a, a) law, narrower
# for the column, which reaches its steady state overnight sooner than bed and table; a is set so that models score as
# in print.
START_OFFSET_K = (-2.0, 4.0)
START_OFFSET_SHAPE: Mapping[str, float] = MappingProxyType({"bed": 2.5, "column": 4.0, "table": 2.0})
FRICTION_SCATTER = 0.15

# Measurement. The offsets belong to the machine, not to the year, so they do not follow the seed.
SENSOR_OFFSET_K: Mapping[str, float] = MappingProxyType({
    "front": 0.12, "rear": -0.07, "motor": 0.18, "head_front": -0.15, "head_rear": 0.04, "screw": -0.19,
    "column_front": 0.09, "column_back": -0.11, "bed": 0.16, "room": -0.03,
})  # fmt: skip
SENSOR_LAG_S, SENSOR_BONDING = 60.0, 0.95
TEMPERATURE_STEP_K = 0.1
PROBE_NOISE_UM, PROBE_STEP_UM = 0.7, 1.0

COLUMNS = ("timestamp", *SENSOR_OFFSET_K, "spindle_rpm", "x", "y", "z")


@dataclass(frozen=True)
class Plan:
    """One batch before it is run: when, how, and its share of the scatter."""

    start: datetime
    speed_rpm: int  # of a constant run
    spectrum: bool
    cool_down_s: float
    start_degC: float
    drift_K: float
    ripple_period_s: tuple[float, float]
    slow_start_K: Mapping[str, float]
    friction: float

    @property
    def duration_s(self) -> float:
        return STANDING_S + RUN_S + self.cool_down_s

    @property
    def name(self) -> str:
        return f"{self.start:%Y%m%d}_{'spectrum' if self.spectrum else f'{self.speed_rpm}rpm'}.csv"

    def speed_at(self, time_s: Array) -> Array:
        """Commanded spindle speed in rpm at times from the batch's start."""
        stop_s = STANDING_S + RUN_S if self.cool_down_s else np.inf
        running = (time_s >= STANDING_S) & (time_s < stop_s)
        if not self.spectrum:
            return np.where(running, float(self.speed_rpm), 0.0)
        stage = ((time_s - STANDING_S) // SPECTRUM_STAGE_S).astype(int) % len(SPECTRUM_RPM)
        return np.where(running, np.array(SPECTRUM_RPM, float)[stage], 0.0)

    def room_at(self, time_s: Array) -> Array:
        """Room temperature in degC: a drift over the batch and a ripple of 0.3 K at most."""
        first, second = (np.sin(2 * np.pi * time_s / p) for p in self.ripple_period_s)
        ripple = ROOM_RIPPLE_K * (0.6 * first + 0.4 * second)
        return np.asarray(self.start_degC + self.drift_K * time_s / self.duration_s + ripple)

    @property
    def floor_degC(self) -> float:
        """Annual mean plus half of the day's deviation from it."""
        return ANNUAL_MEAN_DEGC + (self.start_degC - ANNUAL_MEAN_DEGC) / 2

    def start_nodes_degC(self) -> Array:
        """Node temperatures at the start, (14,): at the room's but for the slow castings."""
        return self.start_degC + np.array([self.slow_start_K.get(n, 0.0) for n in NODES])


def plan_year(seed: int = 0, batches: int = 30) -> list[Plan]:
    """The year's batches by date: start ambients × speeds, a third with a cool-down, one in ten a speed spectrum.

    Raises:
        InputError: a negative seed, or `batches` outside 1..120 (more would crowd a season's working days).
    """
    if seed < 0:
        raise InputError(f"sample year: seed: got {seed}, expected 0 or more; choose another number")
    if not 1 <= batches <= 120:
        raise InputError(f"sample year: batches: got {batches}, expected 1 to 120; choose a number in that range")
    rng = np.random.default_rng(seed)
    levels = np.linspace(COLDEST_DEGC, WARMEST_DEGC, -(-batches // len(SPEEDS_RPM)))
    taken: set[date] = set()
    plans = []
    for k in range(batches):
        level, position = divmod(k, len(SPEEDS_RPM))
        jitter_K = rng.uniform(-0.8, 0.8) if 0 < level < len(levels) - 1 else 0.0
        start_degC = float(levels[level] + jitter_K)
        day = _working_day(_season_day(start_degC, rising=bool(k % 2), wander=rng.uniform(-4.0, 4.0)), taken)
        # drawn one after the other, always in this order, so that a seed means one year
        minute, extra = int(rng.integers(6 * 60 + 30, 9 * 60 + 30)), float(rng.integers(90, 150)) * 60.0
        plans.append(
            Plan(
                start=datetime(day.year, day.month, day.day) + timedelta(minutes=minute),
                speed_rpm=SPEEDS_RPM[position],
                spectrum=k % 10 == 7,
                cool_down_s=extra if (level + position) % 3 == 1 else 0.0,
                start_degC=start_degC,
                drift_K=float(rng.uniform(*ROOM_DRIFT_K)),
                ripple_period_s=(float(rng.uniform(1500, 3600)), float(rng.uniform(600, 1500))),
                slow_start_K=_slow_start(rng),
                friction=float(rng.uniform(1 - FRICTION_SCATTER, 1 + FRICTION_SCATTER)),
            )
        )
    return sorted(plans, key=lambda p: p.start)


def _slow_start(rng: np.random.Generator) -> dict[str, float]:
    low, high = START_OFFSET_K
    offset_K = {part: low + (high - low) * float(rng.beta(a, a)) for part, a in START_OFFSET_SHAPE.items()}
    column_K = offset_K.pop("column")
    return {**offset_K, "column_front": column_K, "column_back": column_K}


def _season_day(start_degC: float, rising: bool, wander: float) -> int:
    """Day of the year (1..365) on which an unheated shop has this temperature, in spring or in autumn."""
    swing = (start_degC - ANNUAL_MEAN_DEGC) / ((WARMEST_DEGC - COLDEST_DEGC) / 2)
    away = 365 / (2 * np.pi) * np.arccos(np.clip(swing, -1.0, 1.0)) + wander
    return int(round(WARMEST_DAY + (-away if rising else away)) - 1) % 365 + 1


def _working_day(day: int, taken: set[date]) -> date:
    """The nearest weekday that no other batch has."""
    wish = date(YEAR, 1, 1) + timedelta(days=day - 1)
    for away in range(365):
        for found in (wish + timedelta(days=away), wish - timedelta(days=away)):
            if found.year == YEAR and found.weekday() < 5 and found not in taken:
                taken.add(found)
                return found
    raise InputError(f"sample year: no working day left in {YEAR}; ask for fewer batches")


@dataclass(frozen=True)
class Truth:
    """Simulated quantities before any instrument; the longest batch sets S.

    node_degC (S + 1, B, 14), room_degC and speed_rpm (S + 1, B), error_um per channel (S + 1, B).
    """

    node_degC: Array
    room_degC: Array
    speed_rpm: Array
    error_um: dict[str, Array]


def run_plans(plans: Sequence[Plan]) -> Truth:
    """Simulate all batches in one pass, at 10 s."""
    steps = int(max(p.duration_s for p in plans) / STEP_S)
    time_s = np.arange(steps + 1, dtype=np.float64) * np.float64(STEP_S)
    speed_rpm = np.stack([p.speed_at(time_s) for p in plans], axis=1)
    room_degC = np.stack([p.room_at(time_s) for p in plans], axis=1)
    node_degC = simulate(
        speed_rpm[:-1],
        (room_degC[:-1] + room_degC[1:]) / 2,
        np.array([p.floor_degC for p in plans]),
        np.stack([p.start_nodes_degC() for p in plans]),
        np.array([p.friction for p in plans]),
        STEP_S,
    )
    return Truth(node_degC, room_degC, speed_rpm, displacement_um(node_degC - node_degC[0], speed_rpm))


def sensor_degC(true_degC: Array, air_degC: Array, bonding: float) -> Array:
    """Reading of a surface sensor without its offset, along axis 0 at 10-s steps.

    It sees ``T_a + eta (T_s - T_a)`` through a first-order lag of 60 s and starts steady.
    """
    seen = air_degC + bonding * (true_degC - air_degC)
    keep = np.exp(-STEP_S / SENSOR_LAG_S)
    steady = keep * seen[:1]
    return np.asarray(lfilter([1 - keep], [1, -keep], seen, axis=0, zi=steady)[0])


def write_sample_year(folder: Path, seed: int = 0, batches: int = 30) -> list[Path]:
    """Write the year's recordings as CSV files, one a batch, named by date; returns their paths by date.

    The same seed gives the same bytes. Every file starts with a line that calls it simulated. Temperatures are
    in degC to 0.1, displacements in µm to 1, the spindle speed as commanded in rpm, one row every 60 s. Files of
    other names in the folder stay, so give every seed a folder of its own.

    Raises:
        InputError: seed or `batches` out of range, or `folder` cannot be made or written.
    """
    plans = plan_year(seed, batches)
    truth = run_plans(plans)
    shown = {
        name: sensor_degC(
            truth.room_degC if name == "room" else truth.node_degC[..., NODE[name]],
            truth.room_degC,
            SENSOR_BONDING,
        )
        + offset
        for name, offset in SENSOR_OFFSET_K.items()
    }
    every = int(SAMPLE_S / STEP_S)
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for b, plan in enumerate(plans):
            rows = slice(0, int(plan.duration_s / STEP_S) + 1, every)
            probe = np.random.default_rng([seed, plan.start.timetuple().tm_yday])
            temperatures = {k: v[rows, b] for k, v in shown.items()}
            errors = {
                k: v[rows, b] + probe.normal(0.0, PROBE_NOISE_UM, len(v[rows, b])) for k, v in truth.error_um.items()
            }
            head = f"thermodrift sample year, seed {seed}"
            text = csv_text(head, plan, temperatures, truth.speed_rpm[rows, b], errors)
            path = folder / plan.name
            path.write_text(text, encoding="ascii", newline="\n")
            paths.append(path)
    except OSError as error:
        raise InputError(f"sample year: {folder} cannot be written ({error}); give a folder that can be") from None
    return paths


def _stepped(values: Array, step: float) -> Array:
    """Rounded to the instrument's step; + 0.0 turns a negative zero into zero."""
    return np.asarray(np.rint(values / step) * step + 0.0)


def csv_text(
    head: str, plan: Plan, temperatures: Mapping[str, Array], speed_rpm: Array, errors: Mapping[str, Array]
) -> str:
    """A recording with a row per minute, rounded as by the instruments; its first line calls it simulated."""
    columns = [
        [f"{plan.start + timedelta(seconds=k * SAMPLE_S):%Y-%m-%d %H:%M:%S}" for k in range(len(speed_rpm))],
        *([f"{v:.1f}" for v in _stepped(temperatures[n], TEMPERATURE_STEP_K)] for n in SENSOR_OFFSET_K),
        [f"{v:.0f}" for v in speed_rpm],
        *([f"{v:.0f}" for v in _stepped(errors[n], PROBE_STEP_UM)] for n in ("x", "y", "z")),
    ]
    lines = [f"# simulated recording, {head}", ",".join(COLUMNS)]
    return "\n".join([*lines, *(",".join(row) for row in zip(*columns, strict=True))]) + "\n"
