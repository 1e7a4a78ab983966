"""The exact response against closed forms, matrix exponentials, scipy's stiff solver and the balance of energy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from toy_network import Toy, held, linear, one_schedule

from twin.simulation.modes import modes_of
from twin.simulation.response import Forcing, Response, Schedule

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
