"""The exact response: against closed forms, matrix exponentials and scipy's stiff solver, and its own invariances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from data.errors import InputError
from twin import response as response_module
from twin.modes import modes_of
from twin.response import Forcing, Response, Schedule


class Toy:
    """A random network with everything that a run needs; small enough to solve by brute force."""

    def __init__(self, seed: int, n_nodes: int = 4, n_regimes: int = 2, n_series: int = 3, n_sets: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.rng, self.n_nodes = rng, n_nodes
        self.capacity = np.exp(rng.uniform(np.log(500), np.log(5e4), (n_sets, n_nodes)))
        links = rng.uniform(0, 20, (n_sets, n_regimes, n_nodes, n_nodes)) * (rng.random((n_nodes, n_nodes)) < 0.6)
        links = np.triu(links, 1) + np.triu(links, 1).swapaxes(-1, -2)
        self.conductance = -links
        diagonal = np.arange(n_nodes)
        self.conductance[..., diagonal, diagonal] = links.sum(-1) + rng.uniform(0, 3, (n_sets, n_regimes, n_nodes))
        self.directions = rng.normal(0, 30, (n_sets, n_regimes, n_series, n_nodes))
        self.modes = modes_of(self.capacity, self.conductance)

    def series(self, n_batches: int, n_intervals: int, n_sets: int = 1) -> np.ndarray:
        return self.rng.normal(size=(n_sets, self.directions.shape[2], n_batches, n_intervals, 2))

    def temperatures(
        self, schedule: Schedule, series: np.ndarray, start_degC: np.ndarray, every: int = 1
    ) -> np.ndarray:
        response = Response(self.modes, schedule)
        return response.run(response.forcing(self.directions, series), start_degC, every).at(
            np.eye(self.n_nodes)[None], 1
        )

    def by_expm(self, dt_s: np.ndarray, regime: np.ndarray, series: np.ndarray, start_degC: np.ndarray) -> np.ndarray:
        """Node temperatures (M + 1, N) of one batch by the exponential of the network with its ramps as states."""
        n, n_series = self.n_nodes, self.directions.shape[2]
        states = [start_degC]
        for dt, r, values in zip(dt_s, regime, series.swapaxes(0, 1), strict=True):
            full = np.zeros((n + 2 * n_series,) * 2)
            full[:n, :n] = -self.conductance[0, r] / self.capacity[0][:, None]
            full[:n, n : n + n_series] = (self.directions[0, r] / self.capacity[0]).T
            full[n : n + n_series, n + n_series :] = np.eye(n_series) / dt
            state = np.concatenate([states[-1], values[:, 0], values[:, 1] - values[:, 0]])
            states.append((expm(full * dt) @ state)[:n])
        return np.array(states)


def one_schedule(dt_s: float, n_intervals: int, n_batches: int = 1) -> Schedule:
    return Schedule(np.full((n_batches, n_intervals), dt_s), np.zeros((n_batches, n_intervals), int))


def held(values: np.ndarray) -> np.ndarray:
    """Series (1, 1, 1, M, 2) that holds each value through its interval."""
    return np.repeat(values[:, None], 2, axis=1)[None, None, None]


def linear(values: np.ndarray) -> np.ndarray:
    """Series (1, 1, 1, M, 2) that runs straight through the values at the borders (M + 1,)."""
    return np.column_stack([values[:-1], values[1:]])[None, None, None]


# --- closed forms


def test_one_body_under_constant_heat_rises_exponentially() -> None:
    schedule = one_schedule(30.0, 400)
    response = Response(modes_of(np.array([[5e3]]), np.array([[[[4.0]]]])), schedule)
    heat = response.forcing(np.full((1, 1, 1, 1), 50.0), held(np.ones(400)))
    rise_K = response.run(heat, np.zeros((1, 1, 1))).at(np.ones((1, 1, 1)))[0, 0, :, 0]
    time_s = np.arange(401) * 30.0
    assert rise_K == pytest.approx(50 / 4 * -np.expm1(-time_s * 4 / 5e3), rel=1e-13)


def test_two_bodies_share_their_heat() -> None:
    capacity, g = np.array([[2e3, 5e3]]), 12.0
    response = Response(modes_of(capacity, g * np.array([[[[1.0, -1], [-1, 1]]]])), one_schedule(10.0, 200))
    temperature = response.run(Forcing(), np.array([[[40.0, 20.0]]])).at(np.eye(2)[None])[0, 0]
    mean = (2e3 * 40 + 5e3 * 20) / 7e3
    gap = 20.0 * np.exp(-np.arange(201) * 10.0 * g * (1 / 2e3 + 1 / 5e3))
    expected = np.column_stack([mean + gap * 5 / 7, mean - gap * 2 / 7])
    assert temperature == pytest.approx(expected, rel=1e-13)


def error_of_a_bar_with_a_step(n: int) -> float:
    """Largest error, K, of n cells of steel, 0.3 m: one end jumps by 1 K, the other is insulated.

    Fourier series: Carslaw and Jaeger (1959), Conduction of Heat in Solids, §3.3.
    """
    length_m, diffusivity_m2_per_s = 0.3, 1.3e-5
    cell_m = length_m / n
    g = diffusivity_m2_per_s / cell_m  # where a cell's capacity is its length
    matrix = np.zeros((n, n))
    for i in range(n - 1):
        matrix[i : i + 2, i : i + 2] += g * np.array([[1, -1], [-1, 1]])
    matrix[0, 0] += 2 * g  # half a cell to the surface
    response = Response(modes_of(np.full((1, n), cell_m), matrix[None, None]), one_schedule(60.0, 60))
    direction = np.zeros((1, 1, 1, n))
    direction[..., 0] = 2 * g
    rise_K = response.run(response.forcing(direction, held(np.ones(60))), np.zeros((1, 1, n))).at(np.eye(n)[None])[0, 0]
    x = (np.arange(n) + 0.5) / n
    k = (np.arange(300) + 0.5) * np.pi
    errors = []
    for m in (10, 30, 60):
        decay = np.exp(-(k**2) * diffusivity_m2_per_s * m * 60.0 / length_m**2)
        exact = 1 - 2 * (np.sin(k[:, None] * x) * (decay / k)[:, None]).sum(0)
        errors.append(np.abs(rise_K[m] - exact).max())
    return max(errors)


def test_a_bar_with_a_step_at_one_end_closes_in_on_its_fourier_series() -> None:
    coarse, fine = error_of_a_bar_with_a_step(50), error_of_a_bar_with_a_step(100)
    assert fine < 5e-5
    assert coarse / fine == pytest.approx(4.0, rel=0.02)  # second order in the cell


def test_a_body_follows_a_periodic_room_with_the_lag_of_its_time_constant() -> None:
    tau_s, period_s, steps = 1800.0, 7200.0, 720
    omega, dt = 2 * np.pi / period_s, period_s / steps
    response = Response(modes_of(np.array([[tau_s]]), np.ones((1, 1, 1, 1))), one_schedule(dt, 12 * steps))
    room = linear(np.sin(omega * dt * np.arange(12 * steps + 1)))
    run = response.run(response.forcing(np.ones((1, 1, 1, 1)), room), np.zeros((1, 1, 1)))
    last = run.at(np.ones((1, 1, 1)))[0, 0, -steps:, 0]
    phase = omega * dt * np.arange(11 * steps + 1, 12 * steps + 1)
    found = 2 / steps * np.sum(last * np.exp(-1j * phase)) * 1j
    # straight lines between the samples of a sine carry sinc² of it at its own frequency
    exact = np.sinc(1 / steps) ** 2 / (1 + 1j * omega * tau_s)
    assert abs(found) == pytest.approx(abs(exact), rel=1e-9)
    assert np.angle(found) == pytest.approx(np.angle(exact), abs=1e-9)


# --- other solvers


def test_like_the_matrix_exponential_through_regimes_irregular_steps_and_jumps() -> None:
    toy = Toy(1, n_regimes=3)
    dt = toy.rng.uniform(1, 600, (1, 80))
    dt[0, 20:60] = 10.0
    regime = np.repeat(toy.rng.integers(0, 3, 20), 4)[None]
    series, start = toy.series(1, 80), toy.rng.normal(20, 5, (1, 1, 4))
    ours = toy.temperatures(Schedule(dt, regime), series, start)[0, 0]
    assert ours == pytest.approx(toy.by_expm(dt[0], regime[0], series[0, :, 0], start[0, 0]), rel=1e-12, abs=1e-11)


@pytest.mark.parametrize("method", ["Radau", "LSODA"])
def test_like_a_stiff_solver_at_tight_tolerance(method: str) -> None:
    toy = Toy(2, n_regimes=1, n_series=2)
    borders = toy.rng.normal(size=(2, 13)).cumsum(axis=1)
    series = np.stack([borders[:, :-1], borders[:, 1:]], axis=-1)[None, :, None]
    start = np.full((1, 1, 4), 20.0)
    ours = toy.temperatures(one_schedule(120.0, 12), series, start)[0, 0]

    def slope(t_s: float, temperature: np.ndarray, m: int) -> np.ndarray:
        drive = borders[:, m] + (borders[:, m + 1] - borders[:, m]) * (t_s / 120.0 - m)
        return (drive @ toy.directions[0, 0] - toy.conductance[0, 0] @ temperature) / toy.capacity[0]

    state = start[0, 0]
    for m in range(12):
        span = (120.0 * m, 120.0 * (m + 1))
        state = solve_ivp(slope, span, state, method=method, rtol=1e-10, atol=1e-10, args=(m,)).y[:, -1]
        assert ours[m + 1] == pytest.approx(state, rel=1e-8)


# --- invariances


def test_a_closed_network_conserves_its_energy() -> None:
    toy = Toy(3, n_nodes=6)
    diagonal = np.arange(6)
    closed = toy.conductance.copy()
    closed[..., diagonal, diagonal] = 0.0
    closed[..., diagonal, diagonal] = -closed.sum(-1)
    regime = np.repeat(toy.rng.integers(0, 2, 96), 30)[None]
    response = Response(modes_of(toy.capacity, closed), Schedule(np.full((1, 2880), 10.0), regime))
    series = np.abs(toy.series(1, 2880))
    directions = np.abs(toy.directions)
    directions[:, 1] = directions[:, 0]
    start = np.full((1, 1, 6), 20.0)
    run = response.run(response.forcing(directions, series), start)
    energy_J = run.at(toy.capacity[:, None, :])[0, 0, :, 0]
    put_in_J = np.cumsum(np.einsum("jn,jm->m", directions[0, 0], series[0, :, 0].mean(-1)) * 10.0)
    assert np.abs(energy_J[1:] - energy_J[0] - put_in_J).max() < 1e-10 * energy_J.max()


def test_irregular_intervals_give_the_same_physics_as_a_fine_regular_grid() -> None:
    toy = Toy(4)
    lengths = toy.rng.integers(1, 9, 50)
    ends = np.concatenate([[0], np.cumsum(lengths)])
    borders = toy.rng.normal(size=(3, 51))
    regime = np.repeat([0, 1, 0, 1, 1], 10)
    series = np.stack([borders[:, :-1], borders[:, 1:]], axis=-1)[None, :, None]
    fine_borders = np.array([np.interp(np.arange(ends[-1] + 1), ends, b) for b in borders])
    fine = np.stack([fine_borders[:, :-1], fine_borders[:, 1:]], axis=-1)[None, :, None]
    start = np.full((1, 1, 4), 20.0)
    coarse_T = toy.temperatures(Schedule(lengths[None] * 5.0, regime[None]), series, start)
    fine_T = toy.temperatures(Schedule(np.full((1, ends[-1]), 5.0), np.repeat(regime, lengths)[None]), fine, start)
    assert coarse_T[0, 0] == pytest.approx(fine_T[0, 0, ends], rel=1e-12, abs=1e-11)


def test_padding_does_not_leak() -> None:
    toy = Toy(5)
    n_rows = np.array([37, 60, 0, 1])
    dt, regime = np.full((4, 60), 10.0), toy.rng.integers(0, 2, (4, 60))
    series, start = toy.series(4, 60), toy.rng.normal(20, 3, (1, 4, 4))
    for b, n in enumerate(n_rows):
        dt[b, n:], regime[b, n:], series[:, :, b, n:] = np.nan, -7, np.nan
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


def test_heat_adds_up() -> None:
    toy = Toy(7)
    response = Response(toy.modes, one_schedule(10.0, 100))
    series = toy.series(1, 100)
    parts = [response.forcing(toy.directions[:, :, j : j + 1], series[:, j : j + 1]) for j in range(3)]
    start, eye = np.full((1, 1, 4), 20.0), np.eye(4)[None]
    whole = response.run(response.forcing(toy.directions, series), start).at(eye)
    assert response.run(parts[0] + parts[1] + parts[2], start).at(eye) == pytest.approx(whole, rel=1e-13)


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
