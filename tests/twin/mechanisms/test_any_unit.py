"""Drivers whose channel may have any unit, and those of one kind only."""

from __future__ import annotations

import pytest

from data.errors import InputError
from data.machine import Machine
from thermodrift.testing.small_machine import machine_with
from twin.compile import compile_network
from twin.mechanisms import MECHANISMS


def driven_by_the_motor(key: str) -> Machine:
    return machine_with(MECHANISMS[key](), drivers={"level": "motor_rpm"})


@pytest.mark.parametrize("key", ["free_flux", "free_shift"])
def test_a_free_form_takes_a_driver_of_any_unit(key: str) -> None:
    network = compile_network(driven_by_the_motor(key))
    laws = [heat.law for heat in network.heats] + [law for error in network.errors for law in error.effects]
    (law,) = [law for law in laws if law.name == "tried"]
    assert law.drivers == {"level": "motor_rpm"}


def test_a_heater_does_not() -> None:
    told = r"tried\.drivers\.level: channel 'motor_rpm' is in rpm, electrical_heat needs 1; name another channel"
    with pytest.raises(InputError, match=told):
        compile_network(driven_by_the_motor("electrical_heat"))


def test_a_channel_that_is_not_there_is_told_for_any_unit_too() -> None:
    machine = machine_with(MECHANISMS["free_flux"](), drivers={"level": "motor_rmp"})
    with pytest.raises(InputError, match=r"drivers\.level: no channel 'motor_rmp'; did you mean 'motor_rpm'"):
        compile_network(machine)
