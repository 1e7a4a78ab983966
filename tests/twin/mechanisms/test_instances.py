"""Instances of mechanisms in a machine file: what makes no sense is one clear line; drivers of any unit."""

from __future__ import annotations

from typing import Any

import pytest

from data.errors import InputError
from tests.toys.small_machine import network_with
from twin.mechanisms import MECHANISMS

ENDS = {"at": {"body": "first", "other": "third"}}
CHILLED = "at: {} needs jacket, room (optional), got ['room']"
SHARE = "parameters.follow: means nothing without at.room; name that place, or leave it out"
LINES: dict[str, list[tuple[dict[str, Any], str]]] = {
    "column_bending": [
        ({"acts_on": "q"}, "acts_on: no error 'q'; Allowed: z"),
        ({"acts_on": None}, "acts_on is missing; name the errors that column_bending moves"),
        ({"at": {"hot": "first"}}, "at: column_bending needs hot, cold, got ['hot']"),
        ({"at": {"hot": "frist", "cold": "third"}}, "at.hot: no body 'frist'; did you mean 'first'?"),
        ({"at": {"hot": ["first", "second"], "cold": "third"}}, "at.hot: got 2 places, expected one"),
        ({"parameters": {"gian": 1}}, "parameters: column_bending has no parameter 'gian'; did you mean 'gain'?"),
        ({"parameters": {"gain": "1 W/K"}}, "errors.z.tilts[0].gain: unit 'W/K' cannot be read as 'um/K'"),
    ],
    "mandrel_fixture": [
        ({"at": None}, "at: mandrel_fixture needs seat or air, got []"),
        ({"at": {"nest": "first"}}, "at: mandrel_fixture needs seat or air, got ['nest']"),
        ({"at": {"air": "rom"}}, "at.air: no body or surrounding 'rom'; did you mean 'room'?"),
        ({"at": {"seat": "room"}}, "at.seat: no body 'room'"),
    ],
    "heat_bridge": [
        ({"at": "first"}, "at: expected the two bodies that exchange heat, e.g. at: {body: bed"),
        ({"at": {"body": "first"}}, "at: expected the two bodies"),
        ({"at": {"body": "first", "other": "thrid"}}, "links.tried.between: no body 'thrid'; did you mean 'third'?"),
        ({"at": {"body": "first", "other": "first"}}, "links.tried.between: both ends are 'first'"),
        (
            ENDS | {"parameters": {"conductanse": "1 W/K"}},
            "parameters: heat_bridge has no parameter 'conductanse'; did you mean 'conductance'?",
        ),
    ],
    "sensor_swap": [
        ({"acts_on": ["first"]}, "acts_on: got ['first'], expected the two sensors that are exchanged"),
        ({"acts_on": ["first", "first"]}, "acts_on: got ['first', 'first'], expected the two sensors"),
        ({"acts_on": ["first", "secnd"]}, "acts_on: no sensor 'secnd'; did you mean 'second'?"),
    ],
    **{
        key: [
            ({"at": {"room": "room"}}, CHILLED.format(key)),
            ({"at": "first", "parameters": {"follow": 1.0}}, SHARE),
        ]
        for key in ("jacket_chiller", "coolant_jacket")
    },
    "electrical_heat": [
        (
            {"drivers": {"level": "motor_rpm"}},
            "drivers.level: channel 'motor_rpm' is in rpm, electrical_heat needs 1; name another channel",
        )
    ],
    "free_flux": [
        ({"drivers": {"level": "motor_rmp"}}, "drivers.level: no channel 'motor_rmp'; did you mean 'motor_rpm'")
    ],
}


@pytest.mark.parametrize(("key", "given", "line"), [(key, *row) for key, rows in LINES.items() for row in rows])
def test_what_makes_no_sense_is_one_clear_line(key: str, given: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError) as told:
        network_with(MECHANISMS[key](), **given)
    text = str(told.value)
    where = "" if line.startswith(("links.", "errors.")) else "mechanisms.tried."
    assert text.startswith(f"machine small: twin.{where}{line}") and "\n" not in text


@pytest.mark.parametrize("key", ["free_flux", "free_shift"])
def test_a_free_form_takes_a_driver_of_any_unit(key: str) -> None:
    network = network_with(MECHANISMS[key](), drivers={"level": "motor_rpm"})
    laws = [heat.law for heat in network.heats] + [law for error in network.errors for law in error.effects]
    (law,) = [law for law in laws if law.name == "tried"]
    assert law.drivers == {"level": "motor_rpm"}
