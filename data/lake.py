"""Parquet lake: versioned storage of batches, atomic and safe for concurrent writers, in a folder or an object store.

    ROOT/machine=NAME/year=YYYY/BATCH.parquet      the current version, for any reader (hive partitions)
    ROOT/_versions/machine=NAME/BATCH/*.parquet    every version ever stored, read-only
    ROOT/_quarantine/machine=NAME/                 files that could not be used, and reasons.jsonl
    ROOT/_manifest/machine=NAME.json               versions of every batch of a machine; decides what exists
    ROOT/_manifest.json                            that this is a lake, and when it was changed last

Names with a leading underscore are skipped by the dataset discovery of pyarrow and pandas; DuckDB reads
``ROOT/*/*/*.parquet``.

A version is identified by its content (see `lakefile.content_digest`). New findings, repairs or channel descriptions
for the same content *refresh* the version: number and digest stay, a new file holds the new remarks, and the earlier
file is kept. Replacing a machine's manifest commits a write: `load` gives the old state before it and the new state
after. A machine costs the same however many others there are. Where two writers change a manifest at once, the second
one makes its change again on what the first has written.
The current file is replaced next. If the process is killed in between, plain readers see the old version until the
machine's next write, which finds the batch under `pending`.

The manifest has the hash of every file, and `load` verifies it: a file that was changed or cut after its ingest is
refused, and the next ingest of its source *heals* it, which writes it anew. With a key, every manifest carries an HMAC
of its content, and one without the right HMAC is refused.

A withdrawn batch keeps its versions but has no current file, and nothing loads it; `restore` brings it back, `purge`
deletes its content. Withdrawn content is not stored again.
"""

from __future__ import annotations

import hashlib
import json
import random
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from data import manifest as listing
from data.batch import Batch
from data.errors import InputError, WorkError, closest
from data.files import from_json
from data.lakefile import content_digest, decode, encode, measured_digest, remarks_digest, safe_name, unreadable
from data.lakestore import LOCK_WAIT_S, Folder, Locked, Stamp, open_store
from data.manifest import Batches, Entry, Staged, Stored, Version

LOG = "reasons.jsonl"
MANIFEST = "_manifest.json"
MANIFESTS = "_manifest"
POLL_S = 0.1  # mean wait before a change is made again after another writer's
R = TypeVar("R")
COPY_MAX_BYTES = 64 << 20  # of a file in quarantine: a year of one machine at 1 min is smaller


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


def _log_entry(path: Path, machine: str, reason: str, folder: Path) -> Quarantined:
    """The log entry for `path`, with the hash of its bytes; writes nothing. A large file gets no copy."""
    sha256, copy = "", None
    name = safe_name(path.name.encode("utf-8", "backslashreplace").decode())  # undecodable bytes escaped
    try:
        with path.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        if path.stat().st_size <= COPY_MAX_BYTES:
            copy = folder / f"{sha256[:12]}-{name}"
        else:
            reason = f"{reason} (no copy kept: larger than {COPY_MAX_BYTES >> 20} MB)"
    except OSError as error:
        reason = f"{reason} (no copy kept: its bytes cannot be read, {error.strerror})"
    return Quarantined(machine, path.name, str(path), sha256, reason, _now(), copy)


class Lake:
    """Batches of all machines under one root, which the first write makes.

    Args:
        root: a folder, or an address such as ``s3://bucket/lake``.
        key: signs the manifests; empty: they carry plain hashes.

    Raises:
        InputError: an address that is unknown, or whose package is not installed.
    """

    def __init__(self, root: Path | str, key: str = "") -> None:
        self._store, self._key = open_store(root), key
        self._known: dict[str, tuple[Stamp, dict[str, str]]] = {}

    @property
    def name(self) -> str:
        """The root as messages have it."""
        return self._store.name

    @property
    def root(self) -> Path | str:
        """The folder, or the address."""
        return self._store.root if isinstance(self._store, Folder) else self._store.name

    def size(self, file: str) -> int:
        """Size of a file of `Version.files` in bytes, 0 where it is gone."""
        return self._store.size(file)

    def put(self, batch: Batch) -> Stored:
        """Store one batch: nothing is ever overwritten; the same content twice is stored once.

        Raises:
            InputError: the batch cannot be stored (see `lakefile.content_digest`).
            WorkError: the lake cannot be written or stays locked for ten minutes.
        """
        return self.put_many([batch])[0]

    def put_many(self, batches: Iterable[Batch]) -> list[Stored]:
        """Store batches, taken one by one, in one commit: those of a machine become visible together."""
        return self.commit([self.stage(b) for b in batches])

    def stage(self, batch: Batch, digest: str | None = None) -> Staged:
        """Write a batch's file without making it visible, unless it stands there undamaged already.

        `digest` saves hashing the batch again.
        """
        digest = digest or content_digest(batch)
        file = f"{listing.folder_of(batch.machine, batch.batch_id)}/{digest[:12]}-{remarks_digest(batch)[:8]}.parquet"
        noted = self._noted(file)
        sha256 = self._intact(file, digest, noted)
        healed = sha256 is None and noted is not None
        if sha256 is None:
            body = encode(batch, digest)
            sha256 = hashlib.sha256(body).hexdigest()
            with self._writing():
                self._store.write(file, body)
        year = batch.start.year if batch.start is not None else 0
        return Staged(
            batch.machine, batch.batch_id, digest, measured_digest(batch), file, batch.source, batch.n_rows, year,
            batch.simulated, sha256, healed,
        )  # fmt: skip

    def commit(self, staged: Sequence[Staged], distinct: bool = False) -> list[Stored]:
        """Make staged batches visible, those of a machine at once, in their order, except withdrawn content.

        With `distinct`, the measured values of a batch are stored under one id only (see `manifest.enter`).
        """
        stored: dict[int, Stored] = {}
        for machine in dict.fromkeys(s.machine for s in staged):
            own = {k: s for k, s in enumerate(staged) if s.machine == machine}
            stored |= self._change(machine, partial(self._enter, own, distinct))
        self.discard([s for k, s in enumerate(staged) if stored[k].left_out])
        return [stored[k] for k in range(len(staged))]

    def _enter(self, own: dict[int, Staged], distinct: bool, batches: Batches) -> tuple[dict[int, Stored], set[str]]:
        copies, at = listing.copies_of(batches) if distinct else None, _now()
        stored = {k: listing.enter(batches, s, at, copies) for k, s in own.items()}
        entered = [s for k, s in own.items() if not stored[k].left_out]
        gone = [s.file for s in entered if not self._store.exists(s.file)]
        if gone:
            raise WorkError(f"lake {self.name}: {gone[0]} was deleted during the ingest; ingest again")
        return stored, {s.batch_id for s in entered}

    def discard(self, staged: Sequence[Staged]) -> None:
        """Delete the files of staged batches that no version uses, where no other writer can just be using them."""
        if not staged or not self._store.exclusive:
            return
        with self._writing():
            for s in staged:
                if s.file not in listing.files_kept(self._held(s.machine).get(s.batch_id, [])):
                    self._store.delete(s.file)

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

        return self._edit(machine, batch_ids, "in use", lambda b, ids: listing.withdraw(b, ids, reason.strip(), _now()))

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
        return self._edit(machine, batch_ids, "withdrawn", listing.restore)

    def purge(self, machine: str, batch_ids: Sequence[str], quarantined: bool = False) -> list[str]:
        """Delete the content of withdrawn batches for good; reason, source and digest stay, and keep them out.

        Args:
            quarantined: also delete the machine's quarantined files.

        Returns the ids.

        Raises:
            InputError: an unknown machine, or no withdrawn batch fits one of `batch_ids`.
            WorkError: see `put`.
        """
        ids = self._edit(machine, batch_ids, "withdrawn", lambda b, ids: listing.purge(b, ids, _now()))
        if quarantined:
            with self._writing():
                folder = _quarantine(machine)
                for file in sorted(self._store.files(folder), key=lambda name: name == LOG):
                    self._store.delete(f"{folder}/{file}")
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
                f"lake {self.name}: batch {batch_id} of {machine} has no version {version}; "
                f"expected {', '.join(map(str, by_number))}"
            )
        gone = listing.withdrawal(by_number[number])
        if gone is not None:
            raise InputError(
                f"lake {self.name}: batch {batch_id} of {machine} is withdrawn ({gone.reason}); "
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
                f"lake {self.name}: every batch of machine {machine!r} is withdrawn; "
                f"`thermodrift lake restore {machine} '*'` brings them back"
            )
        bodies = self._store.read_many([entries[-1]["file"] for entries in held.values()])
        batches = [
            self._read(entries[-1], f"batch {i} of {machine}", body)
            for (i, entries), body in zip(held.items(), bodies, strict=True)
        ]
        return sorted(
            batches, key=lambda b: (b.start is None, "" if b.start is None else b.start.isoformat(), b.batch_id)
        )

    def machines(self, withdrawn: bool = False) -> list[str]:
        """Names of machines with at least one batch in use; with `withdrawn` also those with withdrawn ones alone."""
        machines = self._every_machine()
        return sorted(m for m, batches in machines.items() if (batches if withdrawn else listing.active(batches)))

    def batch_ids(self, machine: str) -> list[str]:
        """Ids of a machine's batches in use, sorted; empty for an unknown machine."""
        return sorted(listing.active(self._held(machine)))

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

        Returns the copy's path (the log's, where there is no copy), below the root where that is no folder of this
        computer. The same bytes under the same name with the same reason are entered once.
        """
        return self.quarantine_many([(path, reason)], machine)[0]

    def quarantine_many(self, refused: Sequence[tuple[Path, str]], machine: str) -> list[Path]:
        """As `quarantine`, of files with reasons. Copy and log can be read by their owner alone."""
        if not refused:
            return []
        folder, kept = _quarantine(machine), list[Path]()
        at = self._store.path(folder)
        with self._writing():
            held, found = set(self._store.files(folder)), list[Quarantined]()
            for path, reason in refused:
                entry = _log_entry(path, machine, reason, at)
                if entry.copy is not None and entry.copy.name not in held:
                    self._store.write(f"{folder}/{entry.copy.name}", path, private=True)
                    held.add(entry.copy.name)
                found.append(entry)
                kept.append(entry.copy or at / LOG)
            for again in self._attempts():
                raw, stamp = self._store.read_stamped(f"{folder}/{LOG}")
                entries = self._entries_of(raw, folder)
                known = {replace(e, at="") for e in entries}
                entries += [e for e in dict.fromkeys(found) if replace(e, at="") not in known]
                rows = [{**asdict(e), "copy": e.copy.name if e.copy else None} for e in entries]
                log = "".join(json.dumps(row) + "\n" for row in rows)
                if self._store.swap(f"{folder}/{LOG}", log.encode(), stamp, private=True):
                    break
                again()
        return kept

    def quarantined(self, machine: str) -> list[Quarantined]:
        """Quarantined files of a machine, oldest first."""
        folder = _quarantine(machine)
        return self._entries_of(self._store.read_stamped(f"{folder}/{LOG}")[0], folder)

    def _entries_of(self, log: bytes | None, folder: str) -> list[Quarantined]:
        at, rows = self._store.path(folder), (log or b"").splitlines()
        try:
            found = [from_json(row) for row in rows if row]
            return [Quarantined(**{**row, "copy": at / row["copy"] if row["copy"] else None}) for row in found]
        except (ValueError, TypeError, KeyError) as error:
            where = f"lake {self.name}/{folder}/{LOG}"
            raise WorkError(f"{where}: cannot be read ({error}); restore it from a backup, or move it away") from None

    def _manifest(self, machine: str) -> tuple[dict[str, Any], Stamp]:
        """The manifest of a machine, without any batch where there is none, and its state in the store."""
        found, stamp = self._json(manifest_file(machine))
        if found is None:
            self._json(MANIFEST)  # a lake of an earlier version is none without this machine
        return found or listing.empty(), stamp

    def _held(self, machine: str) -> Batches:
        """The batches of a machine, withdrawn ones included."""
        batches: Batches = self._manifest(machine)[0]["machines"].get(machine, {})
        return batches

    def _every_machine(self) -> dict[str, Batches]:
        """The batches of every machine; the only look-up whose cost grows with the machines."""
        self._json(MANIFEST)
        each = (self._json(f"{MANIFESTS}/{name}")[0] for name in self._store.files(MANIFESTS))
        return {m: batches for manifest in each if manifest for m, batches in manifest["machines"].items()}

    def _json(self, file: str) -> tuple[dict[str, Any] | None, Stamp]:
        """A manifest, None where there is none."""
        where = f"lake {self.name}/{file}"
        try:
            raw, stamp = self._store.read_stamped(file)
        except OSError as error:
            remedy = "restore it from a backup" if self._store.exclusive else "check address, credentials and network"
            raise WorkError(f"{where}: cannot be read ({error}); {remedy}") from None
        return None if raw is None else listing.unpack(raw, where, self._key if file != MANIFEST else ""), stamp

    def _batches(self, machine: str) -> Batches:
        batches = self._held(machine)
        if not batches:
            others = self.machines(withdrawn=True)
            hint = closest(machine, others) if others else "it is empty"
            raise InputError(f"lake {self.name}: no batch of machine {machine!r}; {hint}. Run thermodrift ingest first")
        return batches

    def _entries(self, machine: str, batch_id: str) -> list[Entry]:
        batches = self._batches(machine)
        if batch_id not in batches:
            raise InputError(f"lake {self.name}: {machine} has no batch {batch_id!r}; {closest(batch_id, batches)}")
        return batches[batch_id]

    def _read(self, entry: Entry, name: str, body: bytes | OSError | None = None) -> Batch:
        """A version as it was ingested; `name` is that of its batch, `body` what was read of its file already.

        Raises:
            WorkError: its file is missing, damaged, or holds something else than was ingested.
        """
        where = f"{self.name}/{entry['file']}"
        remedy = (
            f"restore it from a backup or ingest its source {entry['source'] or '(unknown)'} again, "
            "which writes it anew where the content is the same"
        )
        noted = entry["sha256"][entry["file"]]
        body = self._body(entry["file"]) if body is None else body
        if isinstance(body, OSError):
            raise unreadable(where, body, f"{name}: ", remedy)
        if (got := hashlib.sha256(body).hexdigest()) != noted:
            raise WorkError(
                f"lake file {where}: {name} cannot be read (the file was changed or cut after its ingest: sha256 "
                f"{got[:12]}…, expected {noted[:12]}…); {remedy}"
            )
        return replace(decode(body, where, entry["version"]), source=entry["source"])

    def _body(self, file: str) -> bytes | OSError:
        try:
            return self._store.read(file)
        except OSError as error:
            return error

    def read(self, version: Version) -> Batch:
        """A version of `contents` or `versions`, withdrawn or not, as its file has it.

        Raises:
            WorkError: its file is gone or damaged.
        """
        where, body = f"{self.name}/{version.files[-1]}", self._body(version.files[-1])
        if isinstance(body, OSError):
            raise unreadable(where, body)
        return decode(body, where, version.version)

    def _noted(self, file: str) -> str | None:
        """The hash of a stored file as its machine's manifest has it; that is read where it has changed."""
        manifest = f"{MANIFESTS}/{file.split('/')[1]}.json"
        look = self._store.stamp(manifest)
        if look is None:
            return None
        if self._known.get(manifest, (None, {}))[0] != look:
            machines = (self._json(manifest)[0] or listing.empty())["machines"].values()
            found = listing.hashes(e for batches in machines for entries in batches.values() for e in entries)
            self._known[manifest] = look, found
        return self._known[manifest][1].get(file)

    def _intact(self, file: str, digest: str, noted: str | None) -> str | None:
        """The hash of a stored file, None where it must be written: it is not there, or damaged.

        Where the manifest has no hash of it, the content itself is compared.
        """
        body = self._body(file)
        if isinstance(body, OSError):
            return None
        sha256 = hashlib.sha256(body).hexdigest()
        try:
            if noted is None:
                batch = decode(body, file)
                same = content_digest(batch) == digest and file.endswith(f"{remarks_digest(batch)[:8]}.parquet")
                return sha256 if same else None
        except (InputError, WorkError):
            return None
        return sha256 if sha256 == noted else None

    def _edit(
        self, machine: str, wanted: Sequence[str], state: str, change: Callable[[Batches, list[str]], None]
    ) -> list[str]:
        """Change the batches among those wanted that are "in use", or have "withdrawn" versions; their ids."""

        def edit(batches: Batches) -> tuple[list[str], set[str]]:
            gone = [i for i, entries in batches.items() if any("withdrawn" in e for e in entries)]
            found = ([*listing.active(batches)], "batch in use") if state == "in use" else (gone, "withdrawn batch")
            ids = listing.chosen(found[0], wanted, f"lake {self.name}: {machine} has no {found[1]} that fits")
            change(batches, ids)
            return ids, set(ids)

        return self._change(machine, edit, known=True)

    def _change(self, machine: str, edit: Callable[[Batches], tuple[R, set[str]]], known: bool = False) -> R:
        """Change a machine's batches and commit that, then let the current files of the changed batches follow.

        Args:
            edit: changes the batches in place; returns its result and the ids that it changed. It is called again where
                another writer was quicker.
            known: raise InputError where the lake has nothing of the machine.
        """
        with self._writing():
            behind = set[str]()
            for again in self._attempts():
                manifest, stamp = self._manifest(machine)
                if known and not manifest["machines"].get(machine):
                    self._batches(machine)
                batches: Batches = manifest["machines"].setdefault(machine, {})
                self._publish(machine, batches, manifest["pending"])
                behind |= set(manifest["pending"])  # once more below: another writer may have changed them meanwhile
                before = json.dumps(batches)
                result, touched = edit(batches)
                if json.dumps(batches) == before:
                    break
                packed = listing.pack({**manifest, "pending": sorted(touched)}, self._key)
                if self._store.swap(manifest_file(machine), packed, stamp):
                    head = json.dumps({"schema": listing.SCHEMA, "changed_at": datetime.now(UTC).isoformat()})
                    self._store.write(MANIFEST, head.encode(), keep=False)
                    break
                again()
            while True:
                self._publish(machine, batches, touched if self._store.exclusive else touched | behind)
                now = batches if self._store.exclusive else self._held(machine)
                if now == batches:
                    return result
                batches = now  # another writer's, whose current files these may have replaced

    def _attempts(self) -> Iterator[Callable[[], None]]:
        """Attempts at a change that another writer may be quicker with; each gives what waits before the next one."""
        end_s = time.monotonic() + LOCK_WAIT_S
        while time.monotonic() < end_s:
            yield lambda: time.sleep(random.uniform(0.0, 2.0 * POLL_S))
        raise Locked

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Exclusive access, with files of an interrupted writer removed."""
        try:
            with self._store.locked():
                yield
        except Locked:
            raise WorkError(
                f"lake {self.name}: locked by another ingest for {LOCK_WAIT_S / 60:.0f} min; wait for it or end it"
            ) from None
        except OSError as error:
            raise WorkError(f"lake {self.name}: cannot be written ({error}); nothing stored was lost") from error

    def _publish(self, machine: str, batches: Batches, ids: Iterable[str]) -> None:
        """Replace the current files of these batches by those that the manifest names; delete purged files."""
        store, changed = self._store, list[str]()
        for batch_id in ids:
            entries = batches.get(batch_id, [])
            purged = {f for e in entries for f in (*e["earlier"], e["file"])} - listing.files_kept(entries)
            for file in purged:
                store.delete(file)
            folder, name = f"machine={safe_name(machine)}", f"{safe_name(batch_id)}.parquet"
            elsewhere = [f"{folder}/year={year}/{name}" for year in {e["year"] for e in entries}]
            if not entries or "withdrawn" in entries[-1]:
                for gone in elsewhere:
                    store.delete(gone)
                continue
            target = f"{folder}/year={entries[-1]['year']}/{name}"
            standing = [f for f in elsewhere if f != target and store.exists(f)]
            # a batch that changed its year is first replaced where it stands, then moved: never absent, never double
            at = standing[0] if standing and not store.exists(target) else target
            if store.repeat(at, entries[-1]["file"]):
                changed.append(target)
            if at != target:
                store.move(at, target)
                changed.append(target)
            for stale in standing:
                store.delete(stale)
        store.settle(changed)


def manifest_file(machine: str) -> str:
    """Where the manifest of a machine is, below the root."""
    return f"{MANIFESTS}/machine={safe_name(machine)}.json"


def _quarantine(machine: str) -> str:
    return f"_quarantine/machine={safe_name(machine)}"


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
