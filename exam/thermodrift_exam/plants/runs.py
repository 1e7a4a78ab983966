"""Runs of a machine in a shop: protocols of speed, feed and coolant, seasons, the hours before a batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from data.arrays import Array
from thermodrift_exam.plants.options import Options, stream

GROUND_MEAN_DEGC, GROUND_FOLLOWS = 18.0, 0.5
STANDING_S = 300.0


@dataclass(frozen=True)
class Block:
    """A driver's value from a time on, s from the batch's start."""

    from_s: float
    value: float


@dataclass(frozen=True)
class Run:
    """The schedule of one batch. Room: mean, day's swing with its warmest hour, ripple and drift.

    `idle` are recorded switches that drive nothing, by channel.
    """

    start: pd.Timestamp
    hours: float
    speed: tuple[Block, ...]
    feed: tuple[Block, ...]
    coolant: tuple[Block, ...]
    room_mean_degC: float
    day_K: float
    warmest_h: float
    ripple_K: float
    ripple_s: tuple[float, float]
    wall_K: float  # of the walls against the room's mean, their own day's swing is smaller and later
    slow_K: float  # castings against the room, hours before the batch
    friction: float
    idle: Mapping[str, tuple[Block, ...]] = field(default_factory=dict)
    wall_swing: float = 1.0 / 3.0  # of the room's over the day, and by how much later
    wall_late_h: float = 3.0

    @property
    def batch_id(self) -> str:
        return f"{self.start:%Y%m%d_%H%M}"

    @property
    def clock_h(self) -> float:
        """Time of day at the start, h."""
        return self.start.hour + self.start.minute / 60.0

    def room_degC(self, time_s: Array) -> Array:
        """At times from the batch's start, s, negative ones included."""
        phase = 2 * np.pi * (self.clock_h + time_s / 3600.0 - self.warmest_h) / 24.0
        one, other = (np.sin(2 * np.pi * time_s / p) for p in self.ripple_s)
        ripple = (one + other) * self.ripple_K / 2
        return np.asarray(self.room_mean_degC + self.day_K * np.cos(phase) + ripple)

    def wall_degC(self, time_s: Array) -> Array:
        """Of the hall's walls: nearer to what is outside, with less of the room's swing, later."""
        phase = 2 * np.pi * (self.clock_h + time_s / 3600.0 - self.warmest_h - self.wall_late_h) / 24.0
        return np.asarray(self.room_mean_degC + self.wall_K + self.day_K * self.wall_swing * np.cos(phase))

    def ground_degC(self) -> float:
        """Under the floor: follows the season by half, and not the day."""
        first = float(self.room_degC(np.zeros(1))[0])
        return GROUND_MEAN_DEGC + GROUND_FOLLOWS * (first - GROUND_MEAN_DEGC)


def held(blocks: tuple[Block, ...], time_s: Array) -> Array:
    """A driver at times, s; 0 before its first block."""
    starts = np.array([b.from_s for b in blocks])
    values = np.array([0.0, *(b.value for b in blocks)])
    return values[np.searchsorted(starts, np.asarray(time_s) + 1e-6, side="right")]


def plan_runs(seed: int, options: Options, rated_rpm: float) -> list[Run]:
    """The batches of a case, by date. Drivers change on rows of the recording, every `options.step_s`."""
    rng = stream(seed, "runs")
    switches = {name: stream(seed, f"idle {name}") for name in options.idle}
    batches, end_s, row_s = options.batches, options.hours * 3600.0, options.step_s
    season_degC = options.coldest_degC, options.warmest_degC
    levels = rng.permutation(np.linspace(*season_degC, batches))
    kinds = rng.permutation(np.arange(batches) % len(PROTOCOLS))
    days = rng.choice(60, batches, replace=False)
    runs: list[Run] = []
    taken: set[pd.Timestamp] = set()
    for k in range(batches):
        mean_degC = float(levels[k] + rng.uniform(-0.6, 0.6))
        minute = int(rng.integers(round(60 * options.earliest_h), round(60 * options.latest_h)))
        start = _season_day(mean_degC, season_degC, int(days[k])) + pd.Timedelta(minutes=minute)
        while start.normalize() in taken:  # one batch a day
            start += pd.Timedelta(days=1)
        taken.add(start.normalize())
        run = Run(
            start=start,
            hours=options.hours,
            speed=(*_shift_before(rng, rated_rpm), *PROTOCOLS[kinds[k]](rng, end_s, rated_rpm)),
            feed=_strokes(rng, end_s, lambda: float(rng.integers(4, 17)) * 500.0, idle=0.35),
            coolant=_strokes(rng, end_s, lambda: 1.0, idle=0.35),
            room_mean_degC=mean_degC,
            day_K=float(rng.uniform(0.5, 3.0)),
            warmest_h=float(rng.uniform(14.0, 17.0)),
            ripple_K=float(rng.uniform(0.1, 0.4)),
            ripple_s=(float(rng.uniform(1500, 4000)), float(rng.uniform(600, 1500))),
            wall_K=float(0.35 * (mean_degC - 22.0) + rng.uniform(-2.5, 1.5)),
            slow_K=float(rng.uniform(-2.0, 3.0)),
            friction=float(1.0 + options.friction_scatter * rng.uniform(-1.0, 1.0)),
            idle={n: _on_rows(_strokes(dice, end_s, lambda: 1.0, idle=0.35), row_s) for n, dice in switches.items()},
        )
        speed, feed, coolant = (_on_rows(blocks, row_s) for blocks in (run.speed, run.feed, run.coolant))
        runs.append(replace(run, speed=speed, feed=feed, coolant=coolant))
    return sorted(runs, key=lambda r: r.start)


def earlier(run: Run, by_s: float) -> Run:
    """The run with every change of its drivers so much sooner."""

    def sooner(blocks: tuple[Block, ...]) -> tuple[Block, ...]:
        return tuple(replace(b, from_s=b.from_s - by_s) for b in blocks)

    idle = {name: sooner(blocks) for name, blocks in run.idle.items()}
    return replace(run, speed=sooner(run.speed), feed=sooner(run.feed), coolant=sooner(run.coolant), idle=idle)


def _on_rows(blocks: tuple[Block, ...], row_s: float) -> tuple[Block, ...]:
    """A recording holds a driver from row to row: blocks begin on one, and a later one of the same row counts."""
    at = {row_s * round(b.from_s / row_s): b.value for b in blocks}
    return tuple(Block(t, v) for t, v in sorted(at.items()))


def _season_day(mean_degC: float, season_degC: tuple[float, float], day: int) -> pd.Timestamp:
    """A day of the year that fits the room's mean, spring or autumn, every `day` another."""
    coldest, warmest = season_degC
    middle, swing = (coldest + warmest) / 2, (warmest - coldest) / 2
    away = 365 / (2 * np.pi) * np.arccos(np.clip((mean_degC - middle) / swing, -1.0, 1.0))
    number = 196 + (away if day % 2 else -away) + day / 6.0 - 5.0
    return pd.Timestamp("2026-01-01") + pd.Timedelta(days=int(number) % 365)


def _shift_before(rng: np.random.Generator, rated_rpm: float) -> tuple[Block, ...]:
    """In half of the batches the spindle has run in the hours before, and stopped."""
    hours = rng.uniform(3.0, 8.0), rng.uniform(0.7, 2.5)
    speed = float(np.round(rng.uniform(0.3, 0.9) * rated_rpm, -2))
    return (Block(-3600.0 * hours[0], speed), Block(-3600.0 * hours[1], 0.0)) if rng.random() < 0.5 else ()


def _speed(rng: np.random.Generator, rated_rpm: float, low: float = 0.15) -> float:
    return float(np.round(rng.uniform(low, 1.0) * rated_rpm, -2))


def _constant(rng: np.random.Generator, end_s: float, rated_rpm: float) -> tuple[Block, ...]:
    return (Block(STANDING_S, _speed(rng, rated_rpm, 0.5)),)


def _cool_down(rng: np.random.Generator, end_s: float, rated_rpm: float) -> tuple[Block, ...]:
    return (Block(STANDING_S, _speed(rng, rated_rpm, 0.6)), Block(end_s * rng.uniform(0.4, 0.6), 0.0))


def _steps(rng: np.random.Generator, end_s: float, rated_rpm: float) -> tuple[Block, ...]:
    edges = np.cumsum(rng.uniform(1200.0, 4500.0, 20))
    speeds = [_speed(rng, rated_rpm) * (rng.random() > 0.2) for _ in range(21)]
    starts = [STANDING_S, *edges + STANDING_S]
    return tuple(Block(t, v) for t, v in zip(starts, speeds, strict=True) if t < end_s)


def _staircase(rng: np.random.Generator, end_s: float, rated_rpm: float) -> tuple[Block, ...]:
    stairs = np.round(np.linspace(0.2, 1.0, int(rng.integers(3, 6))) * rated_rpm, -2)
    edges = np.linspace(STANDING_S, end_s * rng.uniform(0.75, 1.0), len(stairs) + 1)
    return (*(Block(float(t), float(v)) for t, v in zip(edges[:-1], stairs, strict=True)), Block(float(edges[-1]), 0.0))


def _spectrum(rng: np.random.Generator, end_s: float, rated_rpm: float) -> tuple[Block, ...]:
    times = np.arange(STANDING_S, end_s, 900.0)
    return tuple(Block(float(t), _speed(rng, rated_rpm)) for t in times)


def _stand_still(rng: np.random.Generator, end_s: float, rated_rpm: float) -> tuple[Block, ...]:
    return ()


PROTOCOLS = (_steps, _constant, _cool_down, _staircase, _stand_still, _spectrum)


def _strokes(rng: np.random.Generator, end_s: float, value: Callable[[], float], idle: float) -> tuple[Block, ...]:
    """On and off by turns of 15 to 70 minutes; in a share `idle` of the batches not at all."""
    rests = rng.random() < idle
    edges = np.cumsum(rng.uniform(900.0, 4200.0, 30))
    blocks = tuple(Block(float(t), value() if k % 2 == 0 else 0.0) for k, t in enumerate(edges) if t < end_s)
    return () if rests else blocks


@dataclass(frozen=True)
class Now:
    """One moment of B batches: time from their starts in s, everything else (B,)."""

    time_s: float
    speed_rpm: Array
    feed_mm_per_min: Array
    coolant: Array
    room_degC: Array
    wall_degC: Array
    ground_degC: Array
    clock_h: Array

    def driver(self, channel: str) -> Array:
        """A driver by the name of its channel."""
        return {"spindle_rpm": self.speed_rpm, "feed": self.feed_mm_per_min, "coolant": self.coolant}[channel]


def moments(runs: Sequence[Run], step_from_s: Array, at_s: Array) -> list[Now]:
    """Conditions at `at_s` (M,); drivers are those that hold in the steps that begin at `step_from_s` (M,)."""
    drivers = {n: np.stack([held(getattr(r, n), step_from_s) for r in runs], 1) for n in ("speed", "feed", "coolant")}
    room, wall = (np.stack([getattr(r, f"{n}_degC")(at_s) for r in runs], 1) for n in ("room", "wall"))
    ground = np.array([r.ground_degC() for r in runs])
    clock = (np.array([r.clock_h for r in runs]) + at_s[:, None] / 3600.0) % 24.0
    rows = zip(at_s, drivers["speed"], drivers["feed"], drivers["coolant"], room, wall, clock, strict=True)
    return [Now(float(t), n, f, c, r, w, ground, h) for t, n, f, c, r, w, h in rows]
