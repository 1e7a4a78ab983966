"""Many batches, cuts and parameter sets in one pass equal each one alone; and what cannot be used is told."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_network import Toy, one_schedule

from data.errors import InputError
from twin.simulation import response as response_module
from twin.simulation.response import Response, Schedule


def test_padding_does_not_leak() -> None:
    toy = Toy(5)
    n_rows = np.array([37, 60, 0, 1])
    dt, regime = np.full((4, 60), 10.0), toy.rng.integers(0, 2, (4, 60))
    series, start = toy.series(4, 60), toy.rng.normal(20, 3, (1, 4, 4))
    for b, n in enumerate(n_rows):
        dt[b, n:], regime[b, n:], series[:, :, b, n:] = np.nan, 99, np.nan
    together = toy.temperatures(Schedule(dt, regime, n_rows), series, start)
    assert np.isfinite(together).all()
    for b, n in enumerate(n_rows):
        alone = toy.temperatures(
            Schedule(dt[b : b + 1, :n], regime[b : b + 1, :n]), series[:, :, b : b + 1, :n], start[:, b : b + 1]
        )
        assert together[0, b, : n + 1] == pytest.approx(alone[0, 0], rel=1e-13)
        assert (together[0, b, n:] == together[0, b, n]).all()  # the last valid value is held


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    n_intervals=st.integers(1, 70),
    every=st.integers(1, 7),
    n_steps=st.integers(1, 80),
    runs=st.integers(1, 30),
)
def test_every_kth_border_is_the_subsampled_run_and_any_cut_is_right(
    seed: int, n_intervals: int, every: int, n_steps: int, runs: int
) -> None:
    toy = Toy(seed, n_nodes=3, n_regimes=3)
    rng = toy.rng
    dt = rng.uniform(1, 100, n_steps)[np.repeat(rng.integers(0, n_steps, (2, 70)), runs, axis=1)[:, :n_intervals]]
    regime = np.repeat(rng.integers(0, 3, (2, 70)), runs, axis=1)[:, :n_intervals]
    n_rows = rng.integers(0, n_intervals + 1, 2)
    series, start = toy.series(2, n_intervals), rng.normal(20, 3, (1, 2, 3))
    schedule, every = Schedule(dt, regime, n_rows), min(every, n_intervals)
    kept = toy.temperatures(schedule, series, start, every)
    full = toy.temperatures(schedule, series, start)
    assert kept.shape == (1, 2, n_intervals // every + 1, 3)
    for b, n in enumerate(n_rows):
        exact = toy.by_expm(dt[b, :n], regime[b, :n], series[0, :, b, :n], start[0, b])
        assert full[0, b, : n + 1] == pytest.approx(exact, rel=1e-11, abs=1e-10)
        assert kept[0, b, : n // every + 1] == pytest.approx(exact[::every], rel=1e-11, abs=1e-10)
        assert (kept[0, b, n // every :] == kept[0, b, n // every]).all()


@pytest.mark.parametrize("every", [1, 4])
@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize("own", ["modes", "directions", "series", "start", "all"])
def test_many_sets_at_once_are_each_alone(
    own: str, irregular: bool, every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(response_module, "_CHUNK_ELEMENTS", 300)  # several chunks also in a small case
    q = 7
    toy = Toy(6, n_sets=q)
    n = {name: q if own in (name, "all") else 1 for name in ("modes", "directions", "series", "start")}
    dt = toy.rng.uniform(5, 50, (3, 40)) if irregular else np.full((3, 40), 10.0)
    schedule = Schedule(dt, np.repeat(toy.rng.integers(0, 2, (3, 5)), 8, axis=1), np.array([40, 33, 40]))
    modes = toy.modes if n["modes"] == q else toy.modes.of_sets(slice(0, 1))
    series, start = toy.series(3, 40, n["series"]), toy.rng.normal(20, 3, (n["start"], 3, 4))
    directions, other = toy.directions[: n["directions"]], toy.rng.normal(size=(q, 2, 1, 4))
    extra = toy.series(3, 40)[:, :1]
    matrix = toy.rng.normal(size=(q, 2, 4))
    response = Response(modes, schedule)
    heat = response.forcing(directions, series) + response.forcing(other, extra)
    many = response.outputs(heat, start, matrix, every)
    assert np.array_equal(many, response.run(heat, start, every).at(matrix))
    for k in range(q):
        of = slice(k, k + 1)
        alone = Response(toy.modes.of_sets(of) if n["modes"] == q else modes, schedule)
        heat = alone.forcing(
            directions[of] if n["directions"] == q else directions, series[of] if n["series"] == q else series
        )
        heat = heat + alone.forcing(other[of], extra)
        one = alone.run(heat, start[of] if n["start"] == q else start, every).at(matrix[of])
        assert many[k] == pytest.approx(one[0], rel=1e-11, abs=1e-10)


def test_a_packed_drive_serves_several_runs() -> None:
    toy = Toy(8)
    schedule = one_schedule(10.0, 60, n_batches=2)
    response, series = Response(toy.modes, schedule), toy.series(2, 60)
    drive, start, eye = schedule.drive(series), np.zeros((1, 2, 4)), np.eye(4)[None]
    fresh = response.run(response.forcing(toy.directions, series), start, 6).at(eye)
    for _ in range(2):
        assert np.array_equal(response.run(response.forcing(toy.directions, drive), start, 6).at(eye), fresh)
    finer = response.run(response.forcing(toy.directions, drive), start, 3)
    assert finer.at(eye, every=2) == pytest.approx(fresh, rel=1e-12, abs=1e-12)


def test_steps_that_differ_by_rounding_are_one_step() -> None:
    time_s = np.arange(2881) * 10.1 + 1e4
    schedule = Schedule(np.diff(time_s)[None], np.zeros((1, 2880), int))
    assert schedule.step_s == pytest.approx([10.1], rel=1e-10)
    assert len(schedule.step_s) == 1
    assert len(Schedule(np.array([[10.0, 10.000001]]), np.zeros((1, 2), int)).step_s) == 2


# --- what cannot be used


def schedule_error(match: str, dt: np.ndarray, regime: np.ndarray, n_rows: np.ndarray | None = None) -> None:
    with pytest.raises(InputError, match=match):
        Schedule(dt, regime, n_rows)


def test_a_bad_schedule_is_told_with_its_place() -> None:
    dt, regime = np.full((2, 5), 10.0), np.zeros((2, 5), int)
    bad = dt.copy()
    bad[1, 3] = -10.0
    schedule_error(r"^schedule: batch 1, interval 3: dt_s is -10 s, expected a positive, .* sort the rows", bad, regime)
    bad[1, 3] = np.nan
    schedule_error(r"batch 1, interval 3: dt_s is nan s", bad, regime)
    Schedule(bad, regime, np.array([5, 3]))  # behind the valid intervals nobody looks
    wrong = regime.copy()
    wrong[0, 2] = -1
    schedule_error(r"batch 0, interval 2: regime is -1, expected a whole number from 0", dt, wrong)
    schedule_error(r"dt_s has shape \(2, 5\) and regime \(2, 4\), expected", dt, regime[:, :4])
    schedule_error(r"n_rows is \[5, 6\], expected one number from 0 to 5 for each of 2 batches", dt, regime, [5, 6])  # type: ignore[arg-type]


def test_a_bad_run_is_told_with_its_place() -> None:
    toy = Toy(9, n_regimes=1)
    schedule = one_schedule(10.0, 20, n_batches=2)
    response, series, start = Response(toy.modes, schedule), toy.series(2, 20), np.full((1, 2, 4), 20.0)
    heat = response.forcing(toy.directions, series)

    def told(words: str, *args: object, **kwargs: object) -> None:
        with pytest.raises(InputError, match=words):
            response.run(*args, **kwargs)  # type: ignore[arg-type]

    told(r"start temperatures have shape \(2, 4\), expected .* = \(…, 2, 4\)", heat, start[0])
    told(
        r"set 0, batch 1, node 3: start temperature is nan, expected a finite",
        heat,
        np.where(np.arange(8).reshape(1, 2, 4) == 7, np.nan, start),
    )
    told(
        r"start temperatures come in 3 sets, expected 1 or 5 as",
        response.forcing(toy.directions.repeat(5, 0), series),
        start.repeat(3, 0),
    )
    told(r"schedule: every is 21, expected a whole number of intervals from 1 to 20", heat, start, every=21)
    gap = series.copy()
    gap[0, 1, 1, 7, 1] = np.nan
    told(
        r"^run: heat is not finite; set 0, series 1, batch 1, interval 7: end value is nan, .* bridge the gap",
        response.forcing(toy.directions, gap), start,
    )  # fmt: skip
    told(
        r"not finite although every series is; look for a direction",
        response.forcing(toy.directions * np.nan, series), start,
    )  # fmt: skip
    other = Response(toy.modes, one_schedule(10.0, 20, n_batches=2))
    told("prepared for another schedule", other.forcing(toy.directions, series), start)
    with pytest.raises(InputError, match=r"matrix has shape \(2, 4\), expected .* = \(1 or 1, …, 4\)"):
        response.run(heat, start).at(np.ones((2, 4)))
    with pytest.raises(InputError, match=r"directions have shape \(1, 1, 2, 4\), expected .* = \(…, 1, 3, 4\)"):
        response.forcing(toy.directions[:, :, :2], series)
    with pytest.raises(InputError, match=r"series have shape \(1, 3, 2, 19, 2\), expected .* = \(…, …, 2, 20, 2\)"):
        response.forcing(toy.directions, series[:, :, :, :19])


def test_a_regime_that_the_modes_lack() -> None:
    toy = Toy(10, n_regimes=2)
    with pytest.raises(InputError, match=r"^response: the schedule uses regime 2, the modes have 2 regimes; give one"):
        Response(toy.modes, Schedule(np.ones((1, 3)), np.array([[0, 1, 2]])))
