"""One tracking store and server of flows for all tests of this folder: each takes seconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from pipelines import caller
from pipelines import settings as settings_module
from tests.toys.command import Call, in_process

SLOW_COMPUTER_S = 300  # for imports
PNG = bytes.fromhex(  # one grey pixel
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b55"
    "0000000a49444154789c636800000082008177cd72b60000000049454e44ae426082"
)


@pytest.fixture(scope="session", autouse=True)
def no_migrations(copied_stores: None) -> None:
    """Homes get a copy of one empty store."""


@pytest.fixture(scope="session", autouse=True)
def quick_retries() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(caller, "RETRY_DELAY_S", 0.01)
        yield


@pytest.fixture(scope="module", autouse=True)
def plain_pictures(request: pytest.FixtureRequest) -> Iterator[None]:
    """No figure is drawn, which takes a second or two for each report; a file marked `drawn` does draw them."""
    from matplotlib.figure import Figure

    from reports.diagnosis import page

    write = page.write_diagnosis_report

    def save(figure: Figure, out: Any, *, format: str, **_: Any) -> None:
        out.write(b'<svg xmlns="http://www.w3.org/2000/svg"/>' if format == "svg" else PNG)

    def write_without(path: Path, d: Any, pictures: bool = True, *given: Any, **more: Any) -> None:
        write(path, d, False, *given, **more)

    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("drawn") is None:
            patch.setattr(Figure, "savefig", save)
            patch.setattr(page, "write_diagnosis_report", write_without)
        yield


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    """`thermodrift ARGS` in this process."""
    return in_process(monkeypatch, capsys)


@pytest.fixture(scope="session")
def store_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home folder of the session's own."""
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="session")
def store(store_home: Path) -> Iterator[object]:
    """Settings on the session's SQLite store; THERMODRIFT_HOME points there while it is made."""
    from pipelines import settings as module
    from pipelines.store import tracking

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
    """The flows, and one server for the reports of all tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("THERMODRIFT_HOME", str(store_home))
        settings_module.configure_environment()
        from prefect.server.api.server import SubprocessASGIServer
        from prefect.settings import PREFECT_API_URL, temporary_settings

        from pipelines import flows as module
        from pipelines import prefect_reports

        patch.setattr(prefect_reports, "END_S", SLOW_COMPUTER_S)
        server = SubprocessASGIServer()
        server.start(timeout=SLOW_COMPUTER_S)
        patch.setenv("PREFECT_API_URL", server.api_url)
        with temporary_settings({PREFECT_API_URL: server.api_url}):
            yield module
        server.stop()
