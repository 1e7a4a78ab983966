"""The tracking store before MLflow uses it: on a server, or as a SQLite file below a home.

A server: whether it answers, and what one process at a time may do there. MLflow itself tries an address that does not
answer for minutes, and lets two first uses of an empty database make its tables at once. A SQLite store needs none of
this.

A SQLite file is made in one step, and follows a home that is moved or copied. MLflow keeps the absolute address of
every run's and model's files. After a home has another path these addresses lead to the old one: to nothing, or to the
files of the home that it was copied from. `follow` writes the new addresses.
"""

from __future__ import annotations

import logging
import shutil
import sqlite3
import ssl
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cache
from http.client import HTTPException
from pathlib import Path
from urllib.parse import unquote, urlsplit
from zlib import crc32

from filelock import FileLock
from sqlalchemy import Engine, create_engine, inspect, text
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from data.errors import InputError, WorkError
from pipelines.caller import Say
from pipelines.settings import Settings, masked
from pipelines.store.runs import artifact_folder

ANSWER_S = 10  # to accept a connection
POSTGRESQL = "postgresql"
_TABLES = "tables"  # the key of the lock under which they are made
_BUSY_S = 20.0  # as long as MLflow waits for another process that writes
_SCRATCH = ".making-"
_ADDRESSES = (("runs", "artifact_uri"), ("logged_models", "artifact_location"))  # of an experiment, below its own


class StoreOutage(WorkError):
    """A store on a server does not answer, or reports a failure of its own; later it may take the same."""


@contextmanager
def first_use(settings: Settings, say: Say) -> Iterator[None]:
    """Around the first call of this process: the store answers, and no other process makes its tables meanwhile.

    Raises:
        InputError: the address is none, or its driver is not installed.
        WorkError: the store does not answer.
    """
    if settings.store_uri.startswith(("http:", "https:")):
        _check_answers(settings)
    with exclusive(settings, _TABLES) as engine:
        if engine is not None and not inspect(engine).has_table("alembic_version"):
            say(f"first use: making the tables of the tracking store {settings.store_name} (takes some seconds, once)")
        yield


@contextmanager
def exclusive(settings: Settings, key: str) -> Iterator[Engine | None]:
    """One process at a time, of all computers that use this PostgreSQL store, is in the context of a `key`.

    The engine; None for any other store: SQLite has one computer, and an MLflow server offers no lock.

    Raises:
        InputError, WorkError: see `first_use`.
    """
    if not settings.store_uri.startswith(POSTGRESQL):
        yield None
        return
    engine = _engine(settings.store_uri)
    number = {"a": crc32(b"thermodrift"), "b": crc32(key.encode())}
    signed = {k: v - (1 << 31) for k, v in number.items()}  # PostgreSQL takes two signed integers of 32 bits
    try:
        connection = engine.connect().execution_options(isolation_level="AUTOCOMMIT")
    except SQLAlchemyError as error:
        raise StoreOutage(f"tracking store {settings.store_name}: {_reason(error)}") from None
    with connection:  # closing it gives the lock back, and so does the end of this process
        connection.execute(text("select pg_advisory_lock(:a, :b)"), signed)
        try:
            yield engine
        finally:
            connection.execute(text("select pg_advisory_unlock(:a, :b)"), signed)


@cache
def _engine(uri: str) -> Engine:
    logging.getLogger("psycopg").setLevel(logging.CRITICAL)  # warns of what SQLAlchemy then raises
    try:
        return create_engine(uri, connect_args={"connect_timeout": ANSWER_S}, pool_size=1, max_overflow=-1)
    except (ArgumentError, ValueError) as error:
        raise InputError(
            f"tracking store {masked(uri)}: no address ({masked(str(error))}); expected "
            "postgresql+psycopg://USER:PASSWORD@HOST:PORT/DATABASE"
        ) from None
    except (NoSuchModuleError, ModuleNotFoundError):
        raise InputError(
            f"tracking store {masked(uri)}: the driver is not installed; write postgresql+psycopg://… and run "
            "pip install 'thermodrift[service]'"
        ) from None


def _check_answers(settings: Settings) -> None:
    """An answer of any kind will do: access rights, for one, are for MLflow to report."""
    parts = urlsplit(settings.store_uri)
    try:
        urllib.request.urlopen(f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}", timeout=ANSWER_S).close()
    except urllib.error.HTTPError:
        return
    except (OSError, ValueError, HTTPException) as error:
        reason = getattr(error, "reason", error)
        if isinstance(reason, ssl.SSLError):  # MLflow has settings of its own for certificates
            return
        raise StoreOutage(f"tracking store {settings.store_name}: does not answer ({reason}); start it") from None


def _reason(error: SQLAlchemyError) -> str:
    """The driver's own words, in one line; they name user, host and port, no password."""
    said = str(getattr(error, "orig", None) or error)
    return masked(" ".join(said.split()))


def is_made(file: Path) -> bool:
    """Whether a store is there. An empty file, and tables that never got a version, are what an interruption left."""
    if not file.exists() or not file.stat().st_size:
        return False
    with closing(sqlite3.connect(f"{file.as_uri()}?mode=ro", uri=True, timeout=_BUSY_S)) as db:
        try:
            tables = {str(name) for (name,) in db.execute("select name from sqlite_master where type = 'table'")}
        except sqlite3.DatabaseError:  # no database, or locked: MLflow reports it
            return True
        return "alembic_version" in tables or "runs" not in tables or bool(db.execute("select 1 from runs").fetchone())


def make(file: Path, fill: Callable[[Path], object]) -> None:
    """Make a store, all or nothing: MLflow cannot open one whose first migration was interrupted.

    Args:
        fill: writes the tables into a file.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{file}.lock"):
        if is_made(file):  # by another process meanwhile
            return
        for left in file.parent.glob(f"{_SCRATCH}*"):  # of a process that was killed: this one has the lock
            shutil.rmtree(left, ignore_errors=True)
        with tempfile.TemporaryDirectory(dir=file.parent, prefix=_SCRATCH) as scratch:
            made = Path(scratch) / file.name
            fill(made)
            made.replace(file)


def follow(file: Path, artifacts_uri: str) -> list[str]:
    """Let the addresses of runs and models lead below `artifacts_uri`, where their files are; returns the changed ones.

    An experiment whose folder is not there keeps its address: then its files were not moved.
    """
    root = urlsplit(artifacts_uri)
    if root.scheme != "file":
        return []
    with closing(sqlite3.connect(file, timeout=_BUSY_S)) as db:
        moved = _moved(db, artifacts_uri, Path(unquote(root.path)))
        if moved:
            with db:  # one transaction
                db.execute("begin immediate")
                for experiment, was, now in moved:
                    _rewrite(db, experiment, was, now)
    return [now for _, _, now in moved]


def _moved(db: sqlite3.Connection, artifacts_uri: str, root: Path) -> Sequence[tuple[int, str, str]]:
    """Experiment, old and new address. MLflow decodes an address, so a channel's folder has its plain name."""
    try:
        rows = db.execute(
            "select e.experiment_id, e.artifact_location, m.value, t.value from experiments e"
            " join experiment_tags m on m.experiment_id = e.experiment_id and m.key = 'machine'"
            " join experiment_tags t on t.experiment_id = e.experiment_id and t.key = 'target'"
        ).fetchall()
    except sqlite3.DatabaseError:  # no store of this MLflow, which reports it
        return []
    found = []
    for experiment, was, machine, target in rows:
        below = artifact_folder(machine, target)
        now = f"{artifacts_uri}/{below}"
        if was != now and was.endswith(f"/{below}") and (root / machine / target).is_dir():
            found.append((experiment, was, now))
    return found


def _rewrite(db: sqlite3.Connection, experiment: int, was: str, now: str) -> None:
    db.execute("update experiments set artifact_location = ? where experiment_id = ?", (now, experiment))
    # Compared as text from the start: an underscore would be a wildcard of LIKE.
    for table, column in _ADDRESSES:
        db.execute(
            f"update {table} set {column} = ? || substr({column}, ?)"
            f" where experiment_id = ? and substr({column}, 1, ?) = ?",
            (now, len(was) + 1, experiment, len(was) + 1, f"{was}/"),
        )
    db.execute(
        "update model_versions set storage_location = ? || substr(storage_location, ?)"
        " where substr(storage_location, 1, ?) = ?",
        (now, len(was) + 1, len(was) + 1, f"{was}/"),
    )
