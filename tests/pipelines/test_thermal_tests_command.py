"""`thermodrift report --iso`: every recording judged as a thermal test, and one line where something is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

from data.batch import Batch
from data.errors import InputError
from data.lake import Lake
from data.lakefile import content_digest, encode
from data.machine import load_machine
from pipelines.commands.report import write_thermal_tests
from tests.toys.command import Call, in_process
from tests.twin.machines import TWO_BODIES


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Call:
    """`thermodrift ARGS` in this process, in an empty folder, with a lake of its own."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    return in_process(monkeypatch, capsys)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A machine file of two bodies in a room."""
    path = tmp_path / "two.yml"
    path.write_text(yaml.safe_dump(TWO_BODIES, sort_keys=False))
    return path


def recorded(machine: Path) -> Batch:
    """Five minutes at rest, then the spindle runs for 15."""
    read = load_machine(machine)
    time_s = 60.0 * np.arange(21)
    warm = np.maximum(time_s - 300.0, 0.0) / 900.0
    table = pd.DataFrame({
        "time_s": time_s, "t_shaft": np.round(21.0 + 2.0 * warm, 1), "t_head": np.round(21.0 + 0.5 * warm, 1),
        "room": 21.0 + 0.1 * (np.arange(21) % 2), "rpm": np.where(time_s >= 300.0, 3000.0, 0.0),
        "z": np.round(8.0 * warm),
    })  # fmt: skip
    return Batch(read.machine, "run", table, read.batch_channels(), simulated=True)


def test_thermal_tests_from_recordings(call: Call, small: Path, tmp_path: Path) -> None:
    batch = recorded(small)
    folder = tmp_path / "recorded"
    folder.mkdir()
    for name in ("a", "b"):
        batch.table.to_csv(folder / f"{name}.csv", index=False)
    (tmp_path / "sheet.yml").write_text("tool_stick_out: 120 mm\naxes: {Z: z}\n")
    done = call("report", "--iso", "--machine", small, "recorded", "--out", "tests", "--sheet", "sheet.yml")
    assert done.code == 0, done.err
    assert done.out.split() == ["tests/a/report.html", "tests/b/report.html"]
    shown = (tmp_path / "tests" / "b" / "report.md").read_text(encoding="utf-8")
    assert "120 mm" in shown and "| warm-up | Z |" in shown


def test_thermal_tests_refuse_in_one_line(call: Call, small: Path, tmp_path: Path) -> None:
    for args, line in {
        (): "the lake holds no batch of two_bodies; name recordings, or call `thermodrift ingest` first",
        ("run9",): "run9: no such file or folder, and no batch in the lake, it is empty",
        ("home",): "home: no recording of two_bodies there; recording.files takes *.csv",
        ("two.yml", "--format", "md"): "--format: with --iso both forms are written; leave it out",
    }.items():
        (tmp_path / "home").mkdir(exist_ok=True)
        done = call("report", "--iso", "--machine", small, *args)
        assert done.code == 2 and line in done.err and len(done.err.strip().splitlines()) == 1
    done = call("report", "--machine", small, "--sheet", "sheet.yml")
    assert done.code == 2 and "--sheet: a test sheet belongs to a thermal test; add --iso" in done.err


def test_a_batch_that_comes_twice_is_told(small: Path, tmp_path: Path) -> None:
    batch = recorded(small)
    (tmp_path / "run.parquet").write_bytes(encode(batch, content_digest(batch)).to_pybytes())
    twice = [str(tmp_path / "run.parquet")] * 2
    with pytest.raises(InputError, match="batch 'run' comes twice in the recordings; leave one of them out"):
        write_thermal_tests(small, twice, tmp_path / "tests", Lake(tmp_path / "lake"), None, lambda _: None)
