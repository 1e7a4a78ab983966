"""Digests that a proof rests on: of answers with a salt, of folders, of the source that answers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from twin.proof.sealing.isolation import own_source


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
    """SHA-256 over files by their path below `root`; every part with its length, so that no two lists are alike."""
    digest = hashlib.sha256()
    for file in files:
        for part in (file.relative_to(root).as_posix().encode(), file.read_bytes()):
            digest.update(len(part).to_bytes(8, "big") + part)
    return digest.hexdigest()


def source_digest() -> str:
    """SHA-256 over the source that an answering process may read of this package: all that can change an answer."""
    root, parts = own_source()
    files = {f for p in parts for f in ([p] if p.is_file() else p.rglob("*"))}
    return files_digest(root, sorted(f for f in files if f.is_file() and f.suffix != ".pyc"))
