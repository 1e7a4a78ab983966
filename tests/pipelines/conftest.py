"""One tracking store, server of flows and compiled sample machine for all tests of this folder: each takes seconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from data.machine import load_machine
from pipelines import settings as settings_module
from twin.compile import compile_network, expanded
from twin.network import Network
from twin.schema import twin_part
from twin.simulation.start import steady_state
from twin.views.overview import Overview, overview

SAMPLE = Path(__file__).parents[2] / "machines" / "sample_vmc.yml"


@pytest.fixture(scope="session")
def store_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home folder of the session's own."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="session")
def store(store_home: Path) -> Iterator[object]:
    """Settings on the session's SQLite store; THERMODRIFT_HOME points there while it is made."""
    from pipelines import settings as module
    from pipelines import tracking

    before = os.environ.get("THERMODRIFT_HOME")
    os.environ["THERMODRIFT_HOME"] = str(store_home)
    settings = module.load()
    if before is None:
        del os.environ["THERMODRIFT_HOME"]
    else:
        os.environ["THERMODRIFT_HOME"] = before
    tracking.open_store(settings)
    yield settings


@pytest.fixture(scope="session")
def flows(store: object, store_home: Path) -> Iterator[ModuleType]:
    """The flows on one temporary server for all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMODRIFT_HOME", str(store_home))
        patch.delenv("PREFECT_API_URL", raising=False)
        settings_module.configure_environment()
        from prefect.server.api.server import SubprocessASGIServer

        from pipelines import flows as module

        patch.setattr(module, "RETRY_DELAY_S", 0.01)
        server = module.start_server()
        assert server is not None
        server.join()
        yield module
        SubprocessASGIServer().stop()


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
