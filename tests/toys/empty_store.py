"""MLflow's empty store, migrated once for all processes of a test run, and written without waiting for the disk."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock
from sqlalchemy import Engine, event

from pipelines import settings
from pipelines.store import database, tracking


def empty_store(folders: pytest.TempPathFactory) -> Path:
    """The file of the store; the first process of the run makes it."""
    base = folders.getbasetemp()
    home = (
        base.parent if base.name.startswith("popen-") else base
    ) / "empty-store"  # a worker's base is below the run's
    home.mkdir(exist_ok=True)
    with FileLock(home / "lock"), pytest.MonkeyPatch.context() as patch:
        if not (home / "mlflow.db").exists():
            patch.setenv("THERMODRIFT_HOME", str(home))
            tracking.open_store(settings.load())
    return home / "mlflow.db"


@contextmanager
def copied_stores(empty: Path) -> Iterator[None]:
    """Every home whose store this process makes gets a copy of the empty one instead of a migration."""
    make = database.make

    def copy(file: Path, fill: Callable[[Path], Any]) -> None:
        make(file, (lambda made: shutil.copy(empty, made)) if fill.__module__ == tracking.__name__ else fill)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(database, "make", copy)
        yield


@contextmanager
def quick_commits() -> Iterator[None]:
    """No store of this process waits for the disk: a promotion commits dozens of times, and no test cuts the power."""

    def unsafe(connection: Any, _: object) -> None:
        if isinstance(connection, sqlite3.Connection):
            connection.execute("PRAGMA synchronous=OFF").close()

    event.listen(Engine, "connect", unsafe)
    try:
        yield
    finally:
        event.remove(Engine, "connect", unsafe)
