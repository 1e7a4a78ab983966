"""Every registered mechanism shows as its signature says: a line in `cases` and `signatures`."""

from __future__ import annotations

import pytest
from cases import CASES
from signatures import SIGNATURES

from twin.mechanisms import MECHANISMS
from twin.mechanisms.base import Mechanism

NEVER_OFF = {"enclosure_air", "voltage_loss_heat", "sensor_swap", "sensor_stuck"}


@pytest.mark.parametrize("key", list(MECHANISMS))
def test_it_shows_as_its_signature_says(key: str) -> None:
    SIGNATURES[key](MECHANISMS[key]())


def test_the_tables_name_what_is_registered_and_nothing_else() -> None:
    assert set(CASES) == set(SIGNATURES) == set(MECHANISMS)
    structural = {key for key, m in MECHANISMS.items() if m.effects() == ("expand",)}
    assert structural == {key for key, case in CASES.items() if case.formula is None}


def test_no_two_read_alike() -> None:
    for said in ("summary", "signature"):
        texts = [getattr(m, said) for m in MECHANISMS.values()]
        assert len(set(texts)) == len(texts)


def test_only_these_cannot_be_switched_off() -> None:
    assert {key for key, m in MECHANISMS.items() if m.off is None} == NEVER_OFF


def test_the_usual_sensor_laws_are_linear() -> None:
    linear = {key for key, m in MECHANISMS.items() if m.linear_reading}
    assert linear >= {"sensor_lag", "sensor_bonding", "sensor_offset", "sensor_drift"}


def test_usual_roles_need_not_be_stated() -> None:
    class Drip(Mechanism):
        acts_at = ("node",)
        ports = ("body", "supply", "lid")
        port_roles = {"lid": "neighbour"}  # noqa: RUF012

    assert Drip.port_roles == {"body": "itself", "supply": "surrounding", "lid": "neighbour"}
