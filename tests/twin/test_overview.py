"""A network as it is told: bodies, ties, heat, chains, the count of parameters, and its modes in words."""

from __future__ import annotations

import math

import numpy as np
import pytest

from data.machine import Machine
from tests.twin.drives import network
from tests.twin.machines import machine
from twin.compile import compile_network, expanded
from twin.network import Network
from twin.schema import twin_part
from twin.simulation.start import steady_state
from twin.views.overview import ModeView, Overview, machine_modes, mode_views, overview, time_words


def view(speed: float | None = None, **changes: object) -> Overview:
    given = machine(**changes)
    net, part = compile_network(given), expanded(twin_part(given))
    drivers = None if speed is None else {"rpm": speed}
    steady = None if drivers is None else steady_state(net, drivers, 20.0)
    return overview(net, part, "two", True, steady, drivers)


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


def test_the_sample_machine(sample: Network, sample_machine: Machine) -> None:
    v = overview(sample, expanded(twin_part(sample_machine)), simulated=sample_machine.simulated)
    assert (len(v.bodies), sum(not t.ground for t in v.ties), sum(t.ground for t in v.ties)) == (14, 16, 17)
    assert v.free + v.fixed == len(sample.parameters) and v.free == len(sample.free)
    assert {s.name: s.label for s in v.surroundings}["floor"] == ("17.65 °C + 0.5 × (first reading of room − 17.65 °C)")
    for chain in v.chains:
        assert sum(length for _, length, _ in chain.parts) == pytest.approx(0.0, abs=1e-12)
    z = next(c for c in v.chains if c.channel == "z")
    assert z.tilts == (("column_front", "column_back", pytest.approx(-10.8 * 1.25 / 0.5 * 0.45)),)
    assert z.also == ("speed_shift",)


@pytest.fixture(scope="module")
def at_6000(sample: Network) -> list[ModeView]:
    steady = steady_state(sample, {"spindle_rpm": 6000.0}, 20.0)
    return mode_views(sample, machine_modes(sample, steady.factor), steady.degC - 20.0)


def test_the_sample_machine_takes_as_long_as_its_text_says(at_6000: list[ModeView]) -> None:
    """7.7 h, 2.8 h, 1.5 h, 49 min, 20 to 25 min, the rest at most 11 min."""
    said = [time_words(v.time_constant_s) for v in at_6000]
    assert said[:4] == ["7.7 h", "2.8 h", "1.5 h", "49 min"]
    minutes = np.array([v.time_constant_s for v in at_6000]) / 60
    assert len(minutes) == 14 and (np.diff(minutes) < 0).all()
    assert all(19.5 < m < 25.5 for m in minutes[4:7]) and minutes[7] < 11


def test_what_moves_against_what(at_6000: list[ModeView]) -> None:
    words = {time_words(v.time_constant_s): v.label for v in at_6000}
    assert words["7.7 h"] == "bed and table against the room"
    assert words["2.8 h"] == "table against bed"
    assert words["49 min"] == "column_back against head_rear and head_front"
    assert at_6000[6].label == "fixture against table"
    assert [v.label for v in at_6000 if max(v.weight, key=lambda b: v.weight[b]) == "air"] == ["air against the room"]


def test_shapes_are_normed_and_weights_and_shares_add_up(at_6000: list[ModeView]) -> None:
    for v in at_6000:
        assert max(abs(a) for a in v.shape.values()) == pytest.approx(1.0)
        assert sum(v.weight.values()) == pytest.approx(1.0)
    for channel in ("x", "y", "z"):
        assert sum(v.share[channel] for v in at_6000) == pytest.approx(1.0)


def test_the_modes_together_bring_the_displacement_of_the_whole_rise(sample: Network, at_6000: list[ModeView]) -> None:
    steady = steady_state(sample, {"spindle_rpm": 6000.0}, 20.0)
    for row in sample.errors:
        whole = float(row.matrix(sample.values) @ (steady.degC - 20.0))
        assert sum(v.error[row.channel] for v in at_6000) == pytest.approx(whole, abs=1e-9)


def test_one_body_in_a_room() -> None:
    net = network(**{
        "bodies__head": None, "links": {}, "sensors__t_head": None, "exposures": {"shaft-room": "2 W/K"},
        "errors__z__chain": [{"body": "shaft", "gain": "2 um/K"}],
    })  # fmt: skip
    (view,) = mode_views(net, machine_modes(net), np.array([10.0]))
    assert view.time_constant_s == pytest.approx(2500.0) and view.label == "shaft against the room"
    assert view.error == pytest.approx({"z": 20.0}) and view.share == pytest.approx({"z": 1.0})


def test_a_bar_that_bends_its_temperature_moves_within() -> None:
    net = network(**{
        "bodies__head": {
            "capacity": "40 kJ/K", "material": "cast_iron", "shape": "bar", "cells": 6, "conductance": "0.5 W/K",
        },
        "exposures": {"shaft-room": "1 W/K", "head-room": "8 W/K"}, "links": {"shaft-head@0": "1 W/K"},
    })  # fmt: skip
    words = [v.label for v in mode_views(net, machine_modes(net))]
    assert words[0] == "head and shaft against the room" and "head within" in words


@pytest.mark.parametrize(
    ("time_s", "words"),
    [(27864, "7.7 h"), (5400, "1.5 h"), (5399, "1.5 h"), (5390, "90 min"), (2940, "49 min"), (522, "8.7 min"),
     (597.5, "10 min"), (35, "35 s"), (float("inf"), "for ever")],
)  # fmt: skip
def test_times_in_words(time_s: float, words: str) -> None:
    assert time_words(time_s) == words
