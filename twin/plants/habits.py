"""What some shops always do: drivers, hours or walls that go together, so that recordings cannot part them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from data.registry import Registry
from twin.plants.runs import STANDING_S, Block, Run

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


def long_runs(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """The spindle is switched on once and runs on to the end of the shift, from a machine at rest."""
    out = []
    for run in runs:
        fastest = max((b.value for b in run.speed), default=0.0)
        out.append(replace(run, speed=(Block(STANDING_S, fastest),) if fastest else ()))
    return out


def walls_as_room(runs: Sequence[Run], rated_rpm: float) -> list[Run]:
    """Walls inside a bigger hall: as warm as the room, all day."""
    return [replace(run, wall_K=0.0, wall_swing=1.0, wall_late_h=0.0) for run in runs]


LONG_AGO_S = -1e6

HABITS = Registry(
    "habit",
    {
        "ordinary": "twin.plants.habits:ordinary",
        "coolant_always": "twin.plants.habits:coolant_always",
        "one_speed": "twin.plants.habits:one_speed",
        "long_runs": "twin.plants.habits:long_runs",
        "walls_as_room": "twin.plants.habits:walls_as_room",
    },
)
