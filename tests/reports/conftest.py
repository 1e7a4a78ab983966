"""The compiled sample machine, once for all tests of the folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from data.machine import load_machine
from twin.compile import compile_network, expanded
from twin.network import Network
from twin.schema import twin_part
from twin.simulation.start import steady_state
from twin.views.overview import Overview, overview

SAMPLE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"


@pytest.fixture(scope="session")
def network() -> Network:
    """The sample machine's network."""
    return compile_network(load_machine(SAMPLE))


@pytest.fixture(scope="session")
def view(network: Network) -> Overview:
    """What its picture shows, at 4000 rpm."""
    machine, drivers = load_machine(SAMPLE), {"spindle_rpm": 4000.0}
    steady = steady_state(network, drivers, 20.0)
    return overview(network, expanded(twin_part(machine)), machine.description, machine.simulated, steady, drivers)
