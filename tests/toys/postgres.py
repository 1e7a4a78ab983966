"""A PostgreSQL server of a test's own: its cluster in a temporary folder, on a free port of 127.0.0.1."""

from __future__ import annotations

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

USER, PASSWORD = "thermo", "s3cret&word"  # & stands in an address as it is
_QUICK = ("fsync=off", "synchronous_commit=off", "full_page_writes=off")  # nothing here has to survive a power cut


@dataclass(frozen=True)
class Server:
    """A running server; `address` is that of one of its databases."""

    port: int
    psql: Path

    def address(self, database: str, driver: str = "psycopg", password: str = PASSWORD) -> str:
        """SQLAlchemy's address of a database."""
        return f"postgresql+{driver}://{USER}:{password}@127.0.0.1:{self.port}/{database}"

    def create(self, database: str) -> str:
        """A new, empty database; its address."""
        self.sql("postgres", f'create database "{database}"')
        return self.address(database)

    def sql(self, database: str, statement: str) -> str:
        """What a statement gives, as plain text."""
        where = ["-h", "127.0.0.1", "-p", str(self.port), "-U", USER, "-d", database]
        command = [str(self.psql), *where, "-qAtc", statement]
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, env={**os.environ, "PGPASSWORD": PASSWORD}
        )
        return done.stdout.strip()


def free_port() -> int:
    """A port of 127.0.0.1 that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def postgres() -> Iterator[Server]:
    """The server; skips the test where PostgreSQL, or a user other than root to run it, is missing."""
    binaries = _binaries()
    user = _user()
    folder = Path(tempfile.mkdtemp(prefix="thermodrift-pg-"))
    try:
        if user is not None:
            os.chown(folder, user.pw_uid, user.pw_gid)
        owner = {} if user is None else {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}

        def run(*command: object) -> None:
            done = subprocess.run([str(c) for c in command], capture_output=True, text=True, cwd=folder, **owner)  # type: ignore[call-overload]
            assert done.returncode == 0, done.stdout + done.stderr

        secret, cluster, port = folder / "password", folder / "cluster", free_port()
        secret.write_text(PASSWORD)
        secret.chmod(0o644)
        run(binaries / "initdb", "-D", cluster, "-U", USER, "--auth=scram-sha-256", f"--pwfile={secret}", "--no-sync",
            "--encoding=UTF8", "--locale=C")  # fmt: skip
        options = f"-h 127.0.0.1 -p {port} -k {folder} " + " ".join(f"-c {setting}" for setting in _QUICK)
        run(binaries / "pg_ctl", "-D", cluster, "-o", options, "-l", folder / "log", "-w", "start")
        try:
            yield Server(port, binaries / "psql")
        finally:
            run(binaries / "pg_ctl", "-D", cluster, "-m", "immediate", "-w", "stop")
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _binaries() -> Path:
    """The folder of the newest PostgreSQL."""
    found = [Path(p).parent for p in (shutil.which("pg_ctl"),) if p]
    found += sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda p: float(p.parent.name))
    complete = [f for f in found if all((f / name).exists() for name in ("initdb", "pg_ctl", "psql"))]
    if not complete:
        pytest.skip("no PostgreSQL server is installed (initdb, pg_ctl, psql); apt-get install postgresql")
    return complete[-1]


def _user() -> pwd.struct_passwd | None:
    """Whom it runs as: None for this user; PostgreSQL refuses root."""
    if os.geteuid() != 0:
        return None
    for name in ("postgres", "nobody"):
        try:
            return pwd.getpwnam(name)
        except KeyError:
            continue
    pytest.skip("PostgreSQL refuses to run as root, and there is no user postgres or nobody")
