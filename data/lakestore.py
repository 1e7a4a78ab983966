"""Where a lake's files are: in a folder of this computer, or on any file system that fsspec reaches.

Files have names relative to the root, with slashes. A write is complete or absent, whenever the process ends: in a
folder by a rename, in an object store because a put is, elsewhere by a move.
"""

from __future__ import annotations

import filecmp
import json
import os
import re
import shutil
import socket
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

from filelock import FileLock, Timeout

from data.errors import InputError

LOCK_WAIT_S = 600.0  # for another writer
RENEWED_S = 15.0  # between two signs of life of the holder of a remote lock
DEAD_S = 120.0  # without one, the holder is taken to have ended
POLL_S = 0.5  # between two looks at a remote lock
PUT_IS_ATOMIC = {"s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "oss", "memory"}
_PACKAGES = {"s3": "thermodrift[s3]", "s3a": "thermodrift[s3]"}
_TMP = "_tmp"


class Locked(Exception):
    """Another writer holds the lake for longer than `LOCK_WAIT_S`."""


class Store(Protocol):
    """Files below one root. What cannot be done raises OSError."""

    name: str  # as messages have it, without secrets

    def read(self, file: str) -> bytes:
        """The content; raises FileNotFoundError where there is none."""

    def read_many(self, files: Sequence[str]) -> Iterable[bytes | OSError]:
        """The contents, in the files' order, or why one cannot be read."""

    def exists(self, file: str) -> bool: ...

    def size(self, file: str) -> int:
        """In bytes; 0 where there is no such file."""

    def stamp(self, file: str) -> Hashable:
        """Changes whenever the file does; None where there is none."""

    def files(self, folder: str) -> list[str]:
        """Names of the files in a folder, sorted; empty for none."""

    def write(self, file: str, body: Any, keep: bool = True, private: bool = False) -> None:
        """Put bytes, or the copy of a file of this computer, there in one step.

        `keep`: nobody is to write it again; `private`: only its owner reads it, where there are such rights.
        """

    def repeat(self, file: str, source: str) -> bool:
        """Make `file` hold what the file `source` holds, in one step; False where it does already."""

    def move(self, file: str, target: str) -> None: ...

    def delete(self, file: str) -> None:
        """Delete a file, where there is one, and the folders that it leaves empty."""

    def settle(self, files: Iterable[str]) -> None:
        """Make renames of these files survive a power cut."""

    def path(self, file: str) -> Path:
        """Where it is on this computer; below the root, where the root is elsewhere."""

    def locked(self) -> Any:
        """A context that one writer at a time is in; raises Locked."""


class Folder:
    """A folder of this computer, made by the first write."""

    def __init__(self, root: Path) -> None:
        self.root, self.name = root, str(root)
        self._lock = FileLock(root / ".lock", timeout=LOCK_WAIT_S)

    def read(self, file: str) -> bytes:
        return (self.root / file).read_bytes()

    def read_many(self, files: Sequence[str]) -> Iterator[bytes | OSError]:
        for file in files:  # one at a time in memory
            try:
                yield self.read(file)
            except OSError as error:
                yield error

    def exists(self, file: str) -> bool:
        return (self.root / file).exists()

    def size(self, file: str) -> int:
        path = self.root / file
        return path.stat().st_size if path.exists() else 0

    def stamp(self, file: str) -> Hashable:
        try:
            seen = (self.root / file).stat()
        except OSError:
            return None
        return seen.st_ino, seen.st_size, seen.st_mtime_ns

    def files(self, folder: str) -> list[str]:
        path = self.root / folder
        return sorted(p.name for p in path.iterdir() if p.is_file()) if path.is_dir() else []

    def write(self, file: str, body: Any, keep: bool = True, private: bool = False) -> None:
        target, temporary = self.root / file, self.root / _TMP / "next"
        target.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(body, Path):
            with body.open("rb") as a, temporary.open("wb") as b:  # bytes alone, in bounded memory
                shutil.copyfileobj(a, b, 1 << 20)
        else:
            temporary.write_bytes(body)
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        if private:
            temporary.chmod(0o600)
        elif keep:
            temporary.chmod(0o444)
        temporary.replace(target)
        _sync(target.parent)

    def repeat(self, file: str, source: str) -> bool:
        target, version = self.root / file, self.root / source
        if target.exists() and (target.samefile(version) or filecmp.cmp(target, version, shallow=False)):
            return False
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = self.root / _TMP / "current"
        temporary.unlink(missing_ok=True)
        try:
            os.link(version, temporary)
        except OSError:  # a file system without hard links
            shutil.copyfile(version, temporary)
        temporary.replace(target)
        return True

    def move(self, file: str, target: str) -> None:
        (self.root / target).parent.mkdir(parents=True, exist_ok=True)
        (self.root / file).replace(self.root / target)

    def delete(self, file: str) -> None:
        path = self.root / file
        path.unlink(missing_ok=True)
        for folder in path.parents:
            if folder == self.root or not folder.exists() or any(folder.iterdir()):
                break
            folder.rmdir()

    def settle(self, files: Iterable[str]) -> None:
        for folder in {(self.root / file).parent for file in files}:
            _sync(folder)

    def path(self, file: str) -> Path:
        return self.root / file

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Also removes the files of an interrupted writer."""
        (self.root / _TMP).mkdir(parents=True, exist_ok=True)
        try:
            with self._lock:
                for leftover in (self.root / _TMP).iterdir():
                    leftover.unlink()
                yield
        except Timeout:
            raise Locked from None


class Remote:
    """A place on a file system of fsspec; addresses such as s3://bucket/lake, credentials as that system takes them.

    The lock is an object, `_lock`, that only one writer can create. Its holder renews it; one that is not renewed for
    `DEAD_S`, by the waiter's own clock, is removed. A holder that was taken for dead notices before it writes.
    """

    def __init__(self, address: str) -> None:
        self.name = re.sub(r"(://[^:/@]*):.*@", r"\1:***@", address)
        protocol = address.partition("://")[0]
        try:
            import fsspec

            # Without a cache of listings: what another computer wrote must be seen.
            self._fs, self._root = fsspec.url_to_fs(address, use_listings_cache=False)
        except ImportError as error:
            install = f"run pip install {_PACKAGES[protocol]!r}" if protocol in _PACKAGES else str(error)
            raise InputError(f"lake {self.name}: the file system {protocol} is not installed; {install}") from None
        except ValueError as error:
            raise InputError(
                f"lake {self.name}: got {protocol}://, which is no file system that fsspec knows ({error}); expected a "
                "folder or an address such as s3://bucket/lake"
            ) from None
        self._atomic = protocol in PUT_IS_ATOMIC
        self._mine = b""
        self._lost = threading.Event()

    def read(self, file: str) -> bytes:
        body: bytes = self._do(self._fs.cat_file, self._at(file))
        return body

    def read_many(self, files: Sequence[str]) -> list[bytes | OSError]:
        """All at once, since most of the time is waiting."""
        paths = [self._at(f) for f in files]
        found = self._do(self._fs.cat, paths, on_error="return") if paths else {}
        bodies = [found.get(p, FileNotFoundError(p)) for p in paths]
        return [b if isinstance(b, bytes | OSError) else OSError(str(b)) for b in bodies]

    def exists(self, file: str) -> bool:
        return bool(self._do(self._fs.exists, self._at(file)))

    def size(self, file: str) -> int:
        try:
            return int(self._do(self._fs.info, self._at(file))["size"] or 0)
        except FileNotFoundError:
            return 0

    def stamp(self, file: str) -> Hashable:
        try:
            stamp: str = self._do(self._fs.ukey, self._at(file))
        except OSError:
            return None
        return stamp

    def files(self, folder: str) -> list[str]:
        try:
            found = self._do(self._fs.ls, self._at(folder), detail=True)
        except FileNotFoundError:
            return []
        return sorted(str(f["name"]).rpartition("/")[2] for f in found if f["type"] == "file")

    def write(self, file: str, body: Any, keep: bool = True, private: bool = False) -> None:
        self._check_held()
        at = self._at(file) if self._atomic else self._at(f"{_TMP}/{uuid4().hex}")
        if not self._atomic:
            self._do(self._fs.makedirs, at.rpartition("/")[0], exist_ok=True)
        if isinstance(body, Path):
            self._do(self._fs.put_file, str(body), at)
        else:
            self._do(self._fs.pipe_file, at, bytes(body))
        if not self._atomic:
            self._do(self._fs.makedirs, self._at(file).rpartition("/")[0], exist_ok=True)
            self._do(self._fs.mv, at, self._at(file))

    def repeat(self, file: str, source: str) -> bool:
        a, b = self._info(file), self._info(source)
        same_tag = a.get("ETag") is not None and a.get("ETag") == b.get("ETag")
        if a and a["size"] == b.get("size") and (same_tag or self.read(file) == self.read(source)):
            return False
        self.write(file, self.read(source))
        return True

    def move(self, file: str, target: str) -> None:
        self.repeat(target, file)
        self.delete(file)

    def delete(self, file: str) -> None:
        self._check_held()
        with suppress(FileNotFoundError):
            self._do(self._fs.rm_file, self._at(file))

    def settle(self, files: Iterable[str]) -> None:
        pass

    def path(self, file: str) -> Path:
        return Path(file)

    @contextmanager
    def locked(self) -> Iterator[None]:
        token = {"host": socket.gethostname(), "process": os.getpid(), "id": uuid4().hex}
        self._acquire(token)
        self._lost.clear()
        ended = threading.Event()
        keeper = threading.Thread(target=self._renew, args=(token, ended), name="lake lock", daemon=True)
        keeper.start()
        try:
            yield
        finally:
            ended.set()
            keeper.join()
            mine, self._mine = self._mine, b""
            if self._lock_content() == mine:
                self._do(self._fs.rm_file, self._at("_lock"))

    def _acquire(self, token: dict[str, Any]) -> None:
        start_s = seen_s = time.monotonic()
        seen: bytes | None = None
        while True:
            body = json.dumps({**token, "renewed": 0}).encode()
            try:
                self._do(self._fs.pipe_file, self._at("_lock"), body, mode="create")
                self._mine = body
                return
            except FileExistsError:
                pass
            now_s, there = time.monotonic(), self._lock_content()
            if there != seen:
                seen, seen_s = there, now_s
            elif there is not None and now_s - seen_s > DEAD_S:
                self._do(self._fs.rm_file, self._at("_lock"))
            if now_s - start_s > LOCK_WAIT_S:
                raise Locked
            time.sleep(POLL_S)

    def _renew(self, token: dict[str, Any], ended: threading.Event) -> None:
        n = 0
        while not ended.wait(RENEWED_S):
            n += 1
            body = json.dumps({**token, "renewed": n}).encode()
            try:
                if self._lock_content() != self._mine:
                    self._lost.set()
                    return
                self._do(self._fs.pipe_file, self._at("_lock"), body)
                self._mine = body
            except OSError:
                continue  # the next write finds out whether the lock is still there

    def _check_held(self) -> None:
        if self._lost.is_set() or not self._mine:
            raise OSError("the lock of this lake was lost to another writer, since this one did not answer for long")

    def _lock_content(self) -> bytes | None:
        try:
            return self.read("_lock")
        except FileNotFoundError:
            return None

    def _info(self, file: str) -> dict[str, Any]:
        try:
            found: dict[str, Any] = self._do(self._fs.info, self._at(file))
            return found
        except FileNotFoundError:
            return {}

    def _at(self, file: str) -> str:
        return f"{self._root.rstrip('/')}/{file}"

    def _do(self, call: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """A call, whose errors of whatever library are OSErrors in one line."""
        try:
            return call(*args, **options)
        except OSError:
            raise
        except Exception as error:
            raise OSError(f"{type(error).__name__}: {' '.join(str(error).split())}") from None


def open_store(root: Path | str) -> Store:
    """The store of a lake's root: a folder, ``file://…`` or an address of fsspec.

    Raises:
        InputError: a file system that is unknown or not installed.
    """
    text = str(root)
    if text.startswith("file://"):
        return Folder(Path(text.removeprefix("file://")))
    return Remote(text) if "://" in text else Folder(Path(root))


def _sync(folder: Path) -> None:
    """Make a rename in this folder durable; a system that cannot open folders does it on its own."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
