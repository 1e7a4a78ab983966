"""A value of the twin part by its parameter's name: changed there and nowhere else."""

from __future__ import annotations

from typing import Any

import pytest

from diagnosis.candidates.alternatives import alternatives
from diagnosis.contracts import with_value
from tests.diagnosis.small_cases import equipped, four_bodies, two_bodies
from twin.compile import compile_network
from twin.quantity import Parameter
from twin.schema import TwinPart, twin_part

BAR = {"capacity": "40 kJ/K", "shape": "bar", "cells": 3, "conductance": "30 W/K", "material": "cast_iron"}
ALL = {
    "surroundings": {"room": {"channel": "room", "offset": "0.1 K"},
                     "floor": {"value": "17 degC", "first": ["room"], "follow": 0.4}},
    "bodies__head": BAR,
    "links": {"shaft-head@0.25": {"area": "0.01 m**2", "coefficient": "1200 W/m**2/K"}},
    "exposures": {"shaft-room": "1 W/K", "head@0.8-room": "8 W/K",
                  "head-floor": {"of": "head@0", "to": "floor", "value": "2 W/K"}},
    "mechanisms__belt": {"law": "belt_loss", "drivers": "rpm", "into": {"shaft": 0.7, "head": "rest"}},
    "sensors__t_head": {"at": "head@0.5", "air": "room", "lag": "60 s", "bonding": 0.9, "offset": "0.1 K"},
    "errors__z": {"chain": [{"body": "shaft", "length": "0.4 m"}, {"body": "head", "length": "0.4 m", "sign": -1}],
                  "tilts": [{"hot": "head@1", "cold": "head@0", "gain": "2 um/K"}]},
    "materials": {"mine": {"specific_heat": "500 J/kg/K", "conductivity": "50 W/m/K", "expansion": "11 um/m/K"}},
    "bodies__shaft": {"mass": "10 kg", "material": "mine"},
}  # fmt: skip
MACHINE = two_bodies(**ALL)
PART = twin_part(MACHINE)
BUILT_IN = "materials.cast_iron"


def parameters() -> dict[str, Parameter]:
    return {p.name: p for p in compile_network(MACHINE).parameters}


def values(part: TwinPart) -> dict[str, float]:
    return {p.name: p.value for p in compile_network(MACHINE, part=part).parameters}


@pytest.mark.parametrize("name", [n for n in parameters() if not n.startswith(BUILT_IN)])
def test_every_value_can_be_changed_and_no_other_moves(name: str) -> None:
    p = parameters()[name]
    share = 1 - 1e-6 if ".chain[" in name else 0.9  # a chain of lengths must stay closed to a micrometre
    new = share * p.value if p.value else 0.01
    part = with_value(PART, p, value=f"{new!r} {p.unit}")
    before, after = values(PART), values(part)
    assert after.pop(name) == pytest.approx(new, rel=1e-9)
    before.pop(name)
    assert after == before


@pytest.mark.parametrize("changes", [{"spread": 0.7}, {"per_batch": 0.2}])
def test_what_was_a_default_is_written_out(changes: dict[str, Any]) -> None:
    p = parameters()["mechanisms.belt.power"]
    assert "power" not in PART.mechanisms["belt"].parameters
    part = with_value(PART, p, **changes)
    given = part.mechanisms["belt"].parameters["power"]
    assert given.value == 70.0 and given.model_dump(exclude_defaults=True).keys() == {"value", *changes, "source"} - (
        set() if given.source else {"source"}
    )
    after = {q.name: q for q in compile_network(MACHINE, part=part).parameters}["mechanisms.belt.power"]
    assert after.free == ("spread" in changes)
    assert after.per_batch == changes.get("per_batch", 0.0)


def test_the_part_that_was_given_stays_as_it_was() -> None:
    before = PART.model_dump()
    with_value(PART, parameters()["links.shaft-head@0.25.coefficient"], value="1 W/m**2/K")
    assert PART.model_dump() == before


def test_names_with_dots_of_their_own() -> None:
    part = with_value(PART, parameters()["exposures.head@0.8-room.conductance"], value="3 W/K")
    own = part.exposures["head@0.8-room"].conductance
    assert own is not None and own.value == "3 W/K"


def test_what_no_file_states_cannot_be_changed_there() -> None:
    p = parameters()[f"{BUILT_IN}.expansion"]
    with pytest.raises(ValueError, match=r"twin\.materials\.cast_iron\.expansion: is no value of the machine file"):
        with_value(PART, p, value=1.0)


def test_a_wrong_parameter_of_every_rival_can_be_freed() -> None:
    for machine in (MACHINE, four_bodies(), equipped()):
        network, part = compile_network(machine), twin_part(machine)
        found = alternatives(network)
        assert {c.mechanism for c in found} == {"wrong_parameter"}
        for c in found:
            after = compile_network(machine, part=c.applied(part))
            assert c.change is not None
            p = after.parameters[after.index(c.change.parameter.name)]
            assert p.value == c.change.parameter.value
            assert p.free and p.spread == c.change.spread
