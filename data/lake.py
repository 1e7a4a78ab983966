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

The manifest has the hash of every file, and `load` verifies it: a file that was changed or cut after its ingest is
refused, and the next ingest of its source *heals* it, which writes it anew.

A withdrawn batch keeps its versions but has no current file, and nothing loads it; `restore` brings it back, `purge`
deletes its content. Withdrawn content is not stored again.
"""

from __future__ import annotations

import filecmp
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from data import manifest as listing
from data.batch import Batch
from data.errors import InputError, WorkError, closest
from data.lakefile import content_digest, decode, encode, measured_digest, read_body, remarks_digest, safe_name
from data.manifest import Entry, Staged, Stored, Version

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
    return Quarantined(machine, path.name, str(path), sha256, reason, _now(), copy)


def copy_bytes(source: Path, target: Path) -> None:
    """A plain copy in bounded memory."""
    with source.open("rb") as a, target.open("wb") as b:
        shutil.copyfileobj(a, b, 1 << 20)


def ascii_if_broken(name: str) -> str:
    """A file name with undecodable bytes escaped."""
    return name.encode("utf-8", "backslashreplace").decode()


LOCK_WAIT_S = 600.0


class Lake:
    """Batches of all machines under one folder, which the first write makes."""

    def __init__(self, root: Path | str) -> None:
        self.root = Path(root)
        self._lock = FileLock(self.root / ".lock", timeout=LOCK_WAIT_S)
        self._known: tuple[tuple[int, int, int] | None, dict[str, str]] = (None, {})

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
        """Write a batch's file without making it visible, unless it stands there undamaged already.

        `digest` saves hashing the batch again.
        """
        digest = digest or content_digest(batch)
        folder = f"_versions/machine={safe_name(batch.machine)}/{safe_name(batch.batch_id)}"
        file = f"{folder}/{digest[:12]}-{remarks_digest(batch)[:8]}.parquet"
        noted = self._noted(file)
        sha256 = self._intact(file, digest, noted)
        healed = sha256 is None and (noted is not None or (self.root / file).exists())
        if sha256 is None:
            body = encode(batch, digest)
            sha256 = hashlib.sha256(body).hexdigest()
            with self._writing():
                self._replace(self.root / file, body)
        year = batch.start.year if batch.start is not None else 0
        return Staged(
            batch.machine, batch.batch_id, digest, measured_digest(batch), file, batch.source, batch.n_rows, year,
            batch.simulated, sha256, healed,
        )  # fmt: skip

    def commit(self, staged: Sequence[Staged], distinct: bool = False) -> list[Stored]:
        """Make staged batches visible, all at once, in their order, except withdrawn content.

        With `distinct`, the measured values of a batch are stored under one id only (see `manifest.enter`).
        """
        if not staged:
            return []
        with self._changing() as (manifest, touch):
            copies = {m: self._copies(manifest, m) for m in {s.machine for s in staged}} if distinct else {}
            stored = [listing.enter(manifest, s, _now(), copies.get(s.machine)) for s in staged]
            entered = [s for s, done in zip(staged, stored, strict=True) if not done.left_out]
            gone = [s.file for s in entered if not (self.root / s.file).exists()]
            if gone:
                raise WorkError(f"lake {self.root}: {gone[0]} was deleted during the ingest; ingest again")
            for s in entered:
                touch(s.machine, s.batch_id)
        self.discard([s for s, done in zip(staged, stored, strict=True) if done.left_out])
        return stored

    def discard(self, staged: Sequence[Staged]) -> None:
        """Delete the files of staged batches that no version uses."""
        if not staged:
            return
        with self._writing():
            machines = self._manifest()["machines"]
            for s in staged:
                if s.file not in listing.files_kept(machines.get(s.machine, {}).get(s.batch_id, [])):
                    self._delete(self.root / s.file)

    def withdraw(self, machine: str, batch_ids: Sequence[str], reason: str) -> list[str]:
        """Take batches out of use, with all their versions, until `restore`; their content stays in the lake.

        The same content is not stored again, whatever its name. Returns the ids.

        Args:
            batch_ids: ids, or patterns such as ``2025*``.

        Raises:
            InputError: no reason, an unknown machine, or no batch in use fits one of `batch_ids`.
            WorkError: see `put`.
        """
        if not reason.strip():
            raise InputError("withdraw: the reason is empty; state why the batches are not to be used")
        with self._changing() as (manifest, touch):
            batches = self._batches(machine, manifest)
            where = f"lake {self.root}: {machine} has no batch in use that fits"
            ids = listing.chosen(list(listing.active(batches)), batch_ids, where)
            listing.withdraw(batches, ids, reason.strip(), _now())
            for batch_id in ids:
                touch(machine, batch_id)
        return ids

    def forget_machine(self, machine: str, reason: str) -> list[str]:
        """Withdraw every batch of a machine; see `withdraw`."""
        return self.withdraw(machine, ["*"], reason)

    def restore(self, machine: str, batch_ids: Sequence[str]) -> list[str]:
        """Bring withdrawn batches back into use; purged ones are forgotten, so that they can be ingested again.

        Returns the ids.

        Raises:
            InputError: an unknown machine, or no withdrawn batch fits one of `batch_ids`.
            WorkError: see `put`.
        """
        with self._changing() as (manifest, touch):
            batches, ids = self._withdrawn(manifest, machine, batch_ids)
            listing.restore(batches, ids)
            if not batches:
                del manifest["machines"][machine]
            for batch_id in ids:
                touch(machine, batch_id)
        return ids

    def purge(self, machine: str, batch_ids: Sequence[str], quarantined: bool = False) -> list[str]:
        """Delete the content of withdrawn batches for good; reason, source and digest stay, and keep them out.

        Args:
            quarantined: also delete the machine's quarantined files.

        Returns the ids.

        Raises:
            InputError: an unknown machine, or no withdrawn batch fits one of `batch_ids`.
            WorkError: see `put`.
        """
        with self._changing() as (manifest, touch):
            self._copies(manifest, machine)  # states the digests of measured values, which outlive the content
            batches, ids = self._withdrawn(manifest, machine, batch_ids)
            listing.purge(batches, ids, _now())
            for batch_id in ids:
                touch(machine, batch_id)
        if quarantined:
            with self._writing():
                for file in sorted(self._quarantine(machine).glob("*"), key=lambda f: f.name == LOG):
                    self._delete(file)
        return ids

    def load(self, machine: str, batch_id: str, version: int | None = None) -> Batch:
        """One batch, by default its current version.

        Raises:
            InputError: no such machine, batch or version; the closest and the allowed ones.
            WorkError: its file is missing, damaged, or was changed after the ingest.
        """
        entries = self._entries(machine, batch_id)
        by_number = {e["version"]: e for e in entries}
        number = entries[-1]["version"] if version is None else version
        if number not in by_number:
            raise InputError(
                f"lake {self.root}: batch {batch_id} of {machine} has no version {version}; "
                f"expected {', '.join(map(str, by_number))}"
            )
        gone = listing.withdrawal(by_number[number])
        if gone is not None:
            raise InputError(
                f"lake {self.root}: batch {batch_id} of {machine} is withdrawn ({gone.reason}); "
                f"`thermodrift lake restore {machine} {batch_id}` brings it back"
            )
        return self._read(by_number[number], f"batch {batch_id} of {machine}")

    def load_all(self, machine: str) -> list[Batch]:
        """Current version of every batch in use, by start (unknown last), then id.

        Raises:
            InputError: the lake holds nothing of this machine, or all of it is withdrawn.
            WorkError: see `load`.
        """
        held = listing.active(self._batches(machine))
        if not held:
            raise InputError(
                f"lake {self.root}: every batch of machine {machine!r} is withdrawn; "
                f"`thermodrift lake restore {machine} '*'` brings them back"
            )
        batches = [self._read(entries[-1], f"batch {i} of {machine}") for i, entries in held.items()]
        return sorted(
            batches, key=lambda b: (b.start is None, "" if b.start is None else b.start.isoformat(), b.batch_id)
        )

    def machines(self, withdrawn: bool = False) -> list[str]:
        """Names of machines with at least one batch in use; with `withdrawn` also those with withdrawn ones alone."""
        machines = self._manifest()["machines"]
        return sorted(m for m, batches in machines.items() if withdrawn or listing.active(batches))

    def batch_ids(self, machine: str) -> list[str]:
        """Ids of a machine's batches in use, sorted; empty for an unknown machine."""
        return sorted(listing.active(self._manifest()["machines"].get(machine, {})))

    def contents(self, machine: str) -> dict[str, list[Version]]:
        """Every version of every batch of a machine by id, oldest first, withdrawn ones included.

        Raises:
            InputError: the lake holds nothing of this machine.
        """
        return {i: [listing.version_of(e) for e in entries] for i, entries in sorted(self._batches(machine).items())}

    def versions(self, machine: str, batch_id: str) -> list[Version]:
        """Every version of a batch, oldest first, withdrawn ones included."""
        return [listing.version_of(e) for e in self._entries(machine, batch_id)]

    def quarantine(self, path: Path, machine: str, reason: str) -> Path:
        """Keep an unusable file's bytes and the reason; the file itself stays where it is.

        Returns the copy's path (the log's, where the file cannot be read). The same bytes under the same name
        with the same reason are entered once.
        """
        folder = self._quarantine(machine)
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
        return read_log(self._quarantine(machine))

    def _quarantine(self, machine: str) -> Path:
        return self.root / "_quarantine" / f"machine={safe_name(machine)}"

    @property
    def _manifest_path(self) -> Path:
        return self.root / "_manifest.json"

    def _manifest(self) -> dict[str, Any]:
        try:
            manifest: dict[str, Any] = json.loads(self._manifest_path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return listing.empty()
        except (OSError, ValueError) as error:
            raise WorkError(f"lake {self._manifest_path}: cannot be read ({error}); restore it from a backup") from None
        if manifest.get("schema") != listing.SCHEMA:
            raise WorkError(
                f"lake {self._manifest_path}: got schema {manifest.get('schema')!r}, expected {listing.SCHEMA!r}; "
                "use another lake folder"
            )
        return manifest

    def _batches(self, machine: str, manifest: dict[str, Any] | None = None) -> dict[str, list[Entry]]:
        machines = (manifest or self._manifest())["machines"]
        if machine not in machines:
            hint = closest(machine, machines) if machines else "it is empty"
            raise InputError(f"lake {self.root}: no batch of machine {machine!r}; {hint}. Run thermodrift ingest first")
        batches: dict[str, list[Entry]] = machines[machine]
        return batches

    def _entries(self, machine: str, batch_id: str) -> list[Entry]:
        batches = self._batches(machine)
        if batch_id not in batches:
            raise InputError(f"lake {self.root}: {machine} has no batch {batch_id!r}; {closest(batch_id, batches)}")
        return batches[batch_id]

    def _read(self, entry: Entry, name: str) -> Batch:
        """A version as it was ingested; `name` is that of its batch.

        Raises:
            WorkError: its file is missing, damaged, or holds something else than was ingested.
        """
        path = self.root / entry["file"]
        remedy = (
            f"restore it from a backup or ingest its source {entry['source'] or '(unknown)'} again, "
            "which writes it anew where the content is the same"
        )
        noted = entry.get("sha256", {}).get(entry["file"])
        body = read_body(path, f"{name}: ", remedy)
        if noted is not None and (got := hashlib.sha256(body).hexdigest()) != noted:
            raise WorkError(
                f"lake file {path}: {name} cannot be read (the file was changed or cut after its ingest: sha256 "
                f"{got[:12]}…, expected {noted[:12]}…); {remedy}"
            )
        batch = replace(decode(body, path, entry["version"]), source=entry["source"])
        if noted is None and content_digest(batch) != entry["digest"]:  # a lake of an earlier program
            raise WorkError(f"lake file {path}: {name} cannot be read (other content than was ingested); {remedy}")
        return batch

    def _noted(self, file: str) -> str | None:
        """The hash of a file under the root as the manifest has it; the manifest is read where it has changed."""
        try:
            seen = self._manifest_path.stat()
        except OSError:
            return None
        look = (seen.st_ino, seen.st_size, seen.st_mtime_ns)
        if self._known[0] != look:
            machines = self._manifest()["machines"].values()
            found = listing.hashes(e for batches in machines for entries in batches.values() for e in entries)
            self._known = look, found
        return self._known[1].get(file)

    def _intact(self, file: str, digest: str, noted: str | None) -> str | None:
        """The hash of a stored file, None where it must be written: it is not there, or damaged.

        Where the manifest has no hash of it, the content itself is compared.
        """
        path = self.root / file
        try:
            body = read_body(path)
            sha256 = hashlib.sha256(body).hexdigest()
            if noted is None:
                batch = decode(body, path)
                same = content_digest(batch) == digest and path.stem.endswith(remarks_digest(batch)[:8])
                return sha256 if same else None
        except (InputError, WorkError):
            return None
        return sha256 if sha256 == noted else None

    def _withdrawn(
        self, manifest: dict[str, Any], machine: str, batch_ids: Sequence[str]
    ) -> tuple[dict[str, list[Entry]], list[str]]:
        """A machine's batches, and the ids with withdrawn versions among those wanted."""
        batches = self._batches(machine, manifest)
        gone = [i for i, entries in batches.items() if any("withdrawn" in e for e in entries)]
        return batches, listing.chosen(gone, batch_ids, f"lake {self.root}: {machine} has no withdrawn batch that fits")

    def _copies(self, manifest: dict[str, Any], machine: str) -> listing.Copies:
        """Versions by their measured values; a lake of an earlier program gets the digests."""
        batches = manifest["machines"].get(machine, {})
        for entry in (e for entries in batches.values() for e in entries if "measured" not in e):
            try:
                entry["measured"] = measured_digest(self._read(entry, machine))
            except WorkError:
                continue  # a damaged file has no values to compare; `load` reports it
        return listing.copies_of(batches)

    @contextmanager
    def _changing(self) -> Iterator[tuple[dict[str, Any], Callable[[str, str], None]]]:
        """Exclusive access to the manifest and a function that names the batches touched.

        Changes are committed when the block ends, then the current files of these batches follow.
        """
        with self._writing():
            manifest = self._manifest()
            self._publish(manifest, manifest["pending"])
            before, touched = json.dumps(manifest), set[tuple[str, str]]()
            yield manifest, lambda machine, batch_id: touched.add((machine, batch_id))
            if json.dumps(manifest) != before:
                manifest["pending"] = sorted(touched)
                self._replace(self._manifest_path, json.dumps(manifest).encode())
            self._publish(manifest, touched)

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
        """Replace the current files of these batches by those that the manifest names; delete purged files."""
        folders = set()
        for machine, batch_id in batches:
            entries: list[Entry] = manifest["machines"].get(machine, {}).get(batch_id, [])
            purged = {f for e in entries for f in (*e["earlier"], e["file"])} - listing.files_kept(entries)
            for file in purged:
                self._delete(self.root / file)
            folder, name = self.root / f"machine={safe_name(machine)}", f"{safe_name(batch_id)}.parquet"
            elsewhere = [folder / f"year={year}" / name for year in {e["year"] for e in entries}]
            if not entries or "withdrawn" in entries[-1]:
                for gone in elsewhere:
                    self._delete(gone)
                continue
            version = self.root / entries[-1]["file"]
            target = folder / f"year={entries[-1]['year']}" / name
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

    def _delete(self, file: Path) -> None:
        """Delete a file and the folders below the root that it leaves empty."""
        file.unlink(missing_ok=True)
        for folder in file.parents:
            if folder == self.root or not folder.exists() or any(folder.iterdir()):
                break
            folder.rmdir()


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


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
