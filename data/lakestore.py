"""Where a lake's files are: in a folder of this computer, or in an object store.

Files have names relative to the root, with slashes. A write is complete or absent, whenever the process ends: in a
folder by a rename, in an object store because a put is. What several writers change, they change one after another: in
a folder under a lock, in an object store by a put that succeeds only where the object is as it was read.
"""

from __future__ import annotations

import filecmp
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from data.errors import InputError, masked

LOCK_WAIT_S = 600.0  # for another writer
ANSWER_S = 10.0  # for an object store to answer at all
REQUEST_S = 300.0  # for one request to end: a large file over a slow line
AT_ONCE = 16  # reads of an object store
_INSTALL = "pip install 'thermodrift[s3]'"
_TMP = "_tmp"
Stamp = tuple[tuple[str, Any], ...] | None  # state of a file; None where there is none


class Locked(Exception):
    """Another writer holds the lake for longer than `LOCK_WAIT_S`."""


class Folder:
    """A folder of this computer, made by the first write. What cannot be done raises OSError."""

    exclusive = True  # within `locked` nobody else writes

    def __init__(self, root: Path) -> None:
        self.root, self.name = root, str(root)  # the name as messages have it, without secrets
        self._lock = FileLock(root / ".lock", timeout=LOCK_WAIT_S)

    def read(self, file: str) -> bytes:
        """The content; raises FileNotFoundError where there is none."""
        return (self.root / file).read_bytes()

    def read_many(self, files: Sequence[str]) -> Iterator[bytes | OSError]:
        """The contents, in the files' order, or why one cannot be read."""
        for file in files:  # one at a time in memory
            try:
                yield self.read(file)
            except OSError as error:
                yield error

    def read_stamped(self, file: str) -> tuple[bytes | None, Stamp]:
        """The content and the state that it is of, see `swap`; None where there is no such file."""
        try:
            return self.read(file), self.stamp(file)
        except FileNotFoundError:
            return None, None

    def exists(self, file: str) -> bool:
        return (self.root / file).exists()

    def size(self, file: str) -> int:
        """In bytes; 0 where there is no such file."""
        path = self.root / file
        return path.stat().st_size if path.exists() else 0

    def stamp(self, file: str) -> Stamp:
        """Changes whenever the file does; None where there is none."""
        try:
            seen = (self.root / file).stat()
        except OSError:
            return None
        return ("inode", seen.st_ino), ("size", seen.st_size), ("mtime_ns", seen.st_mtime_ns)

    def files(self, folder: str) -> list[str]:
        """Names of the files in a folder, sorted; empty for none."""
        path = self.root / folder
        return sorted(p.name for p in path.iterdir() if p.is_file()) if path.is_dir() else []

    def write(self, file: str, body: Any, keep: bool = True, private: bool = False) -> None:
        """Put bytes, or the copy of a file of this computer, there in one step.

        `keep`: nobody is to write it again; `private`: only its owner reads it, where there are such rights.
        """
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

    def swap(self, file: str, body: bytes, stamp: Stamp, private: bool = False) -> bool:
        """Put bytes there unless the file is no longer as it was read, within `locked`; False where it is not."""
        self.write(file, body, keep=False, private=private)
        return True

    def repeat(self, file: str, source: str) -> bool:
        """Make `file` hold what the file `source` holds, in one step; False where it does already."""
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
        """Delete a file, where there is one, and the folders that it leaves empty."""
        path = self.root / file
        path.unlink(missing_ok=True)
        for folder in path.parents:
            if folder == self.root or not folder.exists() or any(folder.iterdir()):
                break
            folder.rmdir()

    def settle(self, files: Iterable[str]) -> None:
        """Make renames of these files survive a power cut."""
        for folder in {(self.root / file).parent for file in files}:
            _sync(folder)

    def path(self, file: str) -> Path:
        """Where it is on this computer; below the root, where the root is elsewhere."""
        return self.root / file

    @contextmanager
    def locked(self) -> Iterator[None]:
        """A context that one writer at a time is in, where the place is `exclusive`; raises Locked. Also removes the
        files of an interrupted writer."""
        (self.root / _TMP).mkdir(parents=True, exist_ok=True)
        try:
            with self._lock:
                for leftover in (self.root / _TMP).iterdir():
                    leftover.unlink()
                yield
        except Timeout:
            raise Locked from None


class Bucket:
    """Objects below an address that obstore reaches (``s3://``, ``gs://``, ``az://``), with its variables and, for S3,
    the credentials that boto3 finds; methods as of `Folder`. No lock: what two writers may change is put only where
    nobody else has."""

    exclusive = False

    def __init__(self, address: str) -> None:
        self.name = masked(address)
        try:
            self._objects = _opened(address)
        except ImportError:
            raise InputError(f"lake {self.name}: obstore is not installed; run {_INSTALL}") from None
        except Exception as error:  # obstore's own, of no common class with a meaning
            raise InputError(
                f"lake {self.name}: no place that obstore knows ({_first_line(error)}); expected a folder or "
                "an address such as s3://bucket/lake"
            ) from None

    def read(self, file: str) -> bytes:
        return bytes(self._do("get", file).bytes())

    def read_many(self, files: Sequence[str]) -> list[bytes | OSError]:
        """All at once, since most of the time is waiting."""

        def read(file: str) -> bytes | OSError:
            try:
                return self.read(file)
            except OSError as error:
                return error

        with ThreadPoolExecutor(AT_ONCE) as pool:
            return list(pool.map(read, files))

    def read_stamped(self, file: str) -> tuple[bytes | None, Stamp]:
        try:
            found = self._do("get", file)
            return bytes(found.bytes()), _stamp(found.meta)
        except FileNotFoundError:
            return None, None

    def exists(self, file: str) -> bool:
        return self.stamp(file) is not None

    def size(self, file: str) -> int:
        return int(self._head(file).get("size", 0))

    def stamp(self, file: str) -> Stamp:
        found = self._head(file)
        return _stamp(found) if found else None

    def files(self, folder: str) -> list[str]:
        found = self._do("list_with_delimiter", folder)["objects"]
        return sorted(str(f["path"]).rpartition("/")[2] for f in found)

    def write(self, file: str, body: Any, keep: bool = True, private: bool = False) -> None:
        self._do("put", file, body if isinstance(body, Path) else bytes(body))

    def swap(self, file: str, body: bytes, stamp: Stamp, private: bool = False) -> bool:
        import obstore.exceptions

        mode = "create" if stamp is None else {k: v for k, v in stamp if v is not None}
        try:
            self._do("put", file, body, mode=mode)
        except (obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError, FileNotFoundError):
            return False
        return True

    def repeat(self, file: str, source: str) -> bool:
        there, wanted = self._head(file), self._head(source)
        if there and (there["e_tag"], there["size"]) == (wanted.get("e_tag"), wanted.get("size")):
            return False
        self._do("copy", source, file)
        return True

    def move(self, file: str, target: str) -> None:
        self._do("rename", file, target)

    def delete(self, file: str) -> None:
        with suppress(FileNotFoundError):
            self._do("delete", file)

    def settle(self, files: Iterable[str]) -> None:
        pass

    def path(self, file: str) -> Path:
        return Path(file)

    def locked(self) -> AbstractContextManager[None]:
        return nullcontext()

    def _head(self, file: str) -> dict[str, Any]:
        try:
            found: dict[str, Any] = self._do("head", file)
            return found
        except FileNotFoundError:
            return {}

    def _do(self, call: str, *args: Any, **options: Any) -> Any:
        """A call of obstore, whose errors become OSErrors in one line; that another was quicker stays as it is."""
        import obstore
        import obstore.exceptions

        try:
            return getattr(obstore, call)(self._objects, *args, **options)
        except FileNotFoundError as error:
            raise FileNotFoundError(_first_line(error)) from None
        except (OSError, obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError):
            raise
        except Exception as error:
            raise OSError(_first_line(error)) from None


Store = Folder | Bucket


@cache
def _opened(address: str) -> Any:
    """One store per address and process: its connections are used again."""
    from obstore.store import from_url

    scheme = address.partition("://")[0]
    if scheme == "memory":
        return from_url("memory:///")
    options: dict[str, Any] = {
        "retry_config": {"max_retries": 3, "retry_timeout": timedelta(seconds=ANSWER_S)},
        "client_options": {"connect_timeout": timedelta(seconds=ANSWER_S), "timeout": timedelta(seconds=REQUEST_S)},
    }
    if os.environ.get("AWS_ENDPOINT_URL", "").startswith("http:"):
        options["client_options"]["allow_http"] = True
    if scheme in ("s3", "s3a") and not os.environ.get("AWS_ACCESS_KEY_ID"):
        with suppress(ImportError, ValueError):  # without boto3's, those of the environment and the instance
            from obstore.auth.boto3 import Boto3CredentialProvider

            options["credential_provider"] = Boto3CredentialProvider()
    return from_url(address, **options)


def _stamp(meta: Any) -> Stamp:
    return tuple((k, meta.get(k)) for k in ("e_tag", "version"))


def _first_line(error: Exception) -> str:
    return masked((str(error).splitlines() or [type(error).__name__])[0])


def open_store(root: Path | str) -> Store:
    """The store of a lake's root: a folder, ``file://…`` or an address of obstore.

    Raises:
        InputError: an address that is unknown, or whose package is not installed.
    """
    text = str(root)
    if text.startswith("file://"):
        return Folder(Path(text.removeprefix("file://")))
    return Bucket(text) if "://" in text else Folder(Path(root))


def _sync(folder: Path) -> None:
    """Make a rename in this folder durable; a system that cannot open folders does it on its own."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
