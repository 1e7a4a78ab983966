"""The twin part of a machine file: what it becomes, and what is told when it makes no sense."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from data.errors import InputError
from data.machine import parse_machine
from plants.sample import sample_machine as truth
from plants.sample.thermal_machine import ROTATING_GAIN
from tests.twin.machines import TWO_BODIES, machine
from twin.compile import compile_network
from twin.network import Network


def test_the_sample_machine_file_is_the_sample_machine(sample: Network) -> None:
    order = [sample.cells.index(n) for n in truth.NODES]
    capacity = sample.capacity_J_per_K(sample.values)[order]
    np.testing.assert_allclose(capacity, list(truth.CAPACITY_J_PER_K.values()))
    rates, room, floor = truth.network(0.0)
    stiff = sample.conductance_W_per_K(sample.values)[np.ix_(order, order)]
    np.testing.assert_allclose(-stiff / capacity[:, None], rates, rtol=1e-12, atol=1e-18)
    gains = sample.surrounding_W_per_K(sample.values)[:, order] / capacity
    names = [s.name for s in sample.surroundings]
    np.testing.assert_allclose(gains[names.index("room")], room)
    np.testing.assert_allclose(gains[names.index("floor")], floor)


def test_speed_dependent_convection_multiplies_the_named_exposures(sample: Network) -> None:
    order = [sample.cells.index(n) for n in truth.NODES]
    rates, _, _ = truth.network(4000.0)
    factor = np.array([1.0 + ROTATING_GAIN * (4000.0 / truth.RATED_RPM) ** (2 / 3)])
    stiff = sample.conductance_W_per_K(sample.values, factor)[np.ix_(order, order)]
    capacity = sample.capacity_J_per_K(sample.values)[order]
    np.testing.assert_allclose(-stiff / capacity[:, None], rates, rtol=1e-12, atol=1e-18)


def test_the_sample_chains_give_the_sample_displacement(sample: Network) -> None:
    rise = np.random.default_rng(1).normal(0.0, 5.0, (7, sample.n_cells))
    order = [sample.cells.index(n) for n in truth.NODES]
    expected = truth.displacement_um(rise[:, order], np.zeros(7))
    for row in sample.errors:
        got = rise @ row.matrix(sample.values)
        tolerance = 0.02 if row.channel == "x" else 1e-9  # the bow's gain is given with two digits
        np.testing.assert_allclose(got, expected[row.channel], atol=tolerance * np.abs(rise).max())


def test_a_uniform_warm_up_of_one_expansion_gives_nothing(sample: Network) -> None:
    values = sample.values.copy()
    for k, p in enumerate(sample.parameters):
        if p.name.endswith(".expansion"):
            values[k] = 11.5
    for row in sample.errors:
        assert abs(row.matrix(values).sum()) < 1e-9


def test_about_45_parameters_of_the_sample_machine_are_free(sample: Network) -> None:
    assert 40 <= len(sample.free) <= 60
    assert all(math.isfinite(sample.parameters[k].spread) for k in sample.free)


def test_a_bar_refines_by_one_number_and_keeps_its_sums() -> None:
    bar = {"mass": "10 kg", "material": "steel", "shape": "bar", "cells": 5, "length": "0.5 m", "area": "20 cm**2"}
    bar = bar | {"area": "0.002 m**2"}
    network = compile_network(machine(bodies__head=bar, sensors__t_head={"at": "head@0.5"}))
    assert network.n_cells == 6
    assert network.capacity_J_per_K(network.values)[1:].sum() == pytest.approx(4600.0)
    inside = [e for e in network.edges if e.name == "head"]
    # neighbours are L / 5 apart: k A / (L / 5)
    assert [float(e.conductance(network.values)) for e in inside] == pytest.approx([48.0 * 0.002 / 0.1] * 4)
    np.testing.assert_allclose(network.readings[1].cells, [0, 0, 0, 1, 0, 0])
    whole = [e for e in network.edges if e.name == "head-room"]
    assert sum(float(e.conductance(network.values)) for e in whole) == pytest.approx(8.0)


def test_a_plate_conducts_both_ways() -> None:
    plate = {"mass": "30 kg", "material": "cast_iron", "shape": "plate", "cells": [4, 2],
             "length": "0.8 m", "width": "0.4 m", "thickness": "0.02 m"}  # fmt: skip
    network = compile_network(machine(bodies__head=plate, sensors__t_head={"at": "head@0,0"}))
    inside = [float(e.conductance(network.values)) for e in network.edges if e.name == "head"]
    # squares of 0.2 m: k t both ways, 3 × 2 and 4 × 1 neighbours
    assert inside == pytest.approx([50.0 * 0.02] * 10)
    assert network.readings[1].cells[1] == 1.0


def test_joint_bar_and_plain_links_are_conductances() -> None:
    joint = {"area": "20 cm**2", "coefficient": "3000 W/m**2/K"}
    network = compile_network(machine(**{"links__shaft-head": joint}))
    assert float(network.edges[0].conductance(network.values)) == pytest.approx(6.0)
    bar = {"area": "0.001 m**2", "length": "100 mm", "material": "steel"}
    network = compile_network(machine(**{"links__shaft-head": bar}))
    assert float(network.edges[0].conductance(network.values)) == pytest.approx(0.48)


def test_units_are_converted_and_a_spread_frees() -> None:
    network = compile_network(machine())
    shaft = network.parameters[network.index("bodies.shaft.capacity")]
    assert (shaft.value, shaft.unit, shaft.free, shaft.spread) == (5000.0, "J/K", True, 0.3)
    assert not network.parameters[network.index("exposures.shaft-room.conductance")].free


BAD = {
    "an unknown key": (
        {"bodies__shaft__capcity": "5 kJ/K"},
        "unknown key 'twin.bodies.shaft.capcity'; did you mean 'capacity'?",
    ),
    "a wrong unit": ({"links__shaft-head": "12 W"}, "links.shaft-head.conductance: unit 'W' cannot be read as 'W/K'"),
    "a negative conductance": (
        {"links__shaft-head": "-12 W/K"},
        "links.shaft-head.conductance: got '-12 W/K', expected a conductance above 0 W/K",
    ),
    "a missing prior": (
        {"links__shaft-head": {"value": "12 W/K", "free": True}},
        "links.shaft-head.conductance is free but has no prior; add 'spread', e.g. spread: 0.5",
    ),
    "not finite": (
        {"bodies__shaft__capacity": "nan J/K"},
        "bodies.shaft.capacity: expected a finite number such as '1 J/K', got 'nan J/K'",
    ),
    "out of bounds": (
        {"links__shaft-head": {"value": "12 W/K", "spread": 0.5, "bounds": ["1 W/K", "10 W/K"]}},
        "links.shaft-head.conductance: 12 W/K lies outside the bounds 1 to 10; widen them or correct it",
    ),
    "an island": (
        {"exposures__shaft-room": None, "exposures__head-room": None},
        "bodies.shaft: no path from shaft, head to a surrounding; add an exposure, or a link to what has one",
    ),
    "a sensor nowhere": (
        {"sensors__t_head": {"at": "haed"}},
        "sensors.t_head.at: no body 'haed'; did you mean 'head'?",
    ),
    "a sensor outside": (
        {"sensors__t_head": {"at": "head@1.5"}},
        "sensors.t_head.at: got 'head@1.5', expected a position from 0 to 1 after @",
    ),
    "no such channel": (
        {"sensors__t_heat": {"at": "head"}},
        "sensors.t_heat: no channel 't_heat' in 'channels'; did you mean 't_head'?",
    ),
    "a driver that the recordings lack": (
        {"mechanisms__belt__drivers": "rmp"},
        "mechanisms.belt.drivers.speed: no channel 'rmp'; did you mean 'rpm'?",
    ),
    "a driver of another kind": (
        {"mechanisms__belt__drivers": "room"},
        "mechanisms.belt.drivers.speed: channel 'room' is in degC, belt_loss needs rpm",
    ),
    "no such law": (
        {"mechanisms__belt__law": "belt_los"},
        "mechanisms.belt.law: no mechanism 'belt_los'; did you mean 'belt_loss'?",
    ),
    "no such parameter": (
        {"mechanisms__belt__parameters": {"powr": "120 W"}},
        "mechanisms.belt.parameters: belt_loss has no parameter 'powr'; did you mean 'power'?",
    ),
    "an open chain": (
        {"errors__z__chain": [{"body": "shaft", "length": "0.4 m"}, {"body": "head", "length": "0.3 m", "sign": -1}]},
        "errors.z.chain does not close: its signed lengths add up to 0.1 m, expected 0 m, so warming all by 1 K "
        "would give 1.1 um too much; correct a length or a sign, or state uniform_length",
    ),
    "shares above one": (
        {"mechanisms__belt__into": {"shaft": 0.7, "head": 0.6}},
        "mechanisms.belt.into: got 0 places with 'rest', expected one, so that the shares make up 1",
    ),
    "acting on nothing": (
        {"mechanisms__spin": {"law": "rotating_convection", "drivers": "rpm", "acts_on": "shaft-roam"}},
        "mechanisms.spin.acts_on: rotating_convection cannot change 'shaft-roam'; did you mean 'shaft-room'?",
    ),
    "a link to itself": (
        {"links__loop": {"between": ["head", "head"], "conductance": "1 W/K"}},
        "links.loop.between: both ends are 'head'; link two different places",
    ),
    "several cells in a lump": (
        {"bodies__head__cells": 4},
        "bodies.head.cells: got 4 for a lump; set shape: bar or plate, or cells: 1",
    ),
    "no expansion": (
        {"bodies__head__material": None},
        "errors.z.chain[1].expansion: needs a coefficient of thermal expansion; give 'material' or write the value",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_mistake_is_one_line_with_file_key_and_remedy(case: str) -> None:
    changes, words = BAD[case]
    with pytest.raises(InputError) as told:
        compile_network(machine(**changes), "machine file two_bodies.yml")
    text = str(told.value)
    assert text.startswith("machine file two_bodies.yml: ") and "\n" not in text
    assert words in text


def test_a_machine_file_without_a_twin_part_says_so() -> None:
    raw = {k: v for k, v in TWO_BODIES.items() if k != "twin"}
    with pytest.raises(InputError, match="key 'twin' is missing; add bodies, surroundings, links and sensors"):
        compile_network(parse_machine(yaml.safe_dump(raw), "x"))


def test_a_warmer_start_lifts_every_cell_of_a_body_by_the_whole_amount() -> None:
    bar = {"capacity": "40 kJ/K", "material": "cast_iron", "shape": "bar", "cells": 4, "conductance": "50 W/K"}
    warm = {"law": "initial_state", "into": "head", "parameters": {"excess": "2 K"}}
    network = compile_network(machine(bodies__head=bar, mechanisms__warm=warm))
    np.testing.assert_array_equal(network.starts[0][1], [0, 1, 1, 1, 1])
