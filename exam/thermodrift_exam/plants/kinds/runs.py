"""Runs of any kind: protocols of any driver, days of the year, the air, what the machine did before."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from data.arrays import Array
from thermodrift_exam.plants.kinds.plant import Dice, Driver, KindPlant
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.runs import Block, held

GROUND_MEAN_DEGC = 14.0


@dataclass(frozen=True)
class KindRun:
    """One run: drivers as blocks (also before its start), air by name as functions of the time from its start, s.

    `slow_K`: what the heavy bodies were above the air hours before. `scatter` multiplies every heat.
    """

    start: pd.Timestamp
    hours: float
    blocks: Mapping[str, tuple[Block, ...]]
    air: Mapping[str, Callable[[Array], Array]]
    mean_degC: float
    slow_K: float
    scatter: float

    @property
    def batch_id(self) -> str:
        return f"{self.start:%Y%m%d_%H%M}"

    @property
    def clock_h(self) -> float:
        return self.start.hour + self.start.minute / 60.0

    @property
    def ground_degC(self) -> float:
        """Under the floor: between a yearly mean and the mean of this day's air."""
        return GROUND_MEAN_DEGC + 0.4 * (self.mean_degC - GROUND_MEAN_DEGC)


@dataclass(frozen=True)
class Air:
    """A day's course with two ripples and a straight drift."""

    mean_degC: float
    day_K: float
    warmest_h: float
    clock_h: float
    ripple_K: float
    ripple_s: float
    drift_K_per_h: float = 0.0

    def __call__(self, time_s: Array) -> Array:
        phase = 2 * np.pi * (self.clock_h + time_s / 3600.0 - self.warmest_h) / 24.0
        ripple = np.sin(2 * np.pi * time_s / self.ripple_s) + 0.6 * np.sin(2 * np.pi * time_s / (0.37 * self.ripple_s))
        drift = self.drift_K_per_h * np.clip(time_s, 0.0, None) / 3600.0
        return np.asarray(self.mean_degC + self.day_K * np.cos(phase) + self.ripple_K * ripple / 1.6 + drift)


def plan_runs(plant: KindPlant, seed: int, runs: int | None = None) -> list[KindRun]:
    """The runs of a case by date, one a day. Drivers change on rows of the recording."""
    s, n = plant.setting, runs or plant.setting.runs
    dice = Dice(stream(seed, "kind runs"))
    levels = dice.rng.permutation(np.linspace(*s.room_degC, n))
    days = np.sort(dice.rng.choice(330, n, replace=False))
    order = dice.rng.permutation(n)
    warmest_h = dice.even(14.0, 17.0)
    out = []
    for k in range(n):
        start = pd.Timestamp("2025-01-07") + pd.Timedelta(days=int(days[k]), minutes=dice.whole(390, 800))
        hours = s.row_s * round(3600.0 * dice.even(*s.hours) / s.row_s) / 3600.0
        blocks = {}
        for name, driver in plant.drivers.items():
            own = stream(seed, f"driver {name} {k}")
            drawn = _on_rows(driver.draw(own, int(order[k]), hours * 3600.0), s.row_s)
            blocks[name] = (*_before(own, driver), *drawn)
        out.append(
            KindRun(
                start, hours, blocks, airs(plant, dice, float(levels[k]), start, warmest_h),
                float(levels[k]), dice.even(-1.0, 1.0) * s.slow_K, 1.0 + s.scatter * dice.even(-1.0, 1.0),
            )
        )  # fmt: skip
    return out


def airs(
    plant: KindPlant, dice: Dice, mean_degC: float, start: pd.Timestamp, warmest_h: float
) -> dict[str, Callable[[Array], Array]]:
    """The room by its day; walls by less of it, later, nearer to what is outside; an inlet that a chiller holds."""
    s, clock_h = plant.setting, start.hour + start.minute / 60.0
    ripple_s, drift = s.ripple_s * dice.span(0.7, 1.4), dice.even(-0.15, 0.15) * s.day_K
    swing = s.day_K * dice.even(0.4, 1.2)
    room = Air(mean_degC, swing, warmest_h, clock_h, s.ripple_K, ripple_s, drift)
    outside = 0.25 * (mean_degC - sum(s.room_degC) / 2) + dice.even(-2.0, 1.0)
    wall = Air(mean_degC + outside, 0.35 * swing, warmest_h + 4.0, clock_h, 0.0, 1e4)
    held_degC = 20.0 + 0.15 * (mean_degC - 20.0) + dice.even(-1.0, 1.0)
    inlet = Air(held_degC, 0.0, 0.0, 0.0, dice.span(0.1, 0.6), dice.span(150.0, 900.0))
    return {name: {"wall": wall, "inlet": inlet}.get(name, room) for name in plant.airs}


def _before(rng: np.random.Generator, driver: Driver) -> tuple[Block, ...]:
    """In half of the runs of what warms: a shift that ended some time before."""
    used, since_h, length_h = rng.random() < 0.5, rng.uniform(0.3, 2.5), rng.uniform(1.0, 5.0)
    if not driver.history or not used:
        return ()
    level = float(np.round(rng.uniform(0.3, 0.9) * driver.high, 3))
    return (Block(-3600.0 * (since_h + length_h), level), Block(-3600.0 * since_h, 0.0))


def _on_rows(blocks: Sequence[Block], row_s: float) -> tuple[Block, ...]:
    at = {row_s * round(b.from_s / row_s): b.value for b in blocks}
    return (Block(0.0, 0.0), *(Block(t, v) for t, v in sorted(at.items()) if t > 0))


Drawn = Callable[[np.random.Generator, int, float], tuple[Block, ...]]


def worked(low: float, high: float, rest_s: float, hold_share: tuple[float, float], round_to: float) -> Drawn:
    """The driver that a run is about: a protocol by its number, levels from `low` to `high`.

    It rests for `rest_s` first; a level of a random spectrum lasts a share `hold_share` of the run.
    """

    def level(rng: np.random.Generator, least: float = 0.0) -> float:
        return float(np.round(rng.uniform(max(low, least * high), high) / round_to) * round_to)

    def draw(rng: np.random.Generator, number: int, end_s: float) -> tuple[Block, ...]:
        name = ("steps", "constant", "cool_down", "staircase", "spectrum", "still")[number % 6]
        if name == "still" and rng.random() < 0.3:
            return ()
        if name == "constant":
            return (Block(rest_s, level(rng, 0.4)),)
        if name == "cool_down":
            return (Block(rest_s, level(rng, 0.55)), Block(end_s * rng.uniform(0.35, 0.6), 0.0))
        if name == "staircase":
            stairs = np.linspace(low + 0.1 * (high - low), high, int(rng.integers(3, 6)))
            edges = np.linspace(rest_s, end_s * rng.uniform(0.7, 1.0), len(stairs) + 1)
            values = [*(np.round(stairs / round_to) * round_to), 0.0]
            return tuple(Block(float(t), float(v)) for t, v in zip(edges, values, strict=True))
        longer = 3.0 if name == "steps" else 1.0
        edges = rest_s + np.cumsum(np.r_[0.0, rng.uniform(*hold_share, 60) * longer * end_s])
        return tuple(Block(float(t), level(rng) * (rng.random() > 0.2)) for t in edges if t < end_s)

    return draw


def strokes(values: Callable[[np.random.Generator], float], turn_s: tuple[float, float], idle: float = 0.25) -> Drawn:
    """On by turns; in a share `idle` of the runs not at all."""

    def draw(rng: np.random.Generator, number: int, end_s: float) -> tuple[Block, ...]:
        rests = rng.random() < idle
        edges = np.cumsum(rng.uniform(*turn_s, 80))
        blocks = tuple(
            Block(float(t), float(values(rng)) if k % 2 == 0 else 0.0) for k, t in enumerate(edges) if t < end_s
        )
        return () if rests else blocks

    return draw


def switch(turn_s: tuple[float, float], idle: float = 0.25) -> Driver:
    """A recorded switch."""
    return Driver("1", 0.0, 1.0, strokes(lambda rng: 1.0, turn_s, idle), 1.0)


@dataclass(frozen=True)
class Now:
    """One moment of C columns: drivers, air and ground as (C,), time from the runs' starts in s."""

    time_s: float
    drive: Mapping[str, Array]
    air_degC: Mapping[str, Array]
    ground_degC: Array
    clock_h: Array


def driven(runs: Sequence[KindRun], channels: Sequence[str], at_s: Array) -> dict[str, Array]:
    """Drivers that hold from `at_s` (M,) on, (M, B) each."""
    return {n: np.stack([held(r.blocks.get(n, ()), at_s) for r in runs], axis=1) for n in channels}
