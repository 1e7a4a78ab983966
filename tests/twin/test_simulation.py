"""The simulation against closed forms, against a stiff solver, and for conserved energy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from data.errors import InputError
from plants.sample import sample_machine as truth
from tests.twin.drives import at, closed, drive, network, one_body
from twin.network import Network
from twin.simulation import choose_substeps, simulate
from twin.simulation.coupling import Answer, Trajectory

SIGMA = 5.670374419e-8


# closed forms of linear networks: exact, whatever the step


def test_one_body_answers_a_step_of_heat_and_a_moving_room() -> None:
    net = one_body("10 W/K", mechanisms={"belt": {"law": "belt_loss", "drivers": "rpm", "into": "shaft",
                                                  "parameters": {"power": "120 W"}}})  # fmt: skip
    time_s = np.array([0.0, 300.0, 400.0, 2000.0, 5000.0])  # steps as they come
    tau, drift = 500.0, 1e-3
    out = simulate(net, net.values, drive(time_s, rpm=6000.0, room=20 + drift * time_s), at(20, net))
    decay = np.exp(-time_s / tau)
    expected = 20 + 12 * (1 - decay) + drift * (time_s - tau * (1 - decay))
    np.testing.assert_allclose(out.readings[0, 0, :, 0], expected, rtol=1e-13)
    np.testing.assert_allclose(out.errors[0, 0, :, 0], 2 * (expected - 20), atol=1e-11)
    assert out.message == "linear: exact"


def test_a_bar_whose_end_is_heated_by_a_step() -> None:
    """Carslaw and Jaeger 1959, §3.8: an insulated bar with constant flux at one end."""
    cells = 200
    step = {"law": "belt_loss", "drivers": "rpm", "into": "bar@0", "parameters": {"power": "50 W"}}
    bar = {"capacity": "20 kJ/K", "shape": "bar", "cells": cells, "conductance": "5 W/K", "material": "steel"}
    ends = {"t_shaft": {"at": "bar@0"}, "t_head": {"at": "bar@1"}}
    exposures = {"bar-room": "1 W/K"}
    net = closed(
        network(bodies={"bar": bar}, links={}, exposures=exposures, sensors=ends, errors={}, mechanisms={"belt": step})
    )
    time_s = np.linspace(0, 4000, 21)
    out = simulate(net, net.values, drive(time_s, rpm=6000.0), at(20, net))
    span, k = 20e3 / 5.0, np.arange(1, 200)  # L²/a
    at_end = [1 / 3, -1 / 6]  # heated, far
    for sensor, (steady, sign) in enumerate(zip(at_end, (1.0, -1.0), strict=True)):
        modes = np.exp(-np.outer(time_s / span, (k * np.pi) ** 2)) * sign**k / k**2
        expected = 20 + 50 / 5.0 * (time_s / span + steady - 2 / np.pi**2 * modes.sum(axis=1))
        np.testing.assert_allclose(out.readings[0, 0, 1:, sensor], expected[1:], atol=0.03)


# heat that depends on temperature


def radiating(area: float = 2.0) -> Network:
    given = {"law": "radiation", "at": {"body": "shaft", "surrounding": "room"}, "into": "shaft",
             "parameters": {"area": f"{area} m**2", "emissivity": 0.9}}  # fmt: skip
    return one_body(mechanisms={"walls": given})


def test_a_body_that_only_radiates_against_a_stiff_solver() -> None:
    net, area = radiating(), 2.0
    time_s = np.arange(0, 7201.0, 10.0)

    def rate(_: float, degC: np.ndarray) -> np.ndarray:
        return 0.9 * SIGMA * area * (293.15**4 - (degC + 273.15) ** 4) / 5e3

    exact = solve_ivp(rate, (0, 7200), [90.0], "LSODA", t_eval=time_s, rtol=1e-11, atol=1e-10).y[0]
    gap = {}
    for step in (4, 2, 1):
        out = simulate(net, net.values, drive(time_s[::step]), at(90, net), tolerance_K=1e-7)
        gap[step] = np.abs(out.readings[0, 0, :, 0] - exact[::step]).max()
    assert gap[1] < 2e-3
    assert gap[4] / gap[2] == pytest.approx(4, rel=0.15)  # second order in the step
    assert gap[2] / gap[1] == pytest.approx(4, rel=0.15)


def test_the_sample_machine_against_a_stiff_solver(sample: Network) -> None:
    """Grease that thins in both bearings, three speeds in turn; readings without lag and bonding."""
    bare = replace(sample, readings=tuple(replace(r, effects=()) for r in sample.readings))
    minutes = np.arange(0, 181.0)
    rpm = np.repeat([6000.0, 0.0, 3000.0], 60)
    room = 18.0 + 0.5 * minutes / 60
    inputs = sample_inputs(bare, 60 * minutes, rpm, room)
    out = simulate(bare, bare.values, inputs.refined(16), at(18, bare), tolerance_K=1e-6, keep_cells=True)
    start = np.full(14, 18.0)
    states = [start]
    for k, speed in enumerate((6000.0, 0.0, 3000.0)):
        rates, by_room, by_floor = truth.network(speed)
        capacity = np.array(list(truth.CAPACITY_J_PER_K.values()))

        def rate(t: float, y: np.ndarray) -> np.ndarray:
            heat = truth.heat_W(y[None], np.array([speed]), np.ones(1))[0]  # noqa: B023
            return rates @ y + by_room * (18 + 0.5 * t / 3600) + by_floor * floor + heat / capacity  # noqa: B023

        floor = 0.5 * (18.0 + 18.0) if (f := _floor(sample)) is None else f
        span = (3600.0 * k, 3600.0 * (k + 1))
        solved = solve_ivp(rate, span, states[-1], "LSODA", t_eval=[span[1]], rtol=1e-10, atol=1e-9)
        states.append(solved.y[:, -1])
    order = [sample.cells.index(n) for n in truth.NODES]
    assert out.cells_degC is not None
    np.testing.assert_allclose(out.cells_degC[0, 0, ::60][:, order], states, atol=2e-4)


def _floor(sample: Network) -> float | None:
    """The floor's temperature in a batch whose room starts at 18 degC."""
    from twin.simulation.air import air_of

    s = [g.name for g in sample.surroundings].index("floor")
    inputs = sample_inputs(sample, np.array([0.0, 60.0]), np.zeros(1), np.full(2, 18.0))
    return float(air_of(sample, sample.values[None], inputs).ends(s)[0, 0, 0, 0])


def sample_inputs(net: Network, time_s: np.ndarray, rpm: np.ndarray, room: np.ndarray):  # type: ignore[no-untyped-def]
    given = drive(time_s, rpm, room)
    first = {r.channel: np.array([room[0]]) for r in net.readings} | {"room": room[:1]}
    return replace(given, drivers={"spindle_rpm": given.drivers["rpm"]}, first=first)


def test_a_thermostat_against_its_closed_form() -> None:
    """120 W warm the body at 0.024 K/s; the coolant takes UA (T - supply) between 23 and 21 degC."""
    net = one_body("1 W/K", mechanisms={
        "belt": {"law": "belt_loss", "drivers": "rpm", "into": "shaft", "parameters": {"power": "120 W"}},
        "jacket": {"law": "jacket_chiller", "at": "shaft", "into": "shaft",
                   "parameters": {"conductance": "100 W/K", "supply": "16 degC", "set_point": "22 degC",
                                  "hysteresis": "1 K"}},
    })  # fmt: skip
    net = closed(net)
    rise_s = 2.0 / (120 / 5e3)  # from 21 to 23
    fall_s = 50.0 * np.log((23 - 17.2) / (21 - 17.2))  # towards 16 + 120 / 100
    gap = {}
    for step_s in (1.0, 0.25):
        time_s = np.arange(0, 1801.0, step_s)
        out = simulate(net, net.values, drive(time_s, rpm=6000.0), at(21, net), keep_cells=True)
        since = time_s % (rise_s + fall_s)
        fallen = 17.2 + 5.8 * np.exp(-np.maximum(since - rise_s, 0) / 50.0)
        gap[step_s] = np.abs(out.readings[0, 0, :, 0] - np.where(since < rise_s, 21 + 0.024 * since, fallen)).max()
        assert out.windows > 1  # events follow from each other: no iteration over all of it at once
        flows = out.heat_J["jacket"][0, 0, -1] + out.heat_J["belt"][0, 0, -1]
        assert flows == pytest.approx(5e3 * (out.readings[0, 0, -1, 0] - 21), abs=1e-9 * out.heat_J["belt"][0, 0, -1])
    assert gap[1.0] < 0.4  # flow holds during a step: 1 % late after 20 steps of a cycle's fall
    assert gap[0.25] < 0.12


def _singular(*_: object) -> tuple[np.ndarray, np.ndarray]:
    raise np.linalg.LinAlgError("Singular matrix")


def _nowhere(answer: Answer, part: slice, seen: np.ndarray, *_: object) -> tuple[np.ndarray, np.ndarray]:
    return np.full_like(seen, np.nan), np.zeros(0)


def test_feedback_that_does_not_contract_is_solved_by_newton_s_method(monkeypatch: pytest.MonkeyPatch) -> None:
    """Preload that tightens as the shaft leads the housing, near its own runaway."""
    net = network(
        mechanisms={
            "load": {"law": "bearing_load", "drivers": "rpm", "into": "shaft",
                     "parameters": {"count": 4, "preload": "1500 N"}},
            "tighter": {"law": "preload_feedback", "at": {"shaft": "shaft", "housing": "head"}, "acts_on": "load",
                        "parameters": {"kappa": 0.057}},
        },
    )  # fmt: skip
    time_s = np.arange(0, 14401.0, 30.0)
    inputs = drive(time_s, rpm=6000.0)
    out = simulate(net, net.values, inputs, at(20, net), tolerance_K=1e-5)
    value = {p.name.removeprefix("mechanisms.load."): v for p, v in zip(net.parameters, net.values, strict=True)}
    stress = (value["preload"] / value["static_capacity"]) ** value["load_exponent"]
    moment_Nmm = value["load_factor"] * stress * value["preload"] * value["mean_diameter"]
    base = value["count"] * 1.047e-4 * 6000 * moment_Nmm

    def rate(_: float, y: np.ndarray) -> list[float]:
        heat = base * max(1 + 0.057 * (y[0] - y[1]), 0) ** 1.33
        return [(heat + 12 * (y[1] - y[0]) + 20 - y[0]) / 5e3, (12 * (y[0] - y[1]) + 8 * (20 - y[1])) / 40e3]

    exact = solve_ivp(rate, (0, 14400), [20.0, 20.0], "LSODA", t_eval=time_s, rtol=1e-10, atol=1e-9).y.T
    rise = np.abs(exact - 20).max()
    assert rise > 5
    assert out.windows == 1 and out.iterations < 40
    np.testing.assert_allclose(out.readings[0, 0], exact, atol=2e-4 * rise)
    for share in (0.9, 1.0):  # from the trajectory of another preload, and from its own
        last = Trajectory()
        simulate(net, net.values * np.where(np.array(["preload" in p.name for p in net.parameters]), share, 1.0),
                 inputs, at(20, net), tolerance_K=1e-5, last=last)  # fmt: skip
        again = simulate(net, net.values, inputs, at(20, net), tolerance_K=1e-5, last=last)
        np.testing.assert_allclose(again.readings, out.readings, atol=1e-5)
    assert again.iterations <= 2
    for without in (_singular, _nowhere):
        with monkeypatch.context() as patch:
            patch.setattr(Answer, "run", without)
            out = simulate(net, net.values, inputs, at(20, net), tolerance_K=1e-5)
        assert out.windows > 1 and f"in {out.windows} windows" in out.message
        np.testing.assert_allclose(out.readings[0, 0], exact, atol=2e-4 * rise)


def test_what_cannot_be_solved_is_told_in_one_line() -> None:
    net = network(
        mechanisms={
            "load": {"law": "bearing_load", "drivers": "rpm", "into": "shaft",
                     "parameters": {"count": 10, "preload": "20000 N"}},
            "tighter": {"law": "preload_feedback", "at": {"shaft": "shaft", "housing": "head"}, "acts_on": "load",
                        "parameters": {"kappa": 0.5}},
        },
    )  # fmt: skip
    with pytest.raises(InputError) as caught:
        simulate(net, net.values, drive(np.arange(0, 7201.0, 60.0), rpm=6000.0), at(20, net))
    words = str(caught.value)
    assert words.startswith("stiff beyond the step control: heat 'load', batch b0, at ")
    assert "take smaller substeps, or check parameter mechanisms.load.count" in words
    assert "\n" not in words


# energy


def test_a_closed_network_keeps_its_energy() -> None:
    """Natural convection and radiation between the bodies, grease that thins, a joint that closes as it likes."""
    net = network(
        mechanisms={
            "friction": {"law": "bearing_viscous", "drivers": "rpm", "into": {"shaft": 0.7, "head": "rest"}},
            "grease": {"law": "viscosity_feedback", "at": {"oil": ["shaft", "head"]}, "acts_on": "friction"},
            "air": {"law": "natural_convection", "at": {"body": "shaft", "air": "head"}, "into": "shaft"},
            "glow": {"law": "radiation", "at": {"body": "shaft", "surrounding": "head"}, "into": "shaft"},
            "spin": {"law": "rotating_convection", "drivers": "rpm", "acts_on": "shaft-head"},
        }
    )
    net = closed(net)
    time_s = np.arange(0, 18001.0, 100.0)
    rpm = 3000 + 2500 * np.sin(np.arange(180) ** 1.3)  # too many speeds for regimes
    out = simulate(net, net.values, drive(time_s, rpm=rpm), at([60.0, 18.0], net), keep_cells=True)
    assert np.abs(out.heat_W["shaft-head beyond its mean"]).max() > 10
    _check_energy(net, out, 1e-9)


def _check_energy(net: Network, out, relative: float) -> None:  # type: ignore[no-untyped-def]
    assert out.cells_degC is not None
    stored = ((out.cells_degC - out.cells_degC[:, :, :1]) @ net.capacity_J_per_K(net.values))[0, 0]
    heats = [h for h in net.heats if h.taken is None]
    given = sum(out.heat_J[h.law.name] for h in heats)[0, 0]
    np.testing.assert_allclose(stored, given, atol=relative * np.abs(given).max())
    assert given[-1] > 1e5


# conductances that follow drivers


def test_a_noisy_speed_is_as_exact_as_the_same_speed_in_regimes() -> None:
    spin = {"law": "rotating_convection", "drivers": "rpm", "acts_on": "shaft-room"}
    belt = {"law": "belt_loss", "drivers": "rpm", "into": "shaft", "parameters": {"power": "120 W"}}
    net = network(mechanisms={"spin": spin, "belt": belt})
    time_s = np.arange(0, 7201.0, 60.0)
    steps = np.linspace(0, 6000, 60)
    rpm = steps[np.random.default_rng(0).integers(0, 60, 120)]
    few = simulate(net, net.values, drive(time_s, rpm=rpm), at(20, net))
    assert few.message == "linear: exact"
    many = rpm + np.linspace(0, 1e-3, 120)  # all different: no regimes
    gap = []
    for n in (1, 4):
        noisy = simulate(net, net.values, drive(time_s, rpm=many).refined(n), at(20, net), tolerance_K=1e-6)
        assert noisy.iterations > 1
        gap.append(np.abs(noisy.readings - few.readings).max())
    assert gap[1] < 1e-3
    assert gap[0] / gap[1] == pytest.approx(16, rel=0.3)


def test_a_draught_is_a_regime_of_the_clock() -> None:
    """The exchange doubles between 1 h and 1.5 h, while the room is 4 K colder."""
    net = one_body("10 W/K", mechanisms={
        "gate": {"law": "draught", "acts_on": ["shaft-room", "room"],
                 "parameters": {"start": "1 h", "duration": "30 min", "factor": 2, "drop": "4 K"}},
    })  # fmt: skip
    time_s = np.arange(0, 7201.0, 2.0)
    out = simulate(net, net.values, drive(time_s), at(20, net), tolerance_K=1e-6)
    degC = out.readings[0, 0, :, 0]
    blown = (time_s >= 3602) & (time_s <= 5398)  # the gate opens and closes within one interval
    np.testing.assert_allclose(degC[time_s < 3599], 20, atol=1e-9)
    np.testing.assert_allclose(degC[blown], 16 + 4 * np.exp(-(time_s[blown] - 3600) / 250.0), atol=0.012)


# the step


def test_substeps_are_chosen_by_halving() -> None:
    net = radiating(40.0)
    coarse = drive(np.arange(0, 7201.0, 300.0))
    chosen = choose_substeps(net, net.values, coarse, at(90, net), tolerance_K=0.01)
    assert chosen > 1
    fine = simulate(net, net.values, coarse.refined(64), at(90, net), tolerance_K=1e-6).readings
    gap = np.abs(simulate(net, net.values, coarse.refined(chosen), at(90, net)).readings - fine).max()
    half = np.abs(simulate(net, net.values, coarse.refined(chosen // 2), at(90, net)).readings - fine).max()
    assert gap < 0.012 < half
    linear = network()
    assert choose_substeps(linear, linear.values, drive(np.arange(0, 7201.0, 300.0), rpm=6000.0)) == 1
    with pytest.raises(InputError, match=r"even steps of .* s leave .* K, more than the 1e-09 K allowed; check"):
        choose_substeps(net, net.values, coarse, at(90, net), tolerance_K=1e-9)
