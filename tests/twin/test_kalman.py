"""The Kalman filter of a network against a textbook filter, and what any honest filter must do."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from data.errors import InputError
from tests.twin.machines import machine
from twin.compile import compile_network
from twin.kalman import Doubt, Filtered, filtered_each
from twin.network import Network
from twin.simulation import simulate
from twin.simulation.inputs import Inputs

DT_S, ROWS = 60.0, 121
LAG_S = 90.0


def inputs(batches: int = 1, lengths: tuple[int, ...] = (), room_degC: float = 20.0) -> Inputs:
    """Spindle on for 40 min, off for 40 min; a room that drifts."""
    time_s = DT_S * np.arange(ROWS)
    rpm = np.where((np.arange(ROWS - 1) // 40) % 2 == 0, 6000.0, 0.0)
    return Inputs(
        batch_ids=tuple(f"b{k}" for k in range(batches)),
        time_s=np.tile(time_s, (batches, 1)),
        n_intervals=np.array(lengths or [ROWS - 1] * batches),
        drivers={"rpm": np.tile(rpm, (batches, 1))},
        recorded={"room": np.tile(room_degC + time_s / 7200.0, (batches, 1))},
        clock_h=np.full(batches, np.nan),
        first={n: np.full(batches, room_degC) for n in ("t_shaft", "t_head")},
    )


def two_bodies(**changes: object) -> Network:
    return compile_network(
        machine(**{"sensors__t_shaft__noise": "0.05 K", "sensors__t_head__noise": "0.05 K"} | changes)
    )


def filtered(network: Network, given: Inputs, readings: np.ndarray, doubt: Doubt, *start: np.ndarray) -> Filtered:
    return filtered_each(network, network.values, given, readings, [doubt], *start)[0]


def with_grease() -> Network:
    """Friction that falls as the shaft warms: heat that depends on temperature."""
    return two_bodies(mechanisms__grease={"law": "viscosity_feedback", "at": {"oil": "shaft"}, "acts_on": "belt"})


def no_readings(network: Network, given: Inputs) -> np.ndarray:
    return np.full((given.n_batches, given.time_s[0, :: given.every].size, len(network.readings)), np.nan)


def textbook(network: Network, readings: np.ndarray, start_degC: np.ndarray, doubt: Doubt, lag_s: float) -> np.ndarray:
    """z by a dense filter on absolute temperatures: shaft, head, factor, lag, z(0)."""
    p = {q.name: q.value for q in network.parameters}
    c = np.array([p["bodies.shaft.capacity"], p["bodies.head.capacity"]])
    g, shaft, head = (
        p[f"{k}.conductance"] for k in ("links.shaft-head", "exposures.shaft-room", "exposures.head-room")
    )
    belt_W = p["mechanisms.belt.power"]
    a = np.zeros((5, 5))
    a[0, :2] = np.array([-(g + shaft), g]) / c[0]
    a[1, :2] = np.array([g, -(g + head)]) / c[1]
    a[3, 0], a[3, 3] = 1 / (lag_s or 1e3), -1 / (lag_s or 1e3)
    white = np.zeros((5, 5))
    white[[0, 1], [0, 1]] = (doubt.heat_W / c) ** 2 * 3600.0
    gain = network.errors[0].matrix(network.values)
    start = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 0], [*gain, 0]], float)
    own = np.zeros((3, 3))
    own[:2, :2], own[2, 2] = doubt.start_K2, doubt.heat_spread**2
    state = np.array([*start_degC, 0.0, start_degC[0], gain @ start_degC])
    cov = start @ own @ start.T
    seen = np.array([[0, 0, 0, 1, 0], [0, 1, 0, 0, 0]], float)
    read = np.array([*gain, 0, 0, -1.0])
    given = inputs()
    z = []
    for k in range(ROWS):
        if k:
            watts = belt_W if given.drivers["rpm"][0, k - 1] else 0.0
            move = a.copy()
            move[0, 2] = watts / c[0]
            forced = np.zeros((7, 7))  # state, constant 1, time: the room runs straight through its values
            forced[:5, :5] = move
            room0, room1 = given.recorded["room"][0, k - 1 : k + 1]
            forced[:2, 5] = np.array([shaft, head]) / c * room0 + np.array([watts / c[0], 0])
            forced[:2, 6] = np.array([shaft, head]) / c * (room1 - room0) / DT_S
            forced[6, 5] = 1.0
            step = expm(forced * DT_S)
            state = (step @ np.array([*state, 1.0, 0.0]))[:5]
            van_loan = expm(np.block([[-move, white], [np.zeros((5, 5)), move.T]]) * DT_S)
            f = van_loan[5:, 5:].T
            cov = f @ cov @ f.T + f @ van_loan[:5, 5:]
        there = np.isfinite(readings[k])
        h = seen[there].copy()
        if k == 0 or not lag_s:
            h[:] = np.array([[1, 0, 0, 0, 0], [0, 1, 0, 0, 0]], float)[there]
        if there.any():
            s = h @ cov @ h.T + np.eye(len(h)) * 0.05**2
            kalman = cov @ h.T @ np.linalg.inv(s)
            state = state + kalman @ (readings[k][there] - h @ state)
            cov = (np.eye(5) - kalman @ h) @ cov
        z.append(read @ state if k else 0.0)
    return np.array(z)


def truth(network: Network, given: Inputs, start_degC: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Noisy readings and errors of a machine that is as its file says."""
    done = simulate(network, network.values, given, start_degC[None])
    noise = np.array([r.noise for r in network.readings])
    rng = np.random.default_rng(seed)
    return done.readings[0] + noise * rng.normal(size=done.readings[0].shape), done.errors[0]


@pytest.mark.parametrize(("lag_s", "atol_um"), [(0.0, 1e-3), (LAG_S, 0.2)], ids=["at once", "late"])
def test_is_the_textbook_filter_on_two_bodies_with_missing_rows(lag_s, atol_um):
    # What a late sensor shows is simulated as if temperatures ran straight from row to row: no more digits there.
    network = two_bodies(**({"sensors__t_shaft__lag": f"{lag_s} s"} if lag_s else {}))
    given, doubt = inputs(), Doubt(np.array([[2.0, 0.5], [0.5, 1.0]]), 0.2, 8.0)
    rng = np.random.default_rng(3)
    readings = truth(network, given, np.array([[23.0, 19.0]]))[0]
    readings[0, rng.random(ROWS) < 0.3, 0] = np.nan
    readings[0, 50:70] = np.nan
    start = np.array([20.0, 21.0])
    got = filtered(network, given, readings, doubt, start[None])
    z = textbook(network, readings[0], start, doubt, lag_s)
    np.testing.assert_allclose(got.errors[0, :, 0], z, atol=atol_um)


def test_without_readings_it_runs_free():
    network, given = with_grease(), inputs()
    start = np.array([[20.0, 20.0]])
    got = filtered(network, given, no_readings(network, given), Doubt(np.eye(2)), start)
    free = simulate(network, network.values, given, start[None])
    np.testing.assert_allclose(got.errors, free.errors[0], atol=1e-9)
    assert np.isnan(got.innovation).all()


@pytest.mark.parametrize("network", [two_bodies(), with_grease()], ids=["linear", "grease"])
def test_innovation_is_white_and_of_unit_variance_where_model_and_noise_are_right(network):
    given = inputs(batches=12)
    rng = np.random.default_rng(7)
    start_K2 = np.array([[4.0, 1.0], [1.0, 2.0]])
    start = 20.0 + rng.multivariate_normal([0, 0], start_K2, size=12)
    readings, _ = truth(network, given, start, seed=8)
    got = filtered(network, given, readings, Doubt(start_K2, 0.0, 0.0), np.full((12, 2), 20.0))
    for j in range(2):
        news = got.innovation[:, :, j]
        n = news.size
        assert abs(np.mean(news**2) - 1) < 4 * np.sqrt(2 / n)
        for lag in (1, 2, 5):
            r = np.mean(news[:, lag:] * news[:, :-lag])
            assert abs(r) < 4 / np.sqrt(n)


def test_finds_a_heat_that_is_stronger_than_the_file_says():
    network, given = two_bodies(), inputs()
    stronger = network.values.copy()
    stronger[network.index("mechanisms.belt.power")] *= 1.25
    start = np.array([[20.0, 20.0]])
    readings = simulate(network, stronger, given, start[None]).readings[0]
    got = filtered(network, given, readings, Doubt(np.eye(2) * 0.01, 0.2, 1.0), start)
    assert got.heat_factor[0, -1, 0] == pytest.approx(0.25, abs=0.03)


def test_a_row_knows_nothing_of_later_readings():
    network, given = with_grease(), inputs()
    readings, _ = truth(network, given, np.array([[22.0, 21.0]]))
    changed = readings.copy()
    changed[:, 60:] += 5.0
    doubt, start = Doubt(np.eye(2)), np.array([[20.0, 20.0]])
    one, other = (filtered(network, given, r, doubt, start) for r in (readings, changed))
    np.testing.assert_array_equal(one.errors[:, :60], other.errors[:, :60])
    assert np.abs(one.errors[:, 60:] - other.errors[:, 60:]).max() > 1.0


def test_batches_do_not_touch_each_other_and_the_shorter_one_ends_early():
    network = with_grease()
    both = inputs(batches=2, lengths=(ROWS - 1, 70))
    readings = np.concatenate([truth(network, inputs(), np.array([[s, s]]), seed=s)[0] for s in (21, 24)])
    doubt = Doubt(np.eye(2))
    got = filtered(network, both, readings, doubt)
    alone = filtered(network, inputs(), readings[1:], doubt)
    np.testing.assert_allclose(got.errors[1, :71], alone.errors[0, :71], atol=2e-3)
    assert np.isnan(got.innovation[1, 71:]).all() and np.isfinite(got.innovation[0]).all()


def test_substeps_change_next_to_nothing():
    network, given = with_grease(), inputs()
    readings, _ = truth(network, given, np.array([[22.0, 21.0]]))
    doubt = Doubt(np.eye(2))
    one, finer = (filtered(network, i, readings, doubt) for i in (given, given.refined(4)))
    np.testing.assert_allclose(one.errors, finer.errors, atol=0.05)


def test_a_body_of_several_cells_has_one_noise_and_its_sensor_still_helps():
    network = two_bodies(bodies__head={"capacity": "40 kJ/K", "material": "cast_iron", "shape": "bar", "cells": 3,
                                       "conductance": "30 W/K"}, sensors__t_head={"at": "head@0.5"})  # fmt: skip
    given = inputs()
    n = network.n_cells
    assert n == 4
    readings, errors = truth(network, given, np.full((1, n), 23.0))
    doubt = Doubt(np.full((n, n), 9.0), 0.0, 0.0)  # all of it starts warmer or colder alike
    got = filtered(network, given, readings, doubt, np.full((1, n), 20.0))
    free = simulate(network, network.values, given, np.full((1, 1, n), 20.0)).errors[0]
    assert np.abs(got.errors - errors).max() < 0.3 * np.abs(free - errors).max()


def test_mistakes_are_told():
    network, given = two_bodies(), inputs()
    good = no_readings(network, given)
    with pytest.raises(InputError, match=r"readings have shape \(1, 3, 2\), expected .* = \(1, 121, 2\)"):
        filtered(network, given, good[:, :3], Doubt(np.eye(2)))
    with pytest.raises(InputError, match=r"covariance has shape \(3, 3\), expected \(2, 2\)"):
        filtered(network, given, good, Doubt(np.eye(3)))
    with pytest.raises(InputError, match="heat_W is -1, expected 0 or more"):
        filtered(network, given, good, Doubt(np.eye(2), heat_W=-1.0))
    stuck = two_bodies(mechanisms__stuck={"law": "sensor_stuck", "acts_on": "t_head"})
    readings = np.full(good.shape, 20.0)
    with pytest.raises(InputError, match="sensor 't_head' has stuck, which remembers more than one lag"):
        filtered(stuck, given, readings, Doubt(np.eye(2)))


def test_thinned_readings_give_a_filter_of_longer_steps_whose_corrections_hold_in_between():
    network, given = two_bodies(), inputs()
    start = np.full((1, 2), 20.0)
    readings = no_readings(network, given)
    readings[:, :, :1] = truth(network, given, start + 1.0)[0][:, :, :1]
    few = np.full_like(readings, np.nan)
    few[:, ::3] = readings[:, ::3]
    doubt = Doubt(np.eye(2), 0.1, 5.0)
    whole = filtered(network, given, few, doubt, start)
    one, loud = filtered_each(network, network.values, given, readings, [doubt, Doubt(np.eye(2), 0.1, 50.0)], start, 3)
    np.testing.assert_allclose(one.cells_degC[:, ::3], whole.cells_degC[:, ::3], atol=0.05)
    assert np.isnan(one.innovation[:, 1::3]).all() and np.isfinite(one.innovation[:, 3::3, 0]).all()
    again = filtered_each(network, network.values, given, few, [doubt], start, 3)[0]
    np.testing.assert_array_equal(again.cells_degC, one.cells_degC)
    assert np.abs(loud.cells_degC - one.cells_degC).max() > 1e-3
