"""The sample machine against closed forms, another integrator and the figures it was designed to."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from data.arrays import Array
from plants.sample.sample_machine import (
    CAPACITY_J_PER_K,
    NODE,
    NODES,
    X_CHAIN,
    Y_CHAIN,
    Z_CHAIN,
    chain_um,
    displacement_um,
    heat_W,
    network,
    simulate,
)

SPEEDS = np.array([2000.0, 4000.0, 6000.0])
HOUR = 360  # steps of 10 s


@pytest.fixture(scope="module")
def warm_up() -> Array:
    """Rises over 6 h at three speeds: 20 °C start everywhere, room +2.3 K in 6 h."""
    steps = 6 * HOUR
    room = 20 + 2.3 * (np.arange(steps) + 0.5) / steps
    start = np.full((3, 14), 20.0)
    nodes = simulate(np.tile(SPEEDS, (steps, 1)), np.tile(room[:, None], 3), np.full(3, 20.0), start, np.ones(3))
    return nodes - nodes[0]


@pytest.mark.parametrize("chain", [X_CHAIN, Y_CHAIN, Z_CHAIN], ids="xyz")
def test_a_uniform_warm_up_with_one_alpha_moves_nothing(chain: tuple[tuple[str, float, bool], ...]) -> None:
    assert chain_um(chain, np.full(14, 7.0), common_um_per_m_K=11.5) == pytest.approx(0.0, abs=1e-12)
    one_node = np.eye(14)[NODE[chain[0][0]]]
    assert abs(chain_um(chain, one_node, common_um_per_m_K=11.5)) == pytest.approx(11.5 * abs(chain[0][1]))


def test_a_uniform_warm_up_of_steel_and_iron_leaves_the_difference_of_their_expansion() -> None:
    error = displacement_um(np.ones(14), np.zeros(()))
    steel_m = 0.30 + 0.09 + 0.20 + 0.08
    assert error["z"] == pytest.approx((11.5 - 10.8) * steel_m)
    assert error["x"] == pytest.approx(0.0, abs=1e-12)
    assert error["y"] == pytest.approx(0.0, abs=1e-12)


def test_column_bending_by_hand() -> None:
    rise = np.zeros(14)
    rise[NODE["column_front"]], rise[NODE["column_back"]] = 0.5, -0.5  # 1 K across, mean 0
    phi_um_per_m = 10.8 * 1.25 / 0.5
    error = displacement_um(rise, np.zeros(()))
    assert error["z"] == pytest.approx(-phi_um_per_m * 0.45)
    assert error["y"] == pytest.approx(-phi_um_per_m * 1.25 / 2)


def test_the_speed_shift_acts_on_z_alone() -> None:
    still = displacement_um(np.zeros((2, 14)), np.array([3000.0, 6000.0]))
    np.testing.assert_allclose(still["z"], [1.0, 4.0])
    assert not still["x"].any() and not still["y"].any()


@pytest.mark.parametrize("speed_rpm", [0.0, 6000.0])
def test_a_machine_as_warm_as_room_and_floor_stays(speed_rpm: float) -> None:
    rates, room, floor = network(speed_rpm)
    np.testing.assert_allclose(rates @ np.full(14, 20.0) + 20 * room + 20 * floor, 0.0, atol=1e-15)


def test_modal_time_constants() -> None:
    tau_min = np.sort(-1 / np.linalg.eigvals(network(6000.0)[0]).real)[::-1] / 60
    assert tau_min[0] / 60 == pytest.approx(7.7, abs=0.1)
    assert tau_min[1] / 60 == pytest.approx(2.8, abs=0.05)
    assert tau_min[2] / 60 == pytest.approx(1.5, abs=0.06)
    assert tau_min[3] == pytest.approx(49, abs=1)
    assert all(19.5 <= t <= 25.5 for t in tau_min[4:7])
    assert tau_min[7] <= 11


def test_against_an_adaptive_integrator() -> None:
    """Strong change of heat: a cold start at full speed; holding the heat for 10 s costs little."""
    rates, room, floor = network(6000.0)
    capacity = np.array([CAPACITY_J_PER_K[n] for n in NODES])
    drive = 5.0 * room + 10.0 * floor

    def slope(_: float, node_degC: Array) -> Array:
        heat = heat_W(node_degC[None], np.array([6000.0]), np.array([1.1]))[0]
        return np.asarray(rates @ node_degC + drive + heat / capacity)

    exact = solve_ivp(slope, (0, 7200), np.full(14, 5.0), "LSODA", np.arange(0, 7201, 600), rtol=1e-9, atol=1e-9).y.T
    ours = simulate(
        np.full((720, 1), 6000.0), np.full((720, 1), 5.0), np.array([10.0]), np.full((1, 14), 5.0), np.array([1.1])
    )[::60, 0]
    np.testing.assert_allclose(ours, exact, atol=0.04)
    np.testing.assert_allclose(ours[-1], exact[-1], atol=0.005)


def test_the_energy_that_goes_in_is_stored_or_leaves() -> None:
    """Steady state at 4000 rpm: all heat reaches room and floor."""
    steps = 60 * HOUR
    nodes = simulate(
        np.full((steps, 1), 4000.0), np.full((steps, 1), 20.0), np.array([20.0]), np.full((1, 14), 20.0), np.ones(1)
    )[-1]
    _, room, floor = network(4000.0)
    capacity = np.array([CAPACITY_J_PER_K[n] for n in NODES])
    leaving_W = ((nodes[0] - 20.0) * (room + floor) * capacity).sum()
    assert leaving_W == pytest.approx(heat_W(nodes, np.array([4000.0]), np.ones(1)).sum(), rel=1e-3)


def test_warm_up_reaches_the_figures_of_its_class(warm_up: Array) -> None:
    z_um = displacement_um(warm_up, np.broadcast_to(SPEEDS, warm_up.shape[:2]))["z"][[HOUR, 2 * HOUR, 6 * HOUR]].T
    figures_um = np.array([[22, 25, 25], [52, 54, 52], [82, 83, 77]])
    np.testing.assert_allclose(z_um, figures_um, rtol=0.06)
    np.testing.assert_allclose(warm_up[-1, :, NODE["front"]], [6.9, 14.0, 21.1], rtol=0.03)


def test_side_errors_stay_smaller_than_z(warm_up: Array) -> None:
    error = displacement_um(warm_up, np.broadcast_to(SPEEDS, warm_up.shape[:2]))
    assert 2 < error["x"][-1, 2] < 15 < error["y"][-1, 2] < 40


def test_bearing_rise_follows_a_power_of_the_speed(warm_up: Array) -> None:
    """Viscous friction that thins with heat: between the load part's 1 and the cold viscous 5/3."""
    rise = warm_up[2 * HOUR, :, NODE["front"]]
    assert 1.0 < np.polyfit(np.log(SPEEDS), np.log(rise), 1)[0] < 5 / 3


def test_a_room_step_on_the_idle_machine() -> None:
    steps = 6 * HOUR
    nodes = simulate(
        np.zeros((steps, 1)), np.full((steps, 1), 25.0), np.array([20.0]), np.full((1, 14), 20.0), np.ones(1),
        auxiliaries_W=0.0,
    )  # fmt: skip
    z_um = displacement_um(nodes - nodes[0], np.zeros((steps + 1, 1)))["z"][:, 0]
    assert z_um.max() == pytest.approx(6.0, abs=1.0)
    assert z_um.argmax() / HOUR == pytest.approx(1.8, abs=0.3)
