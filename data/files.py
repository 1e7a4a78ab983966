"""Atomic writing of single files and of groups of files, and what a JSON file holds."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

from data.errors import InputError, WorkError


def write_atomic(path: Path, content: str | bytes, private: bool = False) -> None:
    """Put the content (text as UTF-8, lines as they are) at `path` in one step; on failure what stood there stays.

    The folder must exist. `private`: only its owner reads it, where there are such rights.

    Raises:
        OSError: it cannot be written.
    """
    scratch = path.with_name(f".{path.name}.{uuid4().hex}.part")
    try:
        with open(scratch, "wb", opener=lambda name, flags: os.open(name, flags, 0o600 if private else 0o666)) as file:
            file.write(content.encode("utf-8") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)


def from_json(text: str | bytes | bytearray) -> Any:
    """What a JSON text holds.

    Raises:
        ValueError: it is no JSON (json.JSONDecodeError), too deep (the same), or no text (UnicodeDecodeError).
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise json.JSONDecodeError("it is nested too deeply", "", 0) from None


@cache
def source_digest(*rooms: str) -> str:
    """SHA-256 (hex) of the program's source in these rooms (`data`, `twin`, …), for results that are kept."""
    digest = hashlib.sha256()
    root = Path(__file__).parent.parent
    for room in rooms:
        for path in sorted((root / room).rglob("*.py")):
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def check_folder(folder: Path, files: Sequence[Path], overwrite: bool) -> None:
    """Make the folder; nothing else is written.

    Raises:
        InputError: one of the files is there and `overwrite` is not set, or the folder cannot be written.
    """
    if folder.is_file():
        raise InputError(f"--out {folder}: is a file, expected a folder; give another --out")
    for file in files:
        if file.is_dir():
            raise InputError(f"{file}: is a folder, and a file of that name would be written; give another --out")
        if file.exists() and not overwrite:
            raise InputError(f"{file} exists; give another --out, or --overwrite to replace it")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable.part"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written ({error.strerror}); give another folder") from None


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A scratch folder next to `folder`, which gets its name when the block ends well: all or nothing.

    Raises:
        OSError: it cannot be written, or `folder` is there.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    scratch = folder.with_name(f".{folder.name}.{uuid4().hex}.part")
    scratch.mkdir()
    try:
        yield scratch
        scratch.rename(folder)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextmanager
def staged(folder: Path, names: Sequence[str]) -> Iterator[Path]:
    """A scratch folder inside `folder`; when the block ends well, what it holds takes the place of `names` there.

    They move in the order of `names`, each in one step; what was not written is removed, so that nothing of an earlier
    call stays. When the block fails, `folder` is as it was.

    Raises:
        WorkError: the files cannot be written.
    """
    scratch = folder / f".{uuid4().hex}.part"
    try:
        scratch.mkdir()
        yield scratch
        written = {p.name for p in scratch.iterdir()}
        if written - set(names):
            raise ValueError(f"{sorted(written - set(names))}: not among the names of this folder")
        for name in names:
            if name in written:
                (scratch / name).replace(folder / name)
            else:
                (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise WorkError(f"{folder}: cannot be written ({error}); give another --out") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
