"""The regular grid against brute force and hand-computed cases."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data.errors import InputError
from data.timegrid import repair_time, to_grid


def grid_one(t, v, step_s, max_gap_s=1e9, held=()):
    return to_grid(np.asarray(t, float), {"v": np.asarray(v, float)}, held, step_s, max_gap_s, "run.csv")


def test_finer_grid_interpolates_a_straight_line_exactly():
    rng = np.random.default_rng(1)
    t = np.cumsum(rng.uniform(5, 15, 200))
    t -= t[0]
    out = grid_one(t, 3.0 - 0.25 * t, 10.0)
    assert np.allclose(out.columns["v"], 3.0 - 0.25 * out.time_s, atol=1e-12)
    assert np.array_equal(out.time_s, np.arange(len(out.time_s)) * 10.0)
    assert out.time_s[-1] <= t[-1] < out.time_s[-1] + 10.0


def test_coarser_grid_is_the_mean_of_the_samples_within_half_a_step():
    rng = np.random.default_rng(2)
    t = np.cumsum(rng.uniform(0.5, 1.5, 500))
    t -= t[0]
    v = rng.normal(size=500)
    out = grid_one(t, v, 20.0)
    interval = np.median(np.diff(t))
    assert out.columns["v"][0] == pytest.approx(v[t < interval].mean())
    used = t < interval
    for k in range(1, len(out.time_s)):
        window = (t >= 20.0 * k - 10.0) & (t < 20.0 * k + 10.0)
        used |= window
        assert out.columns["v"][k] == pytest.approx(v[window].mean())
    assert np.array_equal(out.used, used)


def test_first_value_is_the_true_start_of_a_ramp():
    t = np.arange(0, 301.0)
    out = grid_one(t, t, 60.0)
    assert out.columns["v"][0] == 0.0
    assert out.columns["v"][1] == pytest.approx(59.5)  # samples 30 … 89
    assert grid_one(t[::40], t[::40], 60.0).columns["v"][0] == 0.0


def test_nothing_is_invented_across_a_long_hole():
    t = np.concatenate([np.arange(0, 100, 10.0), np.arange(500, 600, 10.0)])
    short = grid_one(t, t, 10.0, max_gap_s=500.0)
    assert np.isfinite(short.columns["v"]).all()
    for held in ((), ("v",)):
        long = grid_one(t, t, 10.0, max_gap_s=100.0, held=held)
        hole = (long.time_s > 90) & (long.time_s < 500)
        assert np.array_equal(np.isnan(long.columns["v"]), hole)
    assert np.array_equal(np.isnan(grid_one(t, t, 50.0, max_gap_s=100.0).columns["v"]),
                          np.isin(np.arange(0, 591, 50), np.arange(150, 500, 50)))  # fmt: skip


def test_a_channel_has_its_own_holes():
    t = np.arange(0, 1000, 10.0)
    v = t.copy()
    v[30:60] = np.nan
    out = to_grid(t, {"v": v, "w": t}, (), 10.0, 100.0, "run.csv")
    assert np.array_equal(np.isnan(out.columns["v"]), (t >= 300) & (t < 600))
    assert np.isfinite(out.columns["w"]).all()
    assert out.channel_gaps == 1
    assert np.isnan(to_grid(t, {"v": v * np.nan, "w": t}, (), 10.0, 100.0).columns["v"]).all()


def test_drivers_hold_their_last_value():
    t = np.array([0.0, 7.0, 13.0, 20.0, 31.0])
    out = grid_one(t, [0, 1000, 2000, 0, 500], 10.0, held=("v",))
    assert out.columns["v"].tolist() == [0, 1000, 0, 0]
    assert out.used.tolist() == [True, True, False, True, False]


def test_equal_times_are_averaged_and_drivers_take_the_last():
    t = np.array([0.0, 10.0, 10.0, 10.0, 20.0])
    v = np.array([0.0, 1.0, 2.0, 6.0, 5.0])
    out = to_grid(t, {"v": v, "rpm": v}, ("rpm",), 10.0, 100.0)
    assert out.columns["v"].tolist() == [0.0, 3.0, 5.0]
    assert out.columns["rpm"].tolist() == [0.0, 6.0, 5.0]
    assert out.used.all()


TENS = np.arange(0, 2000, 10.0)
SWAPPED = np.array([0, 1, 2, 4, 3, 5, 6, 7, 8, 9])
# time column, max_gap_s, repaired times, rows in their order, and counts
REPAIRS: dict[str, tuple[np.ndarray, float, np.ndarray, np.ndarray, dict[str, int]]] = {
    "rows out of order are sorted": (
        TENS[SWAPPED] + 7.0, 60.0, TENS[:10], SWAPPED, {"backward_steps": 1, "clock_restarts": 0}
    ),
    "a second half that is written first": (
        np.roll(TENS, 100), 60.0, TENS, np.roll(np.arange(200), 100), {"clock_restarts": 0}
    ),
    "a restarted clock is carried on one interval later": (
        np.append(TENS[:100], TENS[:50]), 60.0, TENS[:150], np.arange(150), {"clock_restarts": 1, "backward_steps": 1}
    ),
    "a clock that is set back by an hour": (
        np.append(np.arange(0, 7200, 60.0), np.arange(3600, 9000, 60.0)), 300.0, np.arange(210) * 60.0, np.arange(210),
        {"clock_restarts": 1},
    ),
    "times that cannot be read are dropped": (
        np.array([np.nan, 0.0, np.inf, 10.0, 1e300, 20.0]), 60.0, TENS[:3], np.array([1, 3, 5]), {"unparsable_time": 3}
    ),
    "equal times": (np.array([0, 10.0, 10, 10, 20]), 100.0, TENS[[0, 1, 1, 1, 2]], np.arange(5), {"duplicates": 2}),
    "long holes": (
        np.array([0.0, 10, 20, 200, 210, 500]), 100.0, np.array([0.0, 10, 20, 200, 210, 500]), np.arange(6), {"gaps": 2}
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REPAIRS)
def test_a_time_column_is_repaired(what: str):
    t, max_gap_s, time_s, order, counts = REPAIRS[what]
    repaired = repair_time(t, max_gap_s)
    assert np.array_equal(repaired.time_s, time_s) and np.array_equal(repaired.order, order)
    assert repaired.start == t[order[0]] and repaired.counts | counts == repaired.counts


@pytest.mark.parametrize("row", [0, 17, 99])
@pytest.mark.parametrize("wrong", [1e7, -1e7])
def test_lone_wrong_time_is_dropped(row: int, wrong: float):
    t = np.arange(100.0)
    t[row] = wrong
    repaired = repair_time(t, 60.0)
    assert repaired.counts["time_outliers"] == 1
    assert row not in repaired.order
    assert np.ptp(repaired.time_s) <= 99.0


def test_time_in_minutes_meets_the_last_grid_point():
    t = np.arange(0, 11) * 0.1 * 60.0  # 60 s is 59.99999999999999 here or there
    assert grid_one(t, t, 6.0).columns["v"] == pytest.approx(np.arange(11) * 6.0)


@pytest.mark.parametrize(
    ("t", "words"),
    [
        ([0.0, 5.0], "2 usable rows over 5 s, expected at least 2 rows over one step of 60 s"),
        (np.arange(10) * 600.0, "samples are 600 s apart but recording.max_gap_s is 300 s"),
        (np.append(np.arange(100.0), [2e8, 4e8, 5e8, 6e8]), "grid rows of 60 s; correct recording.time.unit"),
    ],
)
def test_times_that_make_no_grid_are_told_in_one_line(t, words):
    with pytest.raises(InputError, match=words) as caught:
        grid_one(t, t, 60.0, max_gap_s=300.0)
    assert "\n" not in str(caught.value)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.1, 30.0), min_size=12, max_size=60),
    st.sampled_from([5.0, 20.0, 60.0]),
    st.randoms(use_true_random=False),
)
def test_order_of_the_rows_does_not_matter(steps, step_s, random):
    t = np.concatenate([[0.0], np.cumsum(np.round(steps, 3))])
    v = np.sin(t)
    rows = list(range(len(t)))
    for _ in range(5):  # neighbours swapped: steps back stay below max_gap_s
        i = random.randrange(len(rows) - 1)
        rows[i], rows[i + 1] = rows[i + 1], rows[i]
    if t[-1] < step_s:
        return
    mixed = repair_time(t[rows], 1000.0)
    got = to_grid(mixed.time_s, {"v": v[rows][mixed.order]}, (), step_s, 1000.0)
    expected = to_grid(t, {"v": v}, (), step_s, 1000.0)
    assert np.allclose(got.columns["v"], expected.columns["v"], atol=1e-12)
    assert got.used.sum() == expected.used.sum()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from([7.0, 25.0, 90.0]), st.sampled_from([40.0, 400.0]))
def test_only_used_rows_matter(seed: int, step_s: float, max_gap_s: float):
    """A row that is reported as unused can hold anything without changing the grid."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(np.where(rng.random(80) < 0.05, 200.0, rng.uniform(1, 20, 80)))
    t -= t[0]
    v = rng.normal(size=(2, 80))
    v[0, rng.random(80) < 0.2] = np.nan
    out = to_grid(t, {"a": v[0], "rpm": v[1]}, ("rpm",), step_s, max_gap_s)
    v[:, ~out.used] += 1000.0
    again = to_grid(t, {"a": v[0], "rpm": v[1]}, ("rpm",), step_s, max_gap_s)
    assert np.array_equal(out.columns["a"], again.columns["a"], equal_nan=True)
    assert np.array_equal(out.columns["rpm"], again.columns["rpm"], equal_nan=True)
