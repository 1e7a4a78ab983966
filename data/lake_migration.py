"""A lake of an earlier version in the present form, or one without signatures signed.

Version 1 had one manifest of all machines, version 2 one for each. In both a version of a batch may lack the hashes of
its files' bytes and of its measured values. They are made from the files, whose content is compared with its digest.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from data import manifest as listing
from data.errors import InputError, WorkError
from data.files import from_json
from data.lake import MANIFEST, MANIFESTS, manifest_file
from data.lakefile import content_digest, decode, measured_digest
from data.lakestore import Store, open_store
from data.manifest import Entry


@dataclass(frozen=True)
class Migrated:
    """What was done: names of `machines`, number of `files` that were read, and a line for each `damaged` one."""

    machines: tuple[str, ...]
    files: int
    damaged: tuple[str, ...]


def migrate(root: Path | str, key: str = "") -> Migrated:
    """Write every manifest of a lake in the present form, signed where there is a key. May be repeated.

    A file that is gone or damaged gets no hash: it cannot be loaded, and the next ingest of its source heals it.

    Raises:
        InputError: there is no lake.
        WorkError: a manifest cannot be read or is signed with another key, or the lake cannot be written.
    """
    store = open_store(root)
    if store.stamp(MANIFEST) is None:
        raise InputError(f"lake {store.name}: nothing is stored there; give the folder or address of a lake")
    try:
        with store.locked():
            return _migrated(store, key)
    except OSError as error:
        raise WorkError(f"lake {store.name}: cannot be written ({error}); nothing stored was lost") from error


def _migrated(store: Store, key: str) -> Migrated:
    head = _read(store, MANIFEST, key)
    own = {m: {"machines": {m: b}, "pending": head["pending"]} for m, b in head.get("machines", {}).items()}
    for name in store.files(MANIFESTS):
        found = _read(store, f"{MANIFESTS}/{name}", key)
        own |= {machine: found for machine in found["machines"]}
    files, damaged = 0, list[str]()
    for machine, found in own.items():
        for batch_id, entries in found["machines"][machine].items():
            for entry in entries:
                files += _complete(store, entry, f"batch {batch_id} of {machine}", damaged)
        pending = [p if isinstance(p, str) else p[1] for p in found["pending"] if isinstance(p, str) or p[0] == machine]
        manifest = {"schema": listing.SCHEMA, "pending": pending, "machines": {machine: found["machines"][machine]}}
        store.write(manifest_file(machine), listing.pack(manifest, key), keep=False)
    store.write(MANIFEST, json.dumps({"schema": listing.SCHEMA}).encode(), keep=False)
    return Migrated(tuple(sorted(own)), files, tuple(damaged))


def _complete(store: Store, entry: Entry, name: str, damaged: list[str]) -> int:
    """Give a version the hashes that it lacks; returns the number of files that were read."""
    noted: dict[str, str] = entry.setdefault("sha256", {})
    lacking = [f for f in (*entry["earlier"], entry["file"]) if f not in noted or "measured" not in entry]
    purged = bool(entry.get("withdrawn", {}).get("purged_at"))
    for file in lacking:
        sha256 = measured = ""
        try:
            body = b"" if purged else store.read(file)
            if body:
                batch = decode(body, f"{store.name}/{file}")
                if content_digest(batch) != entry["digest"]:
                    raise WorkError(f"{store.name}/{file}: {name} has other content than was ingested")
                sha256, measured = hashlib.sha256(body).hexdigest(), measured_digest(batch)
        except (OSError, InputError, WorkError) as error:
            damaged.append(str(error))
        noted.setdefault(file, sha256)
        entry["measured"] = entry.get("measured") or measured
    return len(lacking)


def _read(store: Store, file: str, key: str) -> dict[str, Any]:
    """A manifest of any version; one that is signed must fit the key, so that no forged one is signed again."""
    where = f"lake {store.name}/{file}"
    try:
        raw = store.read(file)
        found: dict[str, Any] = from_json(raw)
        schema = found["schema"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise WorkError(f"{where}: cannot be read ({error}); restore it from a backup") from None
    if schema not in (*listing.EARLIER, listing.SCHEMA):
        raise WorkError(f"{where}: got schema {schema!r}, expected {listing.SCHEMA!r} or an earlier one")
    if "hmac" in found:
        return listing.unpack(raw, where, key)
    if strange := listing.stray(found):
        raise WorkError(f"{where}: {strange}; it was changed by another program; restore it from a backup")
    return found
