"""The SQLite store below a home: made in one step, and following a home that is moved or copied.

MLflow keeps the absolute address of every run's and model's files. After a home has another path these addresses lead
to the old one: to nothing, or to the files of the home that it was copied from. `follow` writes the new addresses.
"""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from urllib.parse import unquote, urlsplit

from filelock import FileLock

from pipelines.runs import artifact_folder

_BUSY_S = 20.0  # as long as MLflow waits for another process that writes
_SCRATCH = ".making-"
_ADDRESSES = (("runs", "artifact_uri"), ("logged_models", "artifact_location"))  # of an experiment, below its own


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
