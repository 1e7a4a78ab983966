"""The thermostat against the closed form of a body with constant heat between two switching points."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.toys.small_machine import network_with
from twin.mechanisms.base import View
from twin.mechanisms.fluids import CoolantJacket, JacketChiller

C_J_PER_K, ROOM_W_PER_K, ROOM_DEGC, HEAT_W = 40e3, 10.0, 20.0, 500.0
P = {"conductance": np.asarray(150.0), "supply": np.asarray(16.0), "set_point": np.asarray(22.0)}
P |= {"hysteresis": np.asarray(1.0)}


def closed_form() -> tuple[float, float, float]:
    """Period in s, share of it that the coolant flows, and the mean flow of heat into the jacket in W."""
    ua, supply = float(P["conductance"]), float(P["supply"])
    low, high = float(P["set_point"] - P["hysteresis"]), float(P["set_point"] + P["hysteresis"])
    warm = ROOM_DEGC + HEAT_W / ROOM_W_PER_K
    cold = (HEAT_W + ROOM_W_PER_K * ROOM_DEGC + ua * supply) / (ROOM_W_PER_K + ua)
    off_s = C_J_PER_K / ROOM_W_PER_K * math.log((warm - low) / (warm - high))
    tau_s = C_J_PER_K / (ROOM_W_PER_K + ua)
    on_s = tau_s * math.log((high - cold) / (low - cold))
    mean_degC_on = cold + (high - low) * tau_s / on_s
    return off_s + on_s, on_s / (off_s + on_s), ua * (supply - mean_degC_on) * on_s / (off_s + on_s)


def run(step_s: float, hours: float, start_degC: float = 20.0) -> tuple[Any, Any]:
    """Temperatures and chiller heat, stepping a body exactly with the law's heat held over each step."""
    chiller, n = JacketChiller(), int(hours * 3600 / step_s)
    degC, heat_W = [start_degC], []
    decay = math.exp(-step_s * ROOM_W_PER_K / C_J_PER_K)
    for m in range(n):
        view = View(degC={"jacket": np.array(degC)}, time_s=np.arange(m + 1) * step_s, step_s=step_s)
        heat_W.append(float(chiller.heat_W(view, P)[-1]))
        rest = ROOM_DEGC + (HEAT_W + heat_W[-1]) / ROOM_W_PER_K
        degC.append(rest + (degC[-1] - rest) * decay)
    return np.array(degC), np.array(heat_W)


@pytest.mark.parametrize("step_s, tolerance", [(5.0, 0.01), (20.0, 0.03)])
def test_period_duty_and_mean_flow_are_those_of_the_closed_form(step_s: float, tolerance: float) -> None:
    period_s, duty, mean_W = closed_form()
    degC, heat_W = run(step_s, hours=2.5)
    starts = np.flatnonzero((degC[:-2] < 22.0) & (degC[1:-1] >= 22.0))[2:]
    cycles = slice(starts[0], starts[-1])  # whole ones, the first two left out
    assert step_s * np.diff(starts).mean() == pytest.approx(period_s, rel=tolerance)
    assert heat_W[cycles].mean() == pytest.approx(mean_W, rel=tolerance)
    assert (heat_W[cycles] < 0.2 * mean_W).mean() == pytest.approx(duty, rel=3 * tolerance)


def test_a_set_point_that_passes_a_still_jacket_switches_the_coolant_on() -> None:
    room = np.array([20.0, 20.0, 17.0, 17.0])
    view = View(degC={"jacket": np.full(4, 22.0), "room": room}, time_s=60.0 * np.arange(4))
    heat_W = JacketChiller().heat_W(view, P | {"follow": np.asarray(1.0)})
    assert heat_W.tolist() == [0.0, 0.0, 150.0 * (13.0 - 22.0), 150.0 * (13.0 - 22.0)]


def sawtooth(period_s: float, step_s: float, hours: float) -> tuple[Any, Any]:
    """A triangle between 20.5 and 23.5 degC, linear as the law assumes, and its times."""
    time_s = np.arange(0.0, hours * 3600, step_s)
    return time_s, 22.0 + 1.5 * (2 / np.pi) * np.arcsin(np.sin(2 * np.pi * time_s / period_s))


@pytest.mark.parametrize("step_s, tolerance", [(1.0, 1e-3), (7.0, 5e-3), (31.0, 0.02)])
def test_energy_of_a_given_course(step_s: float, tolerance: float) -> None:
    """On a triangle of 600 s, on from 23 rising to 21 falling; what is left is the fall within a step, held."""
    time_s, degC = sawtooth(600.0, step_s, 50.0)
    heat_W = JacketChiller().heat_W(View(degC={"jacket": degC}, time_s=time_s), P)
    # up from 23 to 23.5 takes 50 s at 23.25, down to 21 takes 250 s at 22.25
    expected = 150.0 * (50 * (16 - 23.25) + 250 * (16 - 22.25)) / 600
    assert heat_W.mean() == pytest.approx(expected, rel=tolerance)


def test_a_switch_within_an_interval_is_made_up_for_in_the_next() -> None:
    """From 22 to 24 in 10 s passes 23 half way: 5 s of flow at 23.5 are owed; then 24 and 20: off after 3/4 of 10 s."""
    jacket, time_s = np.array([22.0, 24.0, 20.0, 20.0]), 10.0 * np.arange(4)
    heat_W = JacketChiller().heat_W(View(degC={"jacket": jacket}, time_s=time_s), P)
    owed_W, too_much_W = 0.5 * 150 * (16 - 23.5), 0.25 * 150 * (16 - 20.5)
    np.testing.assert_allclose(heat_W, [0.0, 150 * (16 - 24) + owed_W, -too_much_W, 0.0])


def test_what_flows_in_an_interval_does_not_depend_on_later_temperatures() -> None:
    time_s, degC = sawtooth(600.0, 31.0, 1.0)
    whole = JacketChiller().heat_W(View(degC={"jacket": degC}, time_s=time_s), P)
    for m in (1, 2, 17, 60):
        part = JacketChiller().heat_W(View(degC={"jacket": degC[:m]}, time_s=time_s[:m], step_s=31.0), P)
        np.testing.assert_array_equal(part, whole[:m])


@pytest.mark.parametrize("first_degC, flows", [(21.9, False), (22.1, True), (20.0, False), (24.0, True)])
def test_state_at_the_start_is_the_side_of_the_set_point(first_degC: float, flows: bool) -> None:
    degC = np.array([first_degC, 22.0, 22.0])
    heat_W = JacketChiller().heat_W(View(degC={"jacket": degC}, time_s=np.arange(3) * 10.0), P)
    assert (heat_W != 0).tolist() == [flows] * 3
    assert (heat_W <= 0).all()


def test_a_chiller_that_follows_the_room_switches_with_it() -> None:
    """On 20 degC in the room all is as stated; 5 K up and the whole sawtooth is 5 K up."""
    time_s, degC = sawtooth(600.0, 7.0, 1.0)
    stated = JacketChiller().heat_W(View(degC={"jacket": degC}, time_s=time_s), P)
    for follow, shift_K in ((1.0, 5.0), (0.4, 2.0)):
        view = View(degC={"jacket": degC + shift_K, "room": np.full(len(degC), 25.0)}, time_s=time_s)
        heat_W = JacketChiller().heat_W(view, {**P, "follow": np.asarray(follow)})
        np.testing.assert_allclose(heat_W, stated)
    for room in ({}, {"room": np.full(len(degC), 20.0)}):
        view = View(degC={"jacket": degC, **room}, time_s=time_s)
        np.testing.assert_array_equal(JacketChiller().heat_W(view, {**P, "follow": np.asarray(1.0)}), stated)


def test_a_file_may_name_the_room_or_leave_it_out() -> None:
    for law in (JacketChiller(), CoolantJacket()):
        for at, ports in ("first", {"jacket"}), ({"jacket": "first", "room": "room"}, {"jacket", "room"}):
            tried = next(h.law for h in network_with(law, {"supply": 18.0}, at=at).heats if h.law.name == "tried")
            assert set(tried.ports) == ports


def test_state_by_state_is_the_same_law() -> None:
    chiller, (_, degC) = JacketChiller(), sawtooth(600.0, 7.0, 1.0)
    on, states = np.asarray(chiller.starts_on(degC[0], P)), []
    for T in degC:
        on = chiller.switched(on, T, P)
        states.append(bool(on))
    scanned = chiller.heat_W(View(degC={"jacket": degC}, time_s=7.0 * np.arange(len(degC))), P)
    steady = np.flatnonzero(np.diff(states) == 0) + 1
    np.testing.assert_allclose(scanned[steady], np.where(states, chiller.flow_W(degC, P), 0.0)[steady])
