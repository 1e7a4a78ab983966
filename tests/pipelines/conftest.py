"""One tracking store and server of flows for all tests of this folder: each takes seconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from pipelines import settings as settings_module


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
