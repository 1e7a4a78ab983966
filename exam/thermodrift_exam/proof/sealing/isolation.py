"""Isolation of a process: it can read the interpreter, the libraries, the source of the diagnosis and one folder only.

Two layers. Landlock (Linux 5.13; Salaün, "Landlock: unprivileged access control", kernel documentation) confines the
process in the kernel, including root and native code, and cannot be lifted. Python's audit hook works on every system;
it stops Python code and reports refusals, but native code can bypass it. Only the standard library and the name of a
package are imported here, since isolation precedes every other import.
"""

from __future__ import annotations

import ctypes
import os
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import data  # found before the walls stand, since the folder around it cannot be listed behind them

# linux/landlock.h; the system calls have these numbers on every architecture.
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
PATH_BENEATH, VERSION, NO_NEW_PRIVILEGES = 1, 1, 38
READ_FILE, READ_DIR = 1 << 2, 1 << 3
OF_FILES = 1 << 0 | 1 << 1 | READ_FILE | 1 << 14 | 1 << 15  # execute, write, read, truncate, ioctl
RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}  # by version, how many rights on files it knows; later ones 16

SYSTEM = (
    "/usr/lib", "/usr/lib64", "/usr/local/lib", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime",
    "/usr/share/zoneinfo", "/dev/null", "/dev/zero", "/dev/urandom", "/dev/random", "/proc/self", "/proc/cpuinfo",
    "/proc/meminfo", "/sys/devices/system/cpu",
)  # fmt: skip
# What an answering process may read of the product and of this package: not the plants, which draw cases, nor the
# scoring.
PRODUCT = ("data", "twin", "diagnosis")
OWN = (
    "__init__.py", "proof/__init__.py", "proof/sealing/__init__.py", "proof/sealing/examinee.py",
    "proof/sealing/isolation.py", "proof/sealing/plain.py",
)  # fmt: skip
DENIED = ("socket.", "subprocess.", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "os.system", "pty.", "os.kill")
CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "os.chmod")


@dataclass(frozen=True)
class Allowed:
    """Folders and files: `read` whole, `listed` only by the names in them, `write` also to change."""

    read: tuple[Path, ...]
    listed: tuple[Path, ...] = ()
    write: tuple[Path, ...] = ()

    def covers(self, path: Path) -> Path | None:
        """The readable folder that contains a path, None if there is none."""
        path = path.resolve()
        return next((p for p in (*self.read, *self.listed, *self.write) if path.is_relative_to(p)), None)


def roots() -> tuple[Path, Path]:
    """The folders that the product and this package are imported from, which may be one."""
    return Path(data.__file__).resolve().parents[1], Path(__file__).resolve().parents[3]


def own_source() -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """What an answering process may read below each of the `roots`."""
    product, own = roots()
    return tuple(product / name for name in PRODUCT), tuple(own / "thermodrift_exam" / name for name in OWN)


def allowed(place: Path | None = None, import_from: Iterable[Path] = ()) -> Allowed:
    """What an answering process may read; `place` is its own folder, with `case` to read and `answer` to write.

    `import_from` are further packages, or folders of modules; of what lies next to a package only the names are seen.
    """
    product, own = own_source()
    import_from = list(import_from)
    parents = [p.resolve().parent for p in import_from if is_package(p)]
    case = () if place is None else (place / "case",)
    libraries = {sysconfig.get_path(k) for k in ("stdlib", "platstdlib", "purelib", "platlib")}
    system = [*SYSTEM, *sorted(libraries), f"{sys.base_prefix}/lib", *map(str, import_from)]
    read = dict.fromkeys(Path(p).resolve() for p in (*system, *product, *own, *case) if Path(p).exists())
    write = () if place is None else ((place / "answer").resolve(),)
    # Names alone, so that `plain` is found; the packages around it are imported before the walls stand.
    return Allowed(tuple(read), (Path(__file__).resolve().parent, *parents), write)


def is_package(folder: Path) -> bool:
    """Whether a folder is imported itself, and not the modules in it."""
    return (folder / "__init__.py").is_file()


def confine(to: Allowed, witness: Path) -> str:
    """Isolate this process with both layers, irrevocably.

    `witness` is a readable file outside, which verifies that the kernel refuses access.
    Returns which protection holds: "landlock and audit hook" or "audit hook".
    """
    landlocked = _landlock(to)
    refused = not _native_read(witness)
    sys.addaudithook(audit_hook(to))
    return "landlock and audit hook" if landlocked and refused else "audit hook"


def audit_hook(to: Allowed) -> Any:
    """Raises PermissionError for forbidden access; an audit hook cannot be removed."""
    read = tuple(str(p) for p in (*to.read, *to.write))
    listed = (*read, *(str(p) for p in to.listed))
    write = tuple(str(p) for p in to.write)

    def inside(path: Any, roots: Sequence[str]) -> bool:
        if isinstance(path, int):
            return True  # a file that is open already
        if path is None:
            return False  # the current folder
        real = os.path.realpath(os.fsdecode(path))
        return any(real == root or real.startswith(f"{root}/") for root in roots)

    def hook(event: str, args: tuple[Any, ...]) -> None:
        if event == "open":
            writes = bool(args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)) if isinstance(args[2], int) else False
            roots = (*write, "/dev/null") if writes else read
        elif event in ("os.listdir", "os.scandir"):
            roots = listed
        elif event.startswith(CHANGES):
            roots = write
        elif event.startswith(DENIED):
            raise PermissionError(f"{event}: the answering process may not")
        else:
            return
        for path in args[: 2 if event.startswith(CHANGES) else 1]:  # a renaming has two paths
            if not inside(path, roots):
                raise PermissionError(13, f"{event}: outside of what the answering process may read", str(path))

    return hook


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("network", ctypes.c_uint64), ("scoped", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("rights", ctypes.c_uint64), ("folder", ctypes.c_int32))


def _landlock(to: Allowed) -> bool:
    """Restrict this thread and its children; False where the kernel has no Landlock."""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        version = int(libc.syscall(CREATE_RULESET, None, ctypes.c_size_t(0), VERSION))
    except (OSError, AttributeError):
        return False
    if version < 1:
        return False
    every = (1 << RIGHTS.get(version, 16)) - 1
    ruleset = _Ruleset(every, 0b11 if version >= 4 else 0, 0b11 if version >= 6 else 0)
    size = 8 if version < 4 else 16 if version < 6 else 24
    rules = int(libc.syscall(CREATE_RULESET, ctypes.byref(ruleset), ctypes.c_size_t(size), 0))
    if rules < 0:
        return False
    wanted = [(p, READ_FILE | READ_DIR) for p in to.read] + [(p, READ_DIR) for p in to.listed]
    wanted += [(p, every & ~1) for p in to.write] + [(Path("/dev/null"), READ_FILE | 1 << 1)]
    try:
        for path, rights in wanted:
            folder = os.open(path, os.O_PATH | os.O_CLOEXEC)
            rule = _Beneath(rights if path.is_dir() else rights & OF_FILES & every, folder)
            done = libc.syscall(ADD_RULE, rules, PATH_BENEATH, ctypes.byref(rule), 0)
            os.close(folder)
            if done != 0:
                return False
        if libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0) != 0:
            return False
        return int(libc.syscall(RESTRICT_SELF, rules, 0)) == 0
    finally:
        os.close(rules)


def _native_read(path: Path) -> bool:
    """Whether native code of this process can read a file, past Python's hooks."""
    libc = ctypes.CDLL(None, use_errno=True)
    file = int(libc.open(os.fsencode(path), os.O_RDONLY))
    if file >= 0:
        libc.close(file)
    return file >= 0
