"""Structural mechanisms: what enclosure air and floor write into a machine file, and what it then does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import yaml

from data.errors import InputError
from data.machine import Machine, parse_machine
from twin.compile import compile_network, expanded
from twin.network import Network
from twin.schema import twin_part


def machine(*recorded: str, **mechanisms: Any) -> Machine:
    """Head, table and bed in recorded surroundings; `head` and `table` lead to the first of them, `bed` to the last."""
    channels: dict[str, Any] = {name: {"role": "ambient", "unit": "degC", "resolution": 0.1} for name in recorded}
    channels["t_bed"] = {"role": "temperature", "unit": "degC", "resolution": 0.1}
    twin = {
        "surroundings": {name: {"channel": name} for name in recorded},
        "bodies": {"head": {"capacity": "50 kJ/K"}, "table": {"capacity": "90 kJ/K"}, "bed": {"capacity": "900 kJ/K"}},
        "links": {"head-bed": "20 W/K", "table-bed": "14 W/K"},
        "exposures": {
            f"head-{recorded[0]}": {"value": "5 W/K", "spread": 0.5},
            f"table-{recorded[0]}": "11 W/K",
            f"bed-{recorded[-1]}": "16 W/K",
        },
        "mechanisms": mechanisms,
        "sensors": {"t_bed": {"at": "bed"}},
    }
    return parse_machine(
        yaml.safe_dump({"machine": "small", "channels": channels, "twin": twin}, sort_keys=False), "small.yml"
    )


def initial_degC(network: Network, heat_W: dict[str, float], surroundings_degC: dict[str, float]) -> dict[str, float]:
    """Temperatures of the bodies at balance."""
    values = network.values
    air = np.array([surroundings_degC[s.name] for s in network.surroundings])
    q = np.array([heat_W.get(name, 0.0) for name in network.cells])
    T = np.linalg.solve(network.conductance_W_per_K(values), q + air @ network.surrounding_W_per_K(values))
    return dict(zip(network.cells, T.tolist(), strict=True))


def test_enclosure_air_stands_between_the_surfaces_and_the_room() -> None:
    parameters = {"capacity": "25 kJ/K", "conductance": "70 W/K"}
    inside = {"law": "enclosure_air", "acts_on": ["head-room", "table-room"], "parameters": parameters}
    network = compile_network(machine("room", air=inside))
    assert network.cells == ("head", "table", "bed", "air")
    at = [network.bodies[b][0] for b in ("head", "table", "bed", "air")]
    K = network.conductance_W_per_K(network.values)[np.ix_(at, at)]
    expected = [[25, 0, -20, -5], [0, 25, -14, -11], [-20, -14, 50, 0], [-5, -11, 0, 86]]
    np.testing.assert_allclose(K, expected)
    np.testing.assert_allclose(network.surrounding_W_per_K(network.values), [[0, 0, 16, 70]])
    # all of 700 W given to the air leave by the wall or through the bed
    T = initial_degC(network, {"air": 700.0}, {"room": 20.0})
    assert 70 * (T["air"] - 20) + 16 * (T["bed"] - 20) == pytest.approx(700.0)
    assert T["air"] > T["table"] > T["bed"] > 20
    assert initial_degC(network, {}, {"room": 31.0}) == pytest.approx({b: 31.0 for b in network.cells})


def test_enclosure_air_keeps_names_values_and_priors() -> None:
    network = compile_network(
        machine("room", air={"law": "enclosure_air", "parameters": {"capacity": {"value": "9 kJ/K", "spread": 0.4}}})
    )
    head = network.parameters[network.index("exposures.head-room.conductance")]
    assert (head.value, head.free) == (5.0, True)
    air = network.parameters[network.index("bodies.air.capacity")]
    assert (air.value, air.spread, air.low, air.high) == (9000.0, 0.4, 10.0, 1e7)
    wall = network.parameters[network.index("exposures.air-room.conductance")]
    assert (wall.value, wall.free) == (70.0, False)
    assert "energy balance" in wall.source
    assert not network.heats


@pytest.mark.parametrize(
    "acts_on, moved", [(None, {"head", "table", "bed"}), ("room", {"head", "table", "bed"}), ("table-room", {"table"})]
)
def test_which_exposures_are_moved(acts_on: str | None, moved: set[str]) -> None:
    given = {"law": "enclosure_air"} | ({"acts_on": acts_on} if acts_on else {})
    part = expanded(twin_part(machine("room", air=given)))
    assert {e.of for e in part.exposures.values() if e.to == "air"} == moved
    assert part.exposures["air-room"].to == "room"
    assert "air" not in part.mechanisms


def test_of_two_surroundings_the_exposures_tell_the_one_outside() -> None:
    part = expanded(twin_part(machine("hall", "room", air={"law": "enclosure_air", "acts_on": "hall"})))
    assert part.exposures["air-hall"].to == "hall"
    assert part.exposures["bed-room"].to == "room"


def test_other_mechanisms_may_use_what_was_added() -> None:
    pump = {"law": "cabinet_heat", "into": "air", "parameters": {"heat": "60 W"}, "drivers": {"running": "pump"}}
    small = machine("room", air={"law": "enclosure_air"}, auxiliaries=pump)
    with_pump = small.model_copy(update={"channels": {**small.channels, "pump": small.channels["room"].model_copy(
        update={"role": "driver", "unit": "1"}
    )}})  # fmt: skip
    network = compile_network(with_pump)
    np.testing.assert_array_equal(network.heats[0].direction(network.values), [0, 0, 0, 1])


def test_floor_sink_at_a_place_and_beside_a_named_room() -> None:
    sink = {"law": "floor_sink", "at": {"body": "bed", "room": "room"}}
    part = expanded(twin_part(machine("hall", "room", ground=sink)))
    assert part.surroundings["ground"].first == ("room",)
    assert (part.exposures["bed-ground"].of, part.exposures["bed-ground"].to) == ("bed", "ground")


@pytest.mark.parametrize(
    "given, line",
    [
        (
            {"law": "enclosure_air", "acts_on": "tabel-room"},
            "mechanisms.odd.acts_on: no exposure 'tabel-room'; did you mean 'table-room'?",
        ),
        (
            {"law": "enclosure_air", "acts_on": ["head-hall", "bed-room"]},
            "mechanisms.odd.acts_on: these exposures lead to hall and room; name those to one of them",
        ),
        (
            {"law": "enclosure_air"},
            "mechanisms.odd.acts_on: recorded surroundings are hall and room; name the one that is meant",
        ),
        (
            {"law": "enclosure_air", "parameters": {"capasity": "1 kJ/K"}},
            "mechanisms.odd.parameters: enclosure_air has no parameter 'capasity'; did you mean 'capacity'?",
        ),
        ({"law": "floor_sink"}, "mechanisms.odd.at: expected the body that stands on the floor, e.g. at: bed"),
        (
            {"law": "floor_sink", "at": "bed"},
            "mechanisms.odd.at: recorded surroundings are hall and room; name the one that is meant",
        ),
        (
            {"law": "floor_sink", "at": {"body": "bed", "room": "hal"}},
            "mechanisms.odd.at.room: no surrounding 'hal'; did you mean 'hall'?",
        ),
        (
            {"law": "floor_sink", "at": {"body": "bed", "room": "hall"}, "parameters": {"conductance": "2 kW/K"}},
            "exposures.bed-odd.conductance: 2000 W/K lies outside the bounds 0 to 1000; widen them or correct it",
        ),
    ],
)
def test_what_makes_no_sense_is_one_clear_line(given: dict[str, Any], line: str) -> None:
    rooms = ("room",) if "tabel-room" in str(given) else ("hall", "room")
    with pytest.raises(InputError) as told:
        compile_network(machine(*rooms, odd=given))
    assert str(told.value).startswith(f"machine small: twin.{line}")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("given", [{"law": "enclosure_air"}, {"law": "floor_sink", "at": "bed"}])
def test_a_name_that_is_taken(given: dict[str, Any]) -> None:
    for name in ("bed", "room"):
        with pytest.raises(InputError, match=f"mechanisms.{name}: a body or surrounding is called '{name}' already"):
            compile_network(machine("room", **{name: given}))


def test_a_wall_stated_twice() -> None:
    small = machine("room", air={"law": "enclosure_air"})
    small.twin["exposures"]["air-room"] = "50 W/K"
    with pytest.raises(
        InputError, match=r"exposures\.air-room: enclosure_air adds this one; state it as mechanisms\.air"
    ):
        compile_network(small)
