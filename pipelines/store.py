"""A tracking store on a server: whether it answers, and what one process at a time may do there.

MLflow itself tries an address that does not answer for minutes, and lets two first uses of an empty database make its
tables at once. A SQLite store needs none of this, see `tracking.open_store`.
"""

from __future__ import annotations

import logging
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from http.client import HTTPException
from urllib.parse import urlsplit
from zlib import crc32

from sqlalchemy import Engine, create_engine, inspect, text
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from data.errors import InputError, WorkError
from pipelines.caller import Say
from pipelines.settings import Settings, masked

ANSWER_S = 10  # to accept a connection
POSTGRESQL = "postgresql"
_TABLES = "tables"  # the key of the lock under which they are made


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
