"""One tracking store for all tests of this folder: making it takes seconds."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest


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
