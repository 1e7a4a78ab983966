"""Derivatives of every channel against central differences, and how fast they converge with the step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from tests.twin.drives import at, drive, network, one_body
from tests.twin.test_simulation import sample_inputs
from twin.network import Network
from twin.simulation import simulate
from twin.simulation.inputs import Inputs
from twin.simulation.sensitivity import Selected, sensitivities


def gaps(
    net: Network, inputs: Inputs, start: np.ndarray, numbers: list[int], values: np.ndarray | None = None
) -> np.ndarray:
    """Largest error of each parameter's derivative, relative to its largest value in readings or errors, (Q,)."""
    values = net.values if values is None else values
    _, d_readings, d_errors = sensitivities(net, values, inputs, start, Selected(numbers), tolerance_K=1e-8)
    moved = np.repeat(values[None], 2 * len(numbers), axis=0)
    for q, j in enumerate(numbers):
        p = net.parameters[j]
        moved[2 * q : 2 * q + 2, j] = p.from_x(p.to_x(values[j]) + np.array([1e-4, -1e-4]))
    sides = simulate(net, moved, inputs, start, tolerance_K=1e-9)
    out = np.zeros(len(numbers))
    for got, both in ((d_readings, sides.readings), (d_errors, sides.errors)):
        expected = (both[::2] - both[1::2]) / 2e-4
        size, gap = (np.abs(a).max(axis=(1, 2, 3)) for a in (expected, got - expected))
        assert np.all(gap[size < 1e-8] < 1e-7)
        out = np.maximum(out, np.where(size < 1e-8, 0.0, gap / np.maximum(size, 1e-8)))
    return out


def test_every_free_parameter_of_the_sample_machine(sample: Network) -> None:
    time_s = np.arange(0, 7201.0, 300.0)
    rpm = np.array([6000.0] * 12 + [0.0] * 6 + [2000.0] * 6)
    inputs = sample_inputs(sample, time_s, rpm, 18 + time_s / 3600)
    start = 18 + np.random.default_rng(0).normal(0, 1, (1, 1, 14))
    numbers = sample.free.tolist()
    assert len(numbers) >= 40
    gap = gaps(sample, inputs.refined(4), start, numbers)
    assert gap.max() < 2e-4
    assert np.median(gap) < 1e-5
    few = [j for j, q in zip(numbers, gap, strict=True) if q > 3e-5]  # those that the step limits: fourth order
    coarse = gaps(sample, inputs.refined(2), start, few)
    np.testing.assert_array_less(8, coarse / gap[[numbers.index(j) for j in few]])


EVERYTHING = {
    "friction": {"law": "bearing_viscous", "drivers": "rpm", "into": {"shaft": 0.7, "head": "rest"}},
    "grease": {"law": "viscosity_feedback", "at": {"oil": ["shaft", "head"]}, "acts_on": "friction"},
    "walls": {"law": "radiation", "at": {"body": "head", "surrounding": "room"}, "into": "head"},
    "air": {"law": "natural_convection", "at": {"body": "shaft", "air": "head"}, "into": "shaft"},
    "spin": {"law": "rotating_convection", "drivers": "rpm", "acts_on": ["shaft-room"]},
    "layer": {"law": "stratification", "acts_on": "room"},
    "gate": {"law": "draught", "acts_on": "head-room", "parameters": {"start": "1 h"}},
    "warm": {"law": "initial_state", "into": "head", "parameters": {"excess": "2 K"}},
    "shift": {"law": "speed_shift", "drivers": "rpm", "acts_on": "z"},
}


def everything() -> Network:
    """Every kind of parameter at work on the two bodies."""
    bar = {"capacity": "40 kJ/K", "shape": "bar", "cells": 4, "conductance": "30 W/K", "material": "cast_iron"}
    return network(
        mechanisms=EVERYTHING,
        surroundings={
            "room": {"channel": "room", "offset": "0.3 K"},
            "floor": {"value": "17 degC", "first": ["t_head"], "follow": 0.4},
        },
        exposures__foot={"of": "head@0", "to": "floor", "value": "5 W/K"},
        bodies__head=bar,
        sensors={
            "t_shaft": {"at": "shaft", "air": "room", "lag": "45 s", "bonding": 0.9, "offset": "0.1 K"},
            "t_head": {"at": "head@0.7"},
        },
    )  # fmt: skip


def test_every_kind_of_parameter() -> None:
    net = everything()
    time_s = np.arange(0, 7201.0, 60.0)
    rpm = np.repeat([5000.0, 0.0, 2500.0, 4000.0], 30)
    inputs = drive(time_s, rpm=rpm, room=20 + time_s / 7200)
    switch = {net.index("mechanisms.gate.start"), net.index("mechanisms.gate.duration")}  # no derivative at all
    numbers = [j for j in range(len(net.parameters)) if j not in switch and net.values[j] != 0]
    gap = gaps(net, inputs.refined(2), at(25, net), numbers)
    assert gap.max() < 1e-3, net.parameters[numbers[int(gap.argmax())]].name
    few = [j for j, q in zip(numbers, gap, strict=True) if q > 1e-4]  # strong feedback: second order, as the simulation
    finer = gaps(net, inputs.refined(4), at(25, net), few)
    np.testing.assert_allclose(gap[[numbers.index(j) for j in few]] / finer, 4, rtol=0.15)


def test_behind_the_end_of_a_short_batch_derivatives_hold_like_readings() -> None:
    net = everything()
    time_s = np.arange(0, 7201.0, 60.0)
    inputs = drive(time_s, rpm=4000.0, room=20 + time_s / 7200, n_batches=2)
    inputs = replace(inputs, n_intervals=np.array([120, 47]))
    names = [p.name for p in net.parameters]
    numbers = [j for j, name in enumerate(names) if net.values[j] != 0 and not name.startswith("mechanisms.gate")]
    assert gaps(net, inputs, at(25, net), numbers).max() < 4e-3


def test_starts_and_offsets_are_each_batchs_own() -> None:
    net = everything()
    inputs = drive(np.arange(0, 3601.0, 60.0), rpm=4000.0, n_batches=2)
    start = np.broadcast_to(np.array([25.0, 20, 21, 22, 23]), (1, 2, 5))
    _, d_readings, d_errors = sensitivities(net, net.values, inputs, start, Selected([], True, [0, 1]))
    assert d_readings.shape == (4, 2, 61, 2) and d_errors.shape == (4, 2, 61, 1)
    for q in range(4):
        sides = []
        for side in (1e-3, -1e-3):
            moved, offsets = start.copy(), np.zeros((1, 2, 2))
            if q < 2:
                moved[:, :, list(net.bodies.values())[q]] += side
            else:
                offsets[:, :, q - 2] = side
            sides.append(simulate(net, net.values, replace(inputs, offsets_K=offsets), moved, tolerance_K=1e-9))
        for got, name in ((d_readings[q], "readings"), (d_errors[q], "errors")):
            expected = (getattr(sides[0], name) - getattr(sides[1], name))[0] / 2e-3
            np.testing.assert_allclose(got, expected, atol=1e-5 * np.abs(expected).max())


def test_derivatives_of_a_linear_network_hardly_need_substeps() -> None:
    net = network()
    gap = gaps(net, drive(np.arange(0, 7201.0, 120.0), rpm=5000.0), at([25, 20], net), net.free.tolist())
    assert gap.max() < 3e-5


def test_derivatives_of_strong_feedback_and_of_a_thermostat() -> None:
    mechanisms = {
        "load": {"law": "bearing_load", "drivers": "rpm", "into": "shaft",
                 "parameters": {"count": 4, "preload": "1500 N"}},
        "tighter": {"law": "preload_feedback", "at": {"shaft": "shaft", "housing": "head"}, "acts_on": "load",
                    "parameters": {"kappa": 0.057}},
    }  # fmt: skip
    net = network(mechanisms=mechanisms)
    inputs = drive(np.arange(0, 14401.0, 60.0), rpm=6000.0)
    numbers = [net.index(n) for n in ("mechanisms.load.preload", "mechanisms.tighter.kappa", "bodies.shaft.capacity")]
    assert gaps(net, inputs, at(20, net), numbers).max() < 1e-4
    cooled = one_body("5 W/K", mechanisms={
        "jacket": {"law": "jacket_chiller", "at": "shaft", "into": "shaft",
                   "parameters": {"conductance": "20 W/K", "supply": "16 degC", "set_point": "30 degC"}}})  # fmt: skip
    inputs = drive(np.arange(0, 601.0, 5.0))
    numbers = [cooled.index(f"mechanisms.jacket.{n}") for n in ("conductance", "supply")]
    numbers += [cooled.index("exposures.shaft-room.conductance"), cooled.index("bodies.shaft.capacity")]
    assert gaps(cooled, inputs, at(50, cooled), numbers).max() < 1e-3  # on all the time


def test_a_factor_too_fine_for_regimes_has_derivatives() -> None:
    net = network(mechanisms={"spin": {"law": "rotating_convection", "drivers": "rpm", "acts_on": "shaft-room"}})
    rpm = 3000 + 2500 * np.sin(np.arange(120) ** 1.3)
    inputs = drive(np.arange(0, 7201.0, 60.0), rpm=rpm)
    numbers = [
        net.index(n) for n in ("mechanisms.spin.gain", "exposures.shaft-room.conductance", "bodies.head.capacity")
    ]
    assert gaps(net, inputs.refined(4), at([40, 20], net), numbers).max() < 1e-4


def test_one_set_only() -> None:
    net = network()
    with pytest.raises(InputError, match="machine two_bodies: sensitivities need one set of start temperatures"):
        sensitivities(net, net.values, drive(np.array([0.0, 60.0])), np.zeros((2, 1, 2)))
