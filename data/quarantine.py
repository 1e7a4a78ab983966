"""Files that could not be used: their bytes, the reason and the time, kept beside the lake."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

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
    """What the log will say about `path`; hashes its bytes, writes nothing."""
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
    """A file name in an unknown encoding with its stray bytes spelt out."""
    return name.encode("utf-8", "backslashreplace").decode()
