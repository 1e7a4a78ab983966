from pathlib import Path

import pytest

from data.machine import Machine, load_machine
from twin.compile import compile_network
from twin.network import Network


@pytest.fixture(scope="session")
def sample_machine() -> Machine:
    return load_machine(Path(__file__).parents[2] / "machines" / "sample_vmc.yml")


@pytest.fixture(scope="session")
def sample(sample_machine: Machine) -> Network:
    """The network of the sample machine."""
    return compile_network(sample_machine)
