"""Parquet lake: versioned storage of batches, atomic and safe for concurrent writers.

    ROOT/machine=NAME/year=YYYY/BATCH.parquet      the current version, for any reader (hive partitions)
    ROOT/_versions/machine=NAME/BATCH/*.parquet    every version ever stored, read-only
    ROOT/_quarantine/machine=NAME/                 files that could not be used, and reasons.jsonl
    ROOT/_manifest.json                            versions of every batch; decides what exists

Names with a leading underscore are skipped by the dataset discovery of pyarrow and pandas; DuckDB reads
``ROOT/*/*/*.parquet``.

A version is identified by its content (see `lakefile.content_digest`). New findings, repairs or channel descriptions
for the same content *refresh* the version: number and digest stay, a new file holds the new remarks, and the earlier
file is kept. Replacing `_manifest.json` commits a write: `load` gives the old state before it and the new state after.
The current file is replaced next. If the process is killed in between, plain readers see the old version until the
next write, which finds the batch under `pending`.
"""

from __future__ import annotations

import filecmp
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from data.batch import Batch
from data.errors import InputError, WorkError, closest
from data.lakefile import content_digest, decode, encode, remarks_digest, safe_name

LOG = "reasons.jsonl"


@dataclass(frozen=True)
class Quarantined:
    """One unusable file: where it came from, why, when, and its copy in the lake (None if it could not be read)."""

    machine: str
    name: str
    source: str
    sha256: str
    reason: str
    at: str
    copy: Path | None


def read_log(folder: Path) -> list[Quarantined]:
    """All entries of one machine's quarantine folder, oldest first."""
    log = folder / LOG
    if not log.exists():
        return []
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines() if line]
    return [Quarantined(**{**row, "copy": folder / row["copy"] if row["copy"] else None}) for row in rows]


def log_text(entries: list[Quarantined]) -> str:
    """The inverse of `read_log`: one JSON line per entry."""
    rows: list[dict[str, Any]] = [{**asdict(e), "copy": e.copy.name if e.copy else None} for e in entries]
    return "".join(json.dumps(row) + "\n" for row in rows)


def entry_for(path: Path, machine: str, reason: str, folder: Path, name: str) -> Quarantined:
    """The log entry for `path`, with the hash of its bytes; writes nothing."""
    sha256, copy = "", None
    try:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        copy = folder / f"{sha256[:12]}-{name}"
    except OSError as error:
        reason = f"{reason} (no copy kept: its bytes cannot be read, {error.strerror})"
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return Quarantined(machine, path.name, str(path), sha256, reason, now, copy)


def copy_bytes(source: Path, target: Path) -> None:
    """A plain copy in bounded memory."""
    with source.open("rb") as a, target.open("wb") as b:
        shutil.copyfileobj(a, b, 1 << 20)


def ascii_if_broken(name: str) -> str:
    """A file name with undecodable bytes escaped."""
    return name.encode("utf-8", "backslashreplace").decode()


SCHEMA = "thermodrift.lake/1"
LOCK_WAIT_S = 600.0
Status = Literal["new", "unchanged", "refreshed", "new_version"]


@dataclass(frozen=True)
class Stored:
    """What `put` did with a batch; `replaces` is the source of the version before a new one."""

    status: Status
    version: int
    digest: str
    machine: str
    batch_id: str
    replaces: str = ""


@dataclass(frozen=True)
class Version:
    """One version of a batch. `files`: its files under the root, oldest remarks first, the last one in use."""

    version: int
    digest: str
    source: str
    stored_at: str
    rows: int
    year: int
    simulated: bool
    current: bool
    files: tuple[str, ...]


@dataclass(frozen=True)
class Staged:
    """A batch whose file is written and waits for a commit."""

    machine: str
    batch_id: str
    digest: str
    file: str
    source: str
    rows: int
    year: int
    simulated: bool


class Lake:
    """Batches of all machines under one folder, which the first write makes."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self._lock = FileLock(self.root / ".lock", timeout=LOCK_WAIT_S)

    def put(self, batch: Batch) -> Stored:
        """Store one batch: nothing is ever overwritten; the same content twice is stored once.

        Raises:
            InputError: the batch cannot be stored (see `lakefile.content_digest`).
            WorkError: the lake cannot be written or stays locked for ten minutes.
        """
        return self.put_many([batch])[0]

    def put_many(self, batches: Iterable[Batch]) -> list[Stored]:
        """Store batches, taken one by one, in one commit: all become visible together."""
        return self.commit([self.stage(b) for b in batches])

    def stage(self, batch: Batch, digest: str | None = None) -> Staged:
        """Write a batch's file without making it visible; `digest` saves hashing it again."""
        digest = digest or content_digest(batch)
        folder = f"_versions/machine={safe_name(batch.machine)}/{safe_name(batch.batch_id)}"
        file = f"{folder}/{digest[:12]}-{remarks_digest(batch)[:8]}.parquet"
        if not (self.root / file).exists():
            body = encode(batch, digest)
            with self._writing():
                self._replace(self.root / file, body)
        year = batch.start.year if batch.start is not None else 0
        return Staged(batch.machine, batch.batch_id, digest, file, batch.source, batch.n_rows, year, batch.simulated)

    def commit(self, staged: Sequence[Staged]) -> list[Stored]:
        """Make staged batches visible, all at once, in their order."""
        if not staged:
            return []
        with self._writing():
            manifest = self._manifest()
            self._publish(manifest, manifest["pending"])
            stored = [_enter(manifest, s) for s in staged]
            touched = sorted({(s.machine, s.batch_id) for s in stored})
            if any(s.status != "unchanged" for s in stored):
                manifest["pending"] = touched
                self._replace(self._manifest_path, json.dumps(manifest).encode())
            self._publish(manifest, touched)
        return stored

    def load(self, machine: str, batch_id: str, version: int | None = None) -> Batch:
        """One batch, by default its current version.

        Raises:
            InputError: no such machine, batch or version; the closest and the allowed ones.
            WorkError: its file is missing or damaged.
        """
        entries = self._entries(machine, batch_id)
        by_number = {e["version"]: e for e in entries}
        if version is not None and version not in by_number:
            raise InputError(
                f"lake {self.root}: batch {batch_id} of {machine} has no version {version}; "
                f"expected 1 to {len(entries)}"
            )
        return self._read(entries[-1] if version is None else by_number[version])

    def load_all(self, machine: str) -> list[Batch]:
        """Current version of every batch, by start (unknown last), then id.

        Raises:
            InputError: the lake holds nothing of this machine.
        """
        batches = [self._read(entries[-1]) for entries in self._batches(machine).values()]
        return sorted(
            batches, key=lambda b: (b.start is None, "" if b.start is None else b.start.isoformat(), b.batch_id)
        )

    def machines(self) -> list[str]:
        """Names of machines with at least one batch."""
        return sorted(self._manifest()["machines"])

    def batch_ids(self, machine: str) -> list[str]:
        """Ids of a machine's batches, sorted; empty for an unknown machine."""
        return sorted(self._manifest()["machines"].get(machine, {}))

    def versions(self, machine: str, batch_id: str) -> list[Version]:
        """Every version of a batch, oldest first."""
        entries = self._entries(machine, batch_id)
        keys = ("version", "digest", "source", "stored_at", "rows", "year", "simulated", "current")
        return [Version(**{k: e[k] for k in keys}, files=(*e["earlier"], e["file"])) for e in entries]

    def quarantine(self, path: Path, machine: str, reason: str) -> Path:
        """Keep an unusable file's bytes and the reason; the file itself stays where it is.

        Returns the copy's path (the log's, where the file cannot be read). The same bytes under the same name
        with the same reason are entered once.
        """
        folder = self.root / "_quarantine" / f"machine={safe_name(machine)}"
        with self._writing():
            entry = entry_for(path, machine, reason, folder, safe_name(ascii_if_broken(path.name)))
            entries = read_log(folder)
            if entry.copy is not None and not entry.copy.exists():
                self._replace(entry.copy, path)
            if not any(replace(e, at=entry.at) == entry for e in entries):
                self._replace(folder / LOG, log_text([*entries, entry]).encode())
        return entry.copy or folder / LOG

    def quarantined(self, machine: str) -> list[Quarantined]:
        """Quarantined files of a machine, oldest first."""
        return read_log(self.root / "_quarantine" / f"machine={safe_name(machine)}")

    @property
    def _manifest_path(self) -> Path:
        return self.root / "_manifest.json"

    def _manifest(self) -> dict[str, Any]:
        try:
            manifest: dict[str, Any] = json.loads(self._manifest_path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {"schema": SCHEMA, "pending": [], "machines": {}}
        except (OSError, ValueError) as error:
            raise WorkError(f"lake {self._manifest_path}: cannot be read ({error}); restore it from a backup") from None
        if manifest.get("schema") != SCHEMA:
            raise WorkError(
                f"lake {self._manifest_path}: got schema {manifest.get('schema')!r}, expected {SCHEMA!r}; "
                "use another lake folder"
            )
        return manifest

    def _batches(self, machine: str) -> dict[str, list[dict[str, Any]]]:
        machines = self._manifest()["machines"]
        if machine not in machines:
            hint = closest(machine, machines) if machines else "it is empty"
            raise InputError(f"lake {self.root}: no batch of machine {machine!r}; {hint}. Run thermodrift ingest first")
        batches: dict[str, list[dict[str, Any]]] = machines[machine]
        return batches

    def _entries(self, machine: str, batch_id: str) -> list[dict[str, Any]]:
        batches = self._batches(machine)
        if batch_id not in batches:
            raise InputError(f"lake {self.root}: {machine} has no batch {batch_id!r}; {closest(batch_id, batches)}")
        return batches[batch_id]

    def _read(self, entry: dict[str, Any]) -> Batch:
        return replace(decode(self.root / entry["file"], entry["version"]), source=entry["source"])

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Exclusive access, with files of an interrupted writer removed."""
        try:
            (self.root / "_tmp").mkdir(parents=True, exist_ok=True)
            with self._lock:
                for leftover in (self.root / "_tmp").iterdir():
                    leftover.unlink()
                yield
        except Timeout:
            raise WorkError(
                f"lake {self.root}: locked by another ingest for {LOCK_WAIT_S / 60:.0f} min; wait for it or end it"
            ) from None
        except OSError as error:
            raise WorkError(f"lake {self.root}: cannot be written ({error}); nothing stored was lost") from error

    def _replace(self, target: Path, body: Any) -> None:
        """Put bytes, or the copy of a file, at `target` in one step that survives a power cut."""
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.root / "_tmp" / "next"
        if isinstance(body, Path):
            copy_bytes(body, temporary)
        else:
            temporary.write_bytes(body)
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        if target.parent != self.root and target.name != LOG:
            temporary.chmod(0o444)
        temporary.replace(target)
        _sync(target.parent)

    def _publish(self, manifest: dict[str, Any], batches: Iterable[Sequence[str]]) -> None:
        """Replace the current files of these batches by those that the manifest names."""
        folders = set()
        for machine, batch_id in batches:
            entries = manifest["machines"][machine][batch_id]
            folder, name = self.root / f"machine={safe_name(machine)}", f"{safe_name(batch_id)}.parquet"
            version = self.root / entries[-1]["file"]
            target = folder / f"year={entries[-1]['year']}" / name
            elsewhere = [folder / f"year={year}" / name for year in {e["year"] for e in entries}]
            standing = [p for p in elsewhere if p != target and p.exists()]
            # a batch that changed its year is first replaced where it stands, then moved: never absent, never double
            at = standing[0] if standing and not target.exists() else target
            if not _same(at, version):
                at.parent.mkdir(parents=True, exist_ok=True)
                temporary = self.root / "_tmp" / "current"
                temporary.unlink(missing_ok=True)
                try:
                    os.link(version, temporary)
                except OSError:  # a file system without hard links
                    shutil.copyfile(version, temporary)
                temporary.replace(at)
                folders.add(target.parent)
            if at != target:
                target.parent.mkdir(parents=True, exist_ok=True)
                at.replace(target)
                folders.add(target.parent)
            for stale in standing:
                stale.unlink(missing_ok=True)
        for changed in folders:
            _sync(changed)


def _enter(manifest: dict[str, Any], s: Staged) -> Stored:
    """Write a staged batch into the manifest; content equal to the current version makes no new one."""
    entries = manifest["machines"].setdefault(s.machine, {}).setdefault(s.batch_id, [])
    now = datetime.now(UTC).isoformat(timespec="seconds")
    status: Status = "new_version" if entries else "new"
    replaces = ""
    if entries and entries[-1]["digest"] == s.digest:
        last = entries[-1]
        status = "unchanged" if last["file"] == s.file else "refreshed"
        if status == "refreshed":
            last["earlier"] = [f for f in (*last["earlier"], last["file"]) if f != s.file]
            last["file"] = s.file
    else:
        for entry in entries:
            entry["current"], replaces = False, entry["source"]
        entries.append(
            {
                "version": len(entries) + 1,
                "digest": s.digest,
                "source": s.source,
                "stored_at": now,
                "rows": s.rows,
                "year": s.year,
                "simulated": s.simulated,
                "current": True,
                "file": s.file,
                "earlier": [],
            }
        )
    return Stored(status, entries[-1]["version"], s.digest, s.machine, s.batch_id, replaces)


def _same(current: Path, version: Path) -> bool:
    if not current.exists():
        return False
    return current.samefile(version) or filecmp.cmp(current, version, shallow=False)


def _sync(folder: Path) -> None:
    """Make a rename in this folder durable; a system that cannot open folders does it on its own."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
