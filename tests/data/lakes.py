"""Small batches for a lake, its files wherever they are, and processes that are killed while they write."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data import lakestore
from data.batch import Batch, Channel
from data.lake import Lake

CALLS = ("replace", "link", "unlink", "fsync", "open", "chmod", "mkdir")


def make(
    batch_id: str = "run1",
    seed: int = 0,
    start: str | None = "2026-03-01 08:00",
    *,
    rows: int = 5,
    machine: str = "vmc",
    **more: object,
) -> Batch:
    values = np.random.default_rng(seed).normal(20.0, 1.0, (rows, 2))
    values[0, 1] = np.nan
    table = pd.DataFrame({"time_s": np.arange(rows) * 60.0, "T1": values[:, 0], "z_um": values[:, 1]})
    channels = {
        "T1": Channel("T1", "temperature", "degC", 0.1, -10.0, 90.0),
        "z_um": Channel("z_um", "error", "um"),
        "rpm": Channel("rpm", "driver", "rpm"),
    }
    when = None if start is None else pd.Timestamp(start)
    batch = Batch(machine, batch_id, table, channels, when, source=f"in/{batch_id}.csv", labels={"speed": 4000})
    return replace(batch, **more)


def same(a: Batch, b: Batch) -> None:
    pd.testing.assert_frame_equal(a.table, b.table, check_exact=True)
    for name in ("machine", "batch_id", "start", "simulated", "repairs", "findings", "labels"):
        assert getattr(a, name) == getattr(b, name), name
    assert list(a.channels.items()) == list(b.channels.items())


def files(lake: Lake) -> dict[str, bytes]:
    """Every file of a lake by its name below the root."""
    if isinstance(root := lake.root, Path):
        return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}
    import obstore

    objects = lakestore._opened(root)
    names = [o["path"] for page in obstore.list(objects) for o in page]
    return {name: bytes(obstore.get(objects, name).bytes()) for name in names}


def plain(lake: Lake) -> set[str]:
    """Batches that a plain reader finds."""
    current = [body for name, body in files(lake).items() if name.startswith("machine=")]
    return {str(b) for body in current for b in pd.read_parquet(io.BytesIO(body))["batch"]}


def overwrite(lake: Lake, name: str, body: bytes | None) -> None:
    """Another program changes a file, or deletes it."""
    if isinstance(root := lake.root, Path):
        (root / name).chmod(0o644)
        (root / name).unlink() if body is None else (root / name).write_bytes(body)
        return
    import obstore

    objects = lakestore._opened(root)
    obstore.delete(objects, name) if body is None else obstore.put(objects, name, body)


def run(function: str, module: str) -> subprocess.Popen[bytes]:
    """A function of a module of this folder in a process of its own."""
    code = f"import tests.data.{module} as t; t.{function}"
    return subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[2])


def die_at(n: int) -> None:
    """Kill this process at the n-th change to a folder: odd n before the system call, even n right after it."""
    count = 0
    os.fsync = lambda fd: None  # a kill does not ask the disk, only a power cut does

    def step() -> None:
        nonlocal count
        count += 1
        if count == n:
            os.kill(os.getpid(), signal.SIGKILL)

    def dying(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any, **kwargs: Any) -> Any:
            step()
            result = call(*args, **kwargs)
            step()
            return result

        return wrapped

    for name in CALLS:
        setattr(os, name, dying(getattr(os, name)))


def crash_everywhere(base: Path, begin: Callable[[Path], object], work: Callable[[Path], object]) -> None:
    """Run in a process of its own: one forked child per point of death, until a child lives to the end."""
    for n in range(1, 500):
        root = base / f"{n:03d}"
        begin(root)
        child = os.fork()
        if child == 0:
            die_at(n)
            work(root)
            os._exit(0)
        if os.waitpid(child, 0)[1] == 0:
            return
