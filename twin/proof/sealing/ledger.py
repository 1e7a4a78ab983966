"""The ledger of a proof: one line an event, each with the hash of the line before.

A changed, missing or added line breaks the chain. Lines cut off its end do not; `commitment.json` and the answers show
those, since an answer without its line counts as void.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Any

from data.errors import InputError, WorkError
from twin.proof.sealing.digests import digest_of

START = "0" * 64


@dataclass(frozen=True)
class Entry:
    """One line: when (UTC, to the second), which step, its details, the hash of the line before and its own."""

    at: str
    step: str
    details: Mapping[str, Any]
    before: str
    own: str = field(default="")

    def plain(self) -> dict[str, Any]:
        """As it is hashed."""
        return {"at": self.at, "step": self.step, "details": dict(self.details), "before": self.before}

    @property
    def words(self) -> str:
        """``case case_0001, answer 3f2a…``: its details in one line."""
        return ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in self.details.items())


class Ledger:
    """The lines of a file, checked when it is opened, and the only way to add to them.

    Raises:
        InputError: a line that is not as it was written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.entries = _read(path) if path.exists() else []
        self._lock = Lock()

    def add(self, step: str, **details: Any) -> Entry:
        """Write a line; it is on the disk when this returns.

        Raises:
            WorkError: the file cannot be written.
        """
        with self._lock:
            before = self.entries[-1].own if self.entries else START
            entry = Entry(now(), step, details, before)
            entry = Entry(entry.at, step, details, before, digest_of(entry.plain()))
            try:
                with self.path.open("ab") as file:
                    file.write(_line(entry))
                    file.flush()
                    os.fsync(file.fileno())
            except OSError as error:
                raise WorkError(f"ledger {self.path}: cannot be written ({error.strerror}); free the folder") from None
            self.entries.append(entry)
            return entry

    def last(self, step: str) -> Entry | None:
        """The latest entry of a step."""
        return next((e for e in reversed(self.entries) if e.step == step), None)


def now() -> str:
    """UTC to the second, ``2026-01-31T12:00:00Z``."""
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"


def _line(entry: Entry) -> bytes:
    return (json.dumps(entry.plain() | {"hash": entry.own}, ensure_ascii=False, allow_nan=False) + "\n").encode()


def _read(path: Path) -> list[Entry]:
    entries: list[Entry] = []
    for number, text in enumerate(path.read_bytes().splitlines(), 1):
        entry = _entry(text)
        before = entries[-1].own if entries else START
        if entry is None or entry.before != before or entry.own != digest_of(entry.plain()):
            raise InputError(
                f"ledger {path} line {number}: is not as it was written, the chain of hashes breaks there; "
                "this proof is worth nothing any more, seal a new one"
            )
        entries.append(entry)
    return entries


def _entry(text: bytes) -> Entry | None:
    try:
        raw = json.loads(text)
        return Entry(raw["at"], raw["step"], raw["details"], raw["before"], raw["hash"])
    except (ValueError, KeyError, TypeError):
        return None
