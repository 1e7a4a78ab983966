"""A network as it is told: bodies, ties, heat, chains, and the count of parameters."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from data.machine import load_machine
from tests.twin.machines import machine
from twin.compile import compile_network, expanded
from twin.schema import twin_part
from twin.simulation.start import steady_state
from twin.views.overview import Overview, overview

SAMPLE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"


def view(speed: float | None = None, **changes: object) -> Overview:
    given = machine(**changes)
    network, part = compile_network(given), expanded(twin_part(given))
    drivers = None if speed is None else {"rpm": speed}
    steady = None if drivers is None else steady_state(network, drivers, 20.0)
    return overview(network, part, "two", True, steady, drivers)


def test_bodies_with_capacity_time_constant_and_parameters() -> None:
    shaft, head = view().bodies
    assert (shaft.name, shaft.capacity_J_per_K, shaft.n_cells) == ("shaft", 5000.0, 1)
    assert shaft.time_constant_s == pytest.approx(5000 / 13) and head.time_constant_s == pytest.approx(40000 / 20)
    # shaft: capacity and the link are free, its exposure is fixed; head: capacity, link and exposure are free
    assert (shaft.free, shaft.fixed) == (2, 1) and (head.free, head.fixed) == (3, 0)


def test_links_exposures_and_sensors() -> None:
    v = view()
    assert {(t.name, t.ends, t.conductance_W_per_K, t.ground) for t in v.ties} == {
        ("shaft-head", ("shaft", "head"), 12.0, False),
        ("shaft-room", ("shaft", "room"), 1.0, True),
        ("head-room", ("head", "room"), 8.0, True),
    }
    assert v.sensors == (("t_shaft", "shaft"), ("t_head", "head"))
    assert [s.label for s in v.surroundings] == ["recorded as room"]


def test_heat_has_watts_only_at_a_stated_speed() -> None:
    (heat,) = view().heats
    assert (heat.law, heat.body, heat.share) == ("belt", "shaft", 1.0) and math.isnan(heat.watts)
    v = view(6000.0)
    assert v.heats[0].watts == pytest.approx(120.0)
    assert v.stated == "steady state, rpm = 6000, surroundings at 20 °C"


def test_chains_have_signed_lengths_and_gains() -> None:
    (chain,) = view().chains
    assert chain.channel == "z" and chain.parts == (
        ("shaft", 0.4, pytest.approx(0.4 * 11.5)),
        ("head", -0.4, pytest.approx(-0.4 * 10.8)),
    )


def test_a_body_of_several_cells_is_one_with_its_whole_exposure() -> None:
    bar = {"capacity": "40 kJ/K", "material": "cast_iron", "shape": "bar", "cells": 5, "conductance": "9 W/K"}
    v = view(bodies__head=bar, links={"shaft-head@0": "12 W/K"})
    head = v.bodies[1]
    assert (head.n_cells, head.capacity_J_per_K) == (5, pytest.approx(40e3))
    ties = {t.name: t for t in v.ties}
    assert ties["head-room"].conductance_W_per_K == pytest.approx(8.0)
    assert ties["shaft-head@0"].ends == ("shaft", "head")


def test_the_sample_machine() -> None:
    given = load_machine(SAMPLE)
    network = compile_network(given)
    v = overview(network, expanded(twin_part(given)), simulated=given.simulated)
    assert (len(v.bodies), sum(not t.ground for t in v.ties), sum(t.ground for t in v.ties)) == (14, 16, 17)
    assert v.free + v.fixed == len(network.parameters) and v.free == len(network.free)
    assert {s.name: s.label for s in v.surroundings}["floor"] == ("17.65 °C + 0.5 × (first reading of room − 17.65 °C)")
    for chain in v.chains:
        assert sum(length for _, length, _ in chain.parts) == pytest.approx(0.0, abs=1e-12)
    z = next(c for c in v.chains if c.channel == "z")
    assert z.tilts == (("column_front", "column_back", pytest.approx(-10.8 * 1.25 / 0.5 * 0.45)),)
    assert z.also == ("speed_shift",)
