"""A small machine with a known law, for tests that need several batches."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pandas as pd
import pytest

import data.ingest
from data.batch import Batch, Channel


def make_toy_batches(
    k: int = 6, n: int = 60, noise_um: float = 0.5, seed: int = 0, sensors: int = 5, step_s: float = 300.0
) -> list[Batch]:
    """K batches: sensors follow the load and the room with different time constants; z = 3·a − 2·b + noise, x = b."""
    rng = np.random.default_rng(seed)
    names = [f"t{i}" for i in range(sensors)]
    channels = {name: Channel(name, "temperature", "degC", 0.1, -20.0, 100.0) for name in names}
    channels["room"] = Channel("room", "ambient", "degC", 0.1, -20.0, 60.0)
    channels["spindle_rpm"] = Channel("spindle_rpm", "driver", "rpm", 1.0, 0.0, 8000.0)
    channels["z"] = Channel("z", "error", "um", 1.0, -500.0, 500.0)
    channels["x"] = Channel("x", "error", "um", 1.0, -500.0, 500.0)
    time_s = np.arange(n) * step_s
    batches = []
    for i in range(k):
        rpm = [2000.0, 4000.0, 6000.0][i % 3]
        ambient = 5.0 + 25.0 * i / max(1, k - 1)
        room = ambient + rng.uniform(-1, 4) * time_s / time_s[-1]
        table = {"time_s": time_s, "room": room, "spindle_rpm": np.full(n, rpm)}
        for j, name in enumerate(names):
            tau_s = 1200.0 * (1 + j)
            rise = (6.0 - j) * rpm / 2000 * (1 - np.exp(-time_s / tau_s)) + 0.3 * j * (room - ambient)
            table[name] = ambient + rise + 0.02 * rng.standard_normal(n)
        a, b = table["t0"] - table["t0"][0], table[f"t{sensors - 1}"] - table[f"t{sensors - 1}"][0]
        table["z"] = 3.0 * a - 2.0 * b + noise_um * rng.standard_normal(n)
        table["x"] = b + noise_um * rng.standard_normal(n)
        frame = pd.DataFrame({c: table[c] for c in ["time_s", *channels]})
        start = pd.Timestamp("2025-01-10 08:00") + pd.Timedelta(days=30 * i)
        batches.append(
            Batch("toy", f"b{i:02d}", frame, channels, start=start, source=f"b{i:02d}.csv", digest=f"{i:064x}")
        )
    return batches


@pytest.fixture(scope="session")
def toy_batches() -> Callable[..., list[Batch]]:
    return make_toy_batches


@pytest.fixture(scope="session", autouse=True)
def quick_looks() -> Iterator[None]:
    """Every recording of a test was written a moment ago; do not wait for a second look at it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(data.ingest, "LOOK_AGAIN_S", 0.0)
        yield


@pytest.fixture(scope="session", autouse=True)
def quick_disk() -> Iterator[None]:
    """Nothing waits for the disk, which takes tens of ms on a busy computer; no test cuts the power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda fd: None)
        yield


@pytest.fixture(scope="session")
def copied_stores(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """From its first use on, a home that a test makes in this process gets a copy of one empty store."""
    from tests.toys import empty_store

    with empty_store.quick_commits(), empty_store.copied_stores(empty_store.empty_store(tmp_path_factory)):
        yield


TOGETHER = {
    # one of Prefect's servers, which takes half a minute to start
    "tests/pipelines": ("flows", "diagnosis_flow", "retraining"),
    # fits of the same small machines
    "tests/diagnosis": (
        "balance", "conclude", "diagnose", "fitted", "limits", "machine_size", "search", "swapped_labels",
    ),
}  # fmt: skip


def pytest_runtest_setup() -> None:
    """Where two threads log models at once, MLflow leaves a stand-in for a module without a file; Hypothesis reads the
    file of every module."""
    sys.modules.pop("dbutils", None)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With --dist loadfile the files of TOGETHER share a process with those of their folder."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class OneProcess(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            folder, _, name = file.rpartition("/test_")
            return folder if name.removesuffix(".py") in TOGETHER.get(folder, ()) else file

    return OneProcess(config, log)
