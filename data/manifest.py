"""A machine's manifest as plain data: which versions of which batches exist, which are withdrawn, and changes to them.

``{"schema", "pending": [batch, …], "machines": {machine: {batch: [version, …]}}}`` of one machine, versions oldest
first; with a key also ``"hmac"``. A version's ``"sha256"`` has the hash of the bytes of each of its files, and
``"measured"`` that of its measured values. A withdrawn version has ``"withdrawn": {"reason", "at", "purged_at"}``;
`purged_at` is empty while its file is kept. A batch is withdrawn where its last version is. Functions change the
batches that they are given; nothing is written.
"""

from __future__ import annotations

import hmac
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, Literal

from data.errors import InputError, WorkError, closest
from data.files import from_json
from data.lakefile import safe_name

SCHEMA = "thermodrift.lake/3"
EARLIER = ("thermodrift.lake/1", "thermodrift.lake/2")  # see `data.lake_migration`
Status = Literal["new", "unchanged", "refreshed", "healed", "new_version", "duplicate", "withdrawn"]
Entry = dict[str, Any]  # one version of a batch as it is stored
Batches = dict[str, list[Entry]]  # of a machine
Copies = dict[str, dict[str, Entry]]  # digest of measured values -> batch id -> version


@dataclass(frozen=True)
class Stored:
    """The outcome of storing a batch.

    `status`: new, new_version; unchanged, refreshed (the same content, with other findings), healed (the same content,
    whose stored file was damaged or gone and is written anew); duplicate: left out, another batch has the same measured
    values; withdrawn: left out, these were withdrawn for `reason`. `version` and `batch_id` are what the lake holds, so
    those of the other batch for a duplicate. `replaces` is the source of the version before a new one.
    """

    status: Status
    version: int
    digest: str
    machine: str
    batch_id: str
    replaces: str = ""
    reason: str = ""

    @property
    def left_out(self) -> bool:
        return self.status in ("duplicate", "withdrawn")


@dataclass(frozen=True)
class Withdrawal:
    """Why and when (UTC) a version was withdrawn; `purged_at` is when its content was deleted, else empty."""

    reason: str
    at: str
    purged_at: str = ""


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
    withdrawn: Withdrawal | None = None


@dataclass(frozen=True)
class Staged:
    """A batch whose file is written and waits for a commit.

    `measured` is as `lakefile.measured_digest`, `sha256` the hash of the file's bytes; `healed`: the file replaces a
    damaged one.
    """

    machine: str
    batch_id: str
    digest: str
    measured: str
    file: str
    source: str
    rows: int
    year: int
    simulated: bool
    sha256: str
    healed: bool = False


def empty() -> dict[str, Any]:
    """The manifest of a lake without a batch."""
    return {"schema": SCHEMA, "pending": [], "machines": {}}


def pack(manifest: Mapping[str, Any], key: str) -> bytes:
    """A manifest as it is stored, with an HMAC-SHA256 of its content where there is a key."""
    own = {k: v for k, v in manifest.items() if k != "hmac"}
    return json.dumps({**own, "hmac": _hmac(own, key)} if key else own).encode()


def unpack(raw: bytes, where: str, key: str) -> dict[str, Any]:
    """A stored manifest.

    Raises:
        WorkError: not readable, of an earlier version, naming strange files, or not signed with this key.
    """
    try:
        manifest: dict[str, Any] = from_json(raw)
        schema = manifest.get("schema")
    except (ValueError, AttributeError) as error:
        raise WorkError(f"{where}: cannot be read ({error}); restore it from a backup") from None
    if schema in EARLIER:
        raise WorkError(f"{where}: the lake is of an earlier version ({schema}); run `thermodrift lake migrate`")
    if schema != SCHEMA:
        raise WorkError(f"{where}: got schema {schema!r}, expected {SCHEMA!r}; use another lake folder")
    if key:
        signed = manifest.pop("hmac", "")
        if not signed:
            raise WorkError(
                f"{where}: has no HMAC, and a key is set; run `thermodrift lake migrate` to sign a lake that never was"
            )
        if not hmac.compare_digest(str(signed), _hmac(manifest, key)):
            raise WorkError(
                f"{where}: its HMAC does not fit its content; it was changed by another program or signed with another "
                "key; restore it from a backup, or set the key that it was signed with"
            )
    if strange := stray(manifest):
        raise WorkError(f"{where}: {strange}; it was changed by another program; restore it from a backup")
    return manifest


def _hmac(manifest: Mapping[str, Any], key: str) -> str:
    content = json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()
    return hmac.new(key.encode(), content, "sha256").hexdigest()


def folder_of(machine: str, batch_id: str) -> str:
    """Where the files of a batch's versions are, below the root."""
    return f"_versions/machine={safe_name(machine)}/{safe_name(batch_id)}"


def stray(manifest: Mapping[str, Any]) -> str:
    """What a manifest names outside of the folder of its batch, as only another program writes it; empty for none."""
    for machine, batches in manifest.get("machines", {}).items():
        for batch_id, entries in batches.items():
            folder = f"{folder_of(machine, batch_id)}/"
            for e in entries:
                for file in (e["file"], *e["earlier"]):
                    name = file.removeprefix(folder)
                    if name == file or "/" in name or "\\" in name:
                        return f"batch {batch_id} of {machine}: got file {file!r}, expected one in {folder}"
                if not isinstance(e["year"], int):
                    return f"batch {batch_id} of {machine}: got year {e['year']!r}, expected a whole number"
    return ""


def version_of(entry: Entry) -> Version:
    """A stored version as a value."""
    keys = ("version", "digest", "source", "stored_at", "rows", "year", "simulated", "current")
    gone = withdrawal(entry)
    return Version(**{k: entry[k] for k in keys}, files=(*entry["earlier"], entry["file"]), withdrawn=gone)


def withdrawal(entry: Entry) -> Withdrawal | None:
    """The withdrawal of a version, None where it is in use."""
    return Withdrawal(**entry["withdrawn"]) if "withdrawn" in entry else None


def hashes(entries: Iterable[Entry]) -> dict[str, str]:
    """File -> SHA-256 (hex) of its bytes, as far as noted."""
    return {file: sha256 for e in entries for file, sha256 in e["sha256"].items()}


def active(batches: Mapping[str, list[Entry]]) -> dict[str, list[Entry]]:
    """The batches of a machine that are in use."""
    return {batch_id: entries for batch_id, entries in batches.items() if "withdrawn" not in entries[-1]}


def files_kept(entries: Iterable[Entry]) -> set[str]:
    """Files of all versions whose content is not purged."""
    return {f for e in entries if not e.get("withdrawn", {}).get("purged_at") for f in (*e["earlier"], e["file"])}


def copies_of(batches: Mapping[str, list[Entry]]) -> Copies:
    """Current and withdrawn versions by the digest of their measured values, where that is known."""
    found: Copies = {}
    for batch_id, entries in batches.items():
        for entry in entries:
            if entry["measured"] and ("withdrawn" in entry or entry is entries[-1]):
                found.setdefault(entry["measured"], {})[batch_id] = entry
    return found


def enter(batches: Batches, s: Staged, now: str, copies: Copies | None = None) -> Stored:
    """Write a staged batch into those of its machine.

    Content equal to the current version makes no new one. Withdrawn content stays out, and with `copies` a batch
    whose measured values stand under another id as well; `copies` is updated.
    """
    entries = batches.get(s.batch_id, [])
    last = entries[-1] if s.batch_id in active(batches) else None
    for entry in entries:  # content that came back has two versions with one file
        if s.file in (entry["file"], *entry["earlier"]):
            entry["sha256"][s.file] = s.sha256
    if last is not None and last["digest"] == s.digest:
        return _same_again(last, s)
    same = dict((copies or {}).get(s.measured, {}))
    for entry in entries:
        if "withdrawn" in entry and entry["digest"] == s.digest:
            same[s.batch_id] = entry
    if same and not (s.batch_id in same and "withdrawn" not in same[s.batch_id]):
        other = min(same, key=lambda i: (i != s.batch_id, "withdrawn" in same[i], i))
        gone = withdrawal(same[other])
        left_out: Status = "duplicate" if gone is None else "withdrawn"
        version, reason = same[other]["version"], "" if gone is None else gone.reason
        return Stored(left_out, version, s.digest, s.machine, other, reason=reason)
    replaces = ""
    for entry in entries:
        entry["current"] = False
        replaces = entry["source"]
    made: Entry = {
        "version": entries[-1]["version"] + 1 if entries else 1, "digest": s.digest, "measured": s.measured,
        "source": s.source, "stored_at": now, "rows": s.rows, "year": s.year, "simulated": s.simulated,
        "current": True, "file": s.file, "earlier": [], "sha256": {s.file: s.sha256},
    }  # fmt: skip
    replaced = bool(entries)
    batches.setdefault(s.batch_id, []).append(made)
    if copies is not None:
        if last is not None:
            copies.get(last["measured"], {}).pop(s.batch_id, None)
        copies.setdefault(s.measured, {})[s.batch_id] = made
    return Stored("new_version" if replaced else "new", made["version"], s.digest, s.machine, s.batch_id, replaces)


def _same_again(last: Entry, s: Staged) -> Stored:
    status: Status = "healed" if s.healed else "unchanged" if last["file"] == s.file else "refreshed"
    if last["file"] != s.file:
        last["earlier"] = [f for f in (*last["earlier"], last["file"]) if f != s.file]
        last["file"] = s.file
        last["sha256"][s.file] = s.sha256
    return Stored(status, last["version"], s.digest, s.machine, s.batch_id)


def chosen(ids: Sequence[str], wanted: Sequence[str], where: str) -> list[str]:
    """Ids that equal one of `wanted` or match it as a pattern (``2025*``), sorted.

    Raises:
        InputError: one of `wanted` fits none; `where` says what the ids are.
    """
    found: set[str] = set()
    for name in wanted:
        fits = {name} & set(ids) or {i for i in ids if fnmatchcase(i, name)}
        if not fits:
            raise InputError(f"{where} {name!r}; {closest(name, ids) if ids else 'there is none at all'}")
        found |= fits
    return sorted(found)


def withdraw(batches: Mapping[str, list[Entry]], ids: Sequence[str], reason: str, now: str) -> None:
    """Withdraw every version of these batches that is not withdrawn yet."""
    for entry in (e for i in ids for e in batches[i]):
        entry.setdefault("withdrawn", {"reason": reason, "at": now, "purged_at": ""})
        entry["current"] = False


def restore(batches: dict[str, list[Entry]], ids: Sequence[str]) -> None:
    """Bring withdrawn versions back; those whose content is purged are forgotten, so that they can be stored again."""
    for batch_id in ids:
        kept = [e for e in batches[batch_id] if not e.get("withdrawn", {}).get("purged_at")]
        for entry in kept:
            entry.pop("withdrawn", None)
            entry["current"] = entry is kept[-1]
        if kept:
            batches[batch_id] = kept
        else:
            del batches[batch_id]


def purge(batches: Mapping[str, list[Entry]], ids: Sequence[str], now: str) -> None:
    """Mark withdrawn versions of these batches as purged; a note with their digests and reasons stays."""
    for entry in (e for i in ids for e in batches[i]):
        if "withdrawn" in entry and not entry["withdrawn"]["purged_at"]:
            entry["withdrawn"]["purged_at"] = now
