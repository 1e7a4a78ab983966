"""What some shops always do: drivers, hours or walls that go together, so that recordings cannot part them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import pandas as pd

from data.registry import Registry
from twin.plants.runs import Block, Run

Habit = Callable[[Sequence[Run], float], list[Run]]  # runs, rated speed in rpm


def ordinary(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """Nothing of the kind."""
    return list(runs)


def coolant_always(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """The pump is never switched off."""
    return [replace(run, coolant=(Block(LONG_AGO_S, 1.0),)) for run in runs]


def one_speed(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """The spindle turns at 0.7 of its rated speed or rests."""
    speed_rpm = round(0.7 * rated_rpm, -2)
    return [replace(run, speed=tuple(replace(b, value=speed_rpm * (b.value > 0)) for b in run.speed)) for run in runs]


def same_hour(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """Every run starts at the hour at which the first one does."""
    since = runs[0].start - runs[0].start.normalize()
    return [replace(run, start=pd.Timestamp(run.start.normalize() + since)) for run in runs]


LONG_AGO_S = -1e6

HABITS = Registry(
    "habit",
    {
        "ordinary": "twin.plants.habits:ordinary",
        "coolant_always": "twin.plants.habits:coolant_always",
        "one_speed": "twin.plants.habits:one_speed",
        "same_hour": "twin.plants.habits:same_hour",
    },
)
