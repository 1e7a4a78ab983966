"""Readings along an axis: their sweeps, and the rows that they take, against cases worked out by hand."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data.errors import InputError
from data.sweeps import Readings, position_bins, sweep_numbers


def readings(time_s, position, error) -> Readings:
    t, p, e = (np.asarray(v, float) for v in (time_s, position, error))
    return Readings("x_at", t, p, {"x": e}, np.arange(len(t)))


def test_positions_that_a_laser_sees_twice_are_one_position() -> None:
    there, back = np.linspace(0, 180, 12) + 2e-4, np.linspace(180, 0, 12) - 3e-4
    bins = position_bins(np.concatenate([there, back]))
    assert bins[:12].tolist() == bins[12:][::-1].tolist() and len(set(bins)) == 12
    assert position_bins(np.full(3, 7.0)).tolist() == [0, 0, 0] and position_bins(np.empty(0)).tolist() == []


@pytest.mark.parametrize(
    ("time_min", "position", "sweeps"),
    [
        ([0, 0, 0, 30, 30, 30], [0, 90, 180, 0, 90, 180], [0, 0, 0, 1, 1, 1]),  # one stamp a sweep
        ([0, 1, 2, 30, 31, 32], [0, 90, 180, 180, 90, 0], [0, 0, 0, 1, 1, 1]),  # every other one backward
        ([0, 1, 2, 30, 31, 32], [0, 90, 180, 0, 180, 90], [0, 0, 0, 1, 1, 1]),
        ([0, 1, 2, 3, 4, 30], [0, 90, 180, 180, 90, 0], [0, 0, 0, 0, 1, 1]),  # the turn at 180 belongs to the way there
        ([0, 1, 2, 3, 30, 31], [0, 0, 90, 180, 0, 90], [0, 0, 0, 0, 1, 1]),  # a dwell
        ([0, 9, 10, 11, 30, 31], [0, 90, 120, 180, 0, 90], [0, 0, 0, 0, 1, 1]),  # a break within a sweep ends none
        ([0, 10, 20, 30], [0, 180, 0, 180], [0, 0, 1, 1]),  # two ends, again and again
        ([0], [90], [0]),
        ([], [], []),
    ],
)
def test_a_sweep_ends_where_a_position_comes_back(time_min, position, sweeps) -> None:
    assert sweep_numbers(60.0 * np.array(time_min), np.array(position, float)).tolist() == sweeps


def test_readings_with_stamps_of_their_own_stand_at_them() -> None:
    out = readings([0, 12, 21, 95, 104], [0, 90, 180, 0, 90], [1, 2, 3, 4, 5]).on_grid(10.0, 12, 30.0, "a.csv")
    nan = np.nan
    assert np.array_equal(out["x_at"], [0, 90, 180, *[nan] * 6, 0, 90, nan], equal_nan=True)
    assert np.array_equal(out["x"], [1, 2, 3, *[nan] * 6, 4, 5, nan], equal_nan=True)


def test_a_sweep_under_one_stamp_lies_around_it_and_inside_the_recording() -> None:
    five = np.arange(5.0)
    r = readings(np.repeat([0.0, 200, 390], 5), np.tile(five, 3), np.arange(15.0))
    out = r.on_grid(10.0, 40, 60.0, "a.csv")
    rows = np.flatnonzero(np.isfinite(out["x"]))
    # the first begins at 0 s and the last ends with the recording; the one between stands 20 s to both sides
    assert rows.tolist() == [0, 1, 2, 3, 4, 18, 19, 20, 21, 22, 35, 36, 37, 38, 39]
    assert out["x"][rows].tolist() == list(range(15)) and out["x_at"][rows].tolist() == np.tile(five, 3).tolist()


def test_readings_of_one_position_in_one_row_are_averaged() -> None:
    both_ways = readings([0] * 5 + [100] * 5, [0, 9, 18, 9, 0] * 2, [0, 1, 2, 3, 4, 10, 11, 12, 13, 14])
    out = both_ways.on_grid(10.0, 20, 60.0, "a.csv")
    there = np.isfinite(out["x"])
    assert out["x_at"][there].tolist() == [0, 9, 18, 0, 9, 18] and out["x"][there].tolist() == [2, 2, 2, 12, 12, 12]
    dwell = readings([0, 1, 2, 10, 11, 12], [0, 0, 0, 9, 9, 9], [3, np.nan, 5, 7, 8, 9]).on_grid(10.0, 3, 60.0, "a.csv")
    assert dwell["x"][:2].tolist() == [4, 8] and dwell["x_at"][:2].tolist() == [0, 9]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 300), min_size=1, max_size=6, unique=True), st.integers(1, 9), st.booleans())
def test_no_reading_is_lost_or_moved_past_another(starts, n, one_stamp) -> None:
    stamps = np.sort(np.array(starts, float))
    time_s = np.repeat(stamps, n) if one_stamp else np.sort(np.concatenate([stamps + 1000 * k for k in range(n)]))
    positions = np.tile(np.arange(n, dtype=float), len(starts))
    error = np.arange(len(time_s), dtype=float)
    n_rows = len(time_s) + 1000
    out = readings(time_s, positions, error).on_grid(1.0, n_rows, 1e9, "a.csv")
    kept = out["x"][np.isfinite(out["x"])]
    assert np.all(np.diff(kept) > 0)
    if n == 1 or one_stamp:
        assert kept.tolist() == error.tolist()


def test_the_rows_are_the_nearest_in_the_sum_of_squares() -> None:
    time_s = np.array([0.0, 3, 3, 3, 4])
    out = readings(time_s, [0, 1, 2, 3, 4], range(5)).on_grid(1.0, 8, 60.0, "a.csv")
    rows = np.flatnonzero(np.isfinite(out["x"]))
    best = min(combinations(range(8), 5), key=lambda r: float(((np.array(r) - time_s) ** 2).sum()))
    assert float(((rows - time_s) ** 2).sum()) == float(((np.array(best) - time_s) ** 2).sum())


def test_a_step_too_long_for_sweeps_is_one_clear_line() -> None:
    twelve = readings(np.zeros(12), np.arange(12.0), np.arange(12.0))
    with pytest.raises(InputError, match=r"^a.csv: 12 readings along x_at for 9 rows: recording.step_s is 60 s; lower"):
        twelve.on_grid(60.0, 9, 300.0, "a.csv")
    with pytest.raises(
        InputError,
        match=r"a reading along x_at would stand 660 s from its time, expected at most recording.max_gap_s \(300 s\): "
        "recording.step_s is 60 s; lower it, a sweep takes one row for each position",
    ):
        twelve.on_grid(60.0, 90, 300.0, "a.csv")
