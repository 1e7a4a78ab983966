"""What shops always do: each habit changes what it says and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from thermodrift_exam.plants.drawing import HABITS
from thermodrift_exam.plants.options import Options
from thermodrift_exam.plants.runs import Run, earlier, held, plan_runs

RATED_RPM = 8000.0
ROWS_S = np.arange(0.0, 6 * 3600.0 + 1.0, 300.0)
TOUCHED = {
    "ordinary": set(), "coolant_always": {"coolant"}, "one_speed": {"speed"}, "long_runs": {"speed"},
    "walls_as_room": {"wall_K", "wall_swing", "wall_late_h"},
}  # fmt: skip


def runs() -> list[Run]:
    return plan_runs(
        2**128 + 3,
        Options(coldest_degC=5.0, warmest_degC=25.0, earliest_h=7.0, latest_h=9.0, idle=("lamp",)),
        RATED_RPM,
    )


@pytest.mark.parametrize("habit", HABITS)
def test_a_habit_touches_what_it_says_and_nothing_else(habit: str) -> None:
    before = runs()
    after = HABITS[habit](before, RATED_RPM)
    for one, other in zip(before, after, strict=True):
        kept = {name: getattr(one, name) for name in TOUCHED[habit]}
        assert replace(other, **kept) == one
    assert (after == before) == (habit == "ordinary")


def test_the_pump_runs_throughout_and_before() -> None:
    for run in HABITS["coolant_always"](runs(), RATED_RPM):
        assert held(run.coolant, np.r_[-36e3, ROWS_S]).min() == 1.0


def test_one_speed_keeps_when_the_spindle_turns() -> None:
    for one, other in zip(runs(), HABITS["one_speed"](runs(), RATED_RPM), strict=True):
        before, after = held(one.speed, ROWS_S), held(other.speed, ROWS_S)
        assert set(after) <= {0.0, 5600.0}
        assert ((before > 0) == (after > 0)).all()


def test_a_long_run_starts_once_and_never_stops() -> None:
    turning = [held(run.speed, ROWS_S) for run in HABITS["long_runs"](runs(), RATED_RPM)]
    assert all(np.count_nonzero(np.diff(speed)) <= 1 for speed in turning)
    assert sum(speed[-1] > 0 for speed in turning) >= 8


def test_walls_are_as_warm_as_the_room_but_for_its_ripple() -> None:
    for run in HABITS["walls_as_room"](runs(), RATED_RPM):
        assert np.abs(run.wall_degC(ROWS_S) - run.room_degC(ROWS_S)).max() <= run.ripple_K


def test_the_season_and_the_hours_are_those_asked_for() -> None:
    planned = runs()
    assert all(4.4 <= run.room_mean_degC <= 25.6 and 7.0 <= run.clock_h < 9.0 for run in planned)
    assert len({run.start.normalize() for run in planned}) == 12
    assert {name for run in planned for name in run.idle} == {"lamp"}


def test_earlier_moves_every_driver_and_no_more() -> None:
    for one in runs():
        other = earlier(one, 20.0)
        for name in ("speed", "feed", "coolant"):
            np.testing.assert_array_equal(held(getattr(other, name), ROWS_S - 20.0), held(getattr(one, name), ROWS_S))
        assert replace(other, speed=one.speed, feed=one.feed, coolant=one.coolant, idle=one.idle) == one
