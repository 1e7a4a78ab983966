"""The folder of a proof: its layout, and a lock that admits one process at a time."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from threading import Lock
from typing import Any

from filelock import FileLock, Timeout

from data.errors import InputError, WorkError
from data.files import write_atomic
from thermodrift_exam.proof.sealing.isolation import allowed, own_source, roots


def canonical(value: Any) -> bytes:
    """Plain data as one text, whatever the order of its keys: JSON, keys sorted, no blanks, UTF-8.

    Raises:
        ValueError: a number that is not finite.
    """
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8")


def digest_of(value: Any) -> str:
    """SHA-256 of plain data, hexadecimal."""
    return hashlib.sha256(canonical(value)).hexdigest()


def salted_digest(salt: str, value: Any) -> str:
    """SHA-256 over salt ‖ canonical JSON; `salt` is hexadecimal, of one length for all."""
    return hashlib.sha256(bytes.fromhex(salt) + canonical(value)).hexdigest()


def folder_digest(folder: Path) -> str:
    """SHA-256 over names and contents of all files below a folder."""
    return files_digest(folder, sorted(p for p in folder.rglob("*") if p.is_file()))


def files_digest(root: Path, files: Iterable[Path]) -> str:
    """SHA-256 over files by their path below `root`; each part with its length, so that the encoding is unambiguous."""
    digest = hashlib.sha256()
    for file in files:
        for part in (file.relative_to(root).as_posix().encode(), file.read_bytes()):
            digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()


def source_digest() -> str:
    """SHA-256 over the source that an answering process may read: everything that can change an answer."""
    digests = []
    for root, parts in zip(roots(), own_source(), strict=True):
        files = {f for p in parts for f in ([p] if p.is_file() else p.rglob("*"))}
        digests.append(files_digest(root, sorted(f for f in files if f.is_file() and f.suffix != ".pyc")))
    return digest_of(digests)


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
        """The hashed form."""
        return {"at": self.at, "step": self.step, "details": dict(self.details), "before": self.before}

    @property
    def summary(self) -> str:
        """``case case_0001, answer 3f2a…``: its details in one line."""
        return ", ".join(f"{k.replace('_', ' ')} {v}" for k, v in self.details.items())


class Ledger:
    """The lines of a file, verified when it is opened; lines can only be appended.

    Raises:
        InputError: a line that was changed.
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
                "this proof is void, seal a new one"
            )
        entries.append(entry)
    return entries


def _entry(text: bytes) -> Entry | None:
    try:
        raw = json.loads(text)
        return Entry(raw["at"], raw["step"], raw["details"], raw["before"], raw["hash"])
    except (ValueError, KeyError, TypeError):
        return None


@dataclass(frozen=True)
class ProofFolder:
    """PROOF: an answering process gets one of `cases`; `vault` holds the keys, `answers` the answers."""

    path: Path

    @property
    def commitment(self) -> Path:
        return self.path / "commitment.json"

    @property
    def cases(self) -> Path:
        return self.path / "cases"

    @property
    def vault(self) -> Path:
        return self.path / "vault"

    @property
    def answers(self) -> Path:
        return self.path / "answers"

    @property
    def opened(self) -> Path:
        return self.path / "opened.json"

    @property
    def is_sealed(self) -> bool:
        return self.commitment.exists()

    def ledger(self) -> Ledger:
        """The ledger, its chain checked."""
        return Ledger(self.path / "ledger.jsonl")

    def committed(self) -> dict[str, Any]:
        """The content of `commitment.json`.

        Raises:
            InputError: there is none, or it cannot be read.
        """
        if not self.is_sealed:
            raise InputError(f"{self.path}: is no sealed proof; call `thermodrift prove seal --out {self.path}` first")
        return read_json(self.commitment)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the proof against other processes.

        Raises:
            InputError: another process holds the lock, or an answering process could read the folder.
            WorkError: it cannot be written.
        """
        if (seen := allowed().covers(self.path)) is not None:
            raise InputError(f"{self.path}: lies in {seen}, which answering processes may read; give another folder")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            with FileLock(self.path / ".lock", timeout=0):
                yield
        except Timeout:
            raise InputError(f"{self.path}: another process works on this proof; wait for its end") from None
        except OSError as error:
            raise WorkError(f"{self.path}: cannot be written ({error}); give another folder") from None


def read_json(path: Path) -> Any:
    """Plain data from a file of the proof.

    Raises:
        InputError: it cannot be read, or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); this proof is incomplete, seal a new one") from None


def write_json(path: Path, value: Any) -> None:
    """Plain data into a file of the proof, atomically."""
    write_atomic(path, json.dumps(value, ensure_ascii=False, allow_nan=False, indent=1) + "\n")


LATE = "it was answered after the proof had been opened"
TWICE = "it was answered twice"


@dataclass(frozen=True)
class State:
    """`answered`: digest of each case's answer since the last restart; `void`: why a case does not count.

    `begun`: cases with a started and unfinished process. `source`: digest of the source that
    answers, as sealed or as restarted; `ran`: whether a run has begun. `until`: no case begins after this time (UTC),
    stated before the first answer.
    """

    root: str
    source: str
    ran: bool = False
    until: str | None = None
    answered: Mapping[str, str] = field(default_factory=dict)
    begun: frozenset[str] = frozenset()
    void: Mapping[str, str] = field(default_factory=dict)
    restarts: int = 0
    interrupted: int = 0
    opened: str | None = None


def state_of(entries: Iterable[Entry], where: str) -> State:
    """Replay a ledger.

    Raises:
        InputError: it does not begin with the seal.
    """
    entries = list(entries)
    if not entries or entries[0].step != "sealed":
        raise InputError(f"{where}: its ledger does not begin with the seal; seal a new proof")
    source, ran, until, opened = str(entries[0].details["source"]), False, None, None
    answered: dict[str, str] = {}
    void: dict[str, str] = {}
    begun: set[str] = set()
    restarts = interrupted = 0
    for e in entries[1:]:
        case = str(e.details.get("case", ""))
        if e.step == "run":
            until = until if ran else e.details.get("until")
            source, ran = str(e.details["source"]), True
        elif e.step == "started":
            begun.add(case)
        elif e.step == "interrupted":
            begun.discard(case)
            interrupted += 1
        elif e.step == "answered":
            begun.discard(case)
            if opened is not None:
                void.setdefault(case, LATE)
            elif case in answered:
                void[case] = TWICE
            answered.setdefault(case, str(e.details["answer"]))
        elif e.step == "void":
            void.setdefault(case, str(e.details["why"]))
        elif e.step == "restarted":
            answered, void, begun, restarts = {}, {}, set(), restarts + 1
        elif e.step == "opened" and opened is None:
            opened = e.at
    root = str(entries[0].details["root"])
    return State(root, source, ran, until, answered, frozenset(begun), void, restarts, interrupted, opened)
