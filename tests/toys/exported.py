"""Models of several forms to be exported, and the C of an export, compiled."""

from __future__ import annotations

import _ctypes
import ctypes
import shutil
import subprocess
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from compensation.exports import EXPORTS
from compensation.exports.base import Export, ExportedAxis
from compensation.safety import Limits
from data.batch import Channel
from models.program import Builder

DIGEST = "0123456789abcdef" * 4
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2", "-fsanitize=undefined", "-fno-sanitize-recover")
LIMITS = Limits(max_offset_um=40.0, rate_um_per_s=0.02, step_um=6.0, hold_s=900.0, stale_s=900.0, warm_up_s=0.0)


def straight(region: Mapping[str, tuple[float, float]] | None = None) -> ExportedAxis:
    """3 (t0 − t0 first) − 2 t1 + 1.5, and with a slope of 0.01 (t0 − t0 first) along y."""
    known = {n: Channel(n, "temperature", "degC") for n in ("t0", "t1")}
    b = Builder(known, 300.0)
    x = b.channels(["t0", "t1"])
    rise = b.since_first(b.pick(x, [0]))
    error = b.affine(b.join(rise, b.pick(x, [1])), np.array([[3.0, -2.0]]), 1.5)
    program = b.program([error, b.affine(rise, np.array([[0.01]]))], False, "y", 100.0)
    trained = {"t0": (10.0, 30.0), "t1": (15.0, 25.0), "y": (0.0, 500.0)} if region is None else region
    return ExportedAxis("y", program, trained, LIMITS)


def offset_only() -> ExportedAxis:
    """The same without a slope."""
    a = straight()
    program = replace(a.program, outputs=a.program.outputs[:1], along="", reference_mm=0.0)
    return replace(a, program=program)


def lagged() -> ExportedAxis:
    """2 × the rise of t0 behind a first-order lag of 20 min."""
    b = Builder({"t0": Channel("t0", "temperature", "degC")}, 300.0)
    late = b.lags(b.since_first(b.channels(["t0"])), [1200.0], 0.0)
    return ExportedAxis("x", b.program([b.affine(late, np.array([[2.0]]))], False), {"t0": (10.0, 30.0)}, LIMITS)


def export_of(*axes: ExportedAxis, machine: str = "mill 1", simulated: bool = True) -> Export:
    return Export(machine, "champion@production", "v7", DIGEST, "2026-01-02T03:04:05Z", simulated, axes)


@cache
def compiled(files: tuple[tuple[str, bytes], ...]) -> bytes:
    """A library of these files, one of which is C; gcc takes most of a second."""
    with TemporaryDirectory() as folder:
        for name, content in files:
            (Path(folder) / name).write_bytes(content)
        (source,) = (name for name, _ in files if name.endswith(".c"))
        command = ["gcc", *FLAGS, "-shared", "-fPIC", "-o", "library.so", source, "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        assert done.returncode == 0, done.stderr
        return (Path(folder) / "library.so").read_bytes()


class C:
    """The compiled source of an export: each is loaded from a file of its own, and so has a state of its own."""

    def __init__(self, export: Export, key: str, folder: Path) -> None:
        library = folder / f"{key}.so"
        library.unlink(missing_ok=True)  # one that is loaded must not change
        library.write_bytes(compiled(tuple((p.name, p.read_bytes()) for p in EXPORTS[key]().write(export, folder))))
        self.library, self.stem, self.n = ctypes.CDLL(str(library)), export.stem, len(export.axes)

    def call(self, name: str, *args: object) -> int:
        made = [a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray) else a for a in args]
        return int(getattr(self.library, f"{self.stem}_{name}")(*made))

    def copy(self, folder: Path) -> C:
        """The same program with a memory of its own; one library is loaded once."""
        other = copy(self)
        other.library = ctypes.CDLL(str(shutil.copy(self.library._name, folder)))
        return other

    def restart(self) -> None:
        """The control is switched off and on: what is static is as at first."""
        path = self.library._name
        _ctypes.dlclose(self.library._handle)
        self.library = ctypes.CDLL(path)
