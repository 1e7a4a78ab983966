"""The draft of a machine file for errors along an axis: it reads the sweeps back, and takes nothing else for sweeps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data import guess
from data.describe import draft_machine_file
from data.machine import Machine, parse_machine
from data.recording import read_batches
from plants.sample.sample_axis import write_sample_axis

AT_MM = np.linspace(0, 330, 12)
SWEEPS_MIN = np.arange(0, 241, 30)


def error_um(time_min):
    return (3 + 0.02 * AT_MM) * (1 - np.exp(-np.atleast_1d(time_min)[:, None] / 60))


def nut(time_min):
    return 20 + 5 * (1 - np.exp(-np.asarray(time_min, float) / 60))


def draft(path: Path) -> tuple[str, Machine]:
    text = draft_machine_file([path])
    return text, parse_machine(text, "draft")


def sweeps_of(path: Path, machine: Machine, error: str) -> tuple[np.ndarray, np.ndarray]:
    """Positions and errors that the drafted file reads, one row a sweep."""
    (batch,) = read_batches(path, machine)
    there = np.isfinite(batch.values(error))
    at = batch.values(machine.channels[error].position)[there]
    return at.reshape(-1, 12), batch.values(error)[there].reshape(-1, 12)


def test_rows_that_share_a_stamp_are_a_sweep(tmp_path: Path) -> None:
    t = np.repeat(SWEEPS_MIN, 12)
    table = {
        "time [min]": t,
        "P [mm]": np.tile(AT_MM, 9),
        "deviation [um]": error_um(SWEEPS_MIN).ravel(),
        "T nut": nut(t),
    }
    pd.DataFrame(table).to_csv(tmp_path / "a.csv", index=False)
    text, machine = draft(tmp_path / "a.csv")
    assert "position: P_mm  # guessed: rows share a time stamp while the position changes" in text
    assert "guessed: [role, unit, position, range]" in text
    assert (machine.recording.step_s, machine.recording.max_gap_s) == (10, 9000)  # 12 rows in two minutes
    at, error = sweeps_of(tmp_path / "a.csv", machine, "deviation_um")
    assert np.allclose(at, AT_MM) and np.allclose(error, error_um(SWEEPS_MIN))


def test_readings_with_stamps_of_their_own_in_a_log(tmp_path: Path) -> None:
    (path,) = write_sample_axis(tmp_path, 0, 1)
    table = pd.read_csv(path, skiprows=1)
    table = table.rename(columns={"x_axis": "x_error", "z_axis": "z_error", "x_spindle": "dx", "z_spindle": "dz"})
    table.to_csv(tmp_path / "a.csv", index=False)
    text, machine = draft(tmp_path / "a.csv")
    assert machine.channels["x_error"].position == "x_position" and machine.channels["z_error"].position == "z_position"
    assert machine.channels["dx"].position is None
    assert "position: x_position  # guessed: error and position stand in the same rows" in text
    assert machine.recording.step_s == 10
    at, _ = sweeps_of(tmp_path / "a.csv", machine, "z_error")
    assert (at == at[0]).all()


@pytest.mark.parametrize("pattern", ["x={:g}", "X = {:.1f} mm", "Ex @{:g}", "z {:g}", "dev at {:g}mm"])
def test_a_column_for_each_position(tmp_path: Path, pattern: str) -> None:
    table = {"time [min]": SWEEPS_MIN, "T1": nut(SWEEPS_MIN), "T2": 20.0 + SWEEPS_MIN / 100, "T3": 21.0}
    table |= {pattern.format(p): e for p, e in zip(AT_MM, error_um(SWEEPS_MIN).T, strict=True)}
    pd.DataFrame(table).to_csv(tmp_path / "a.csv", index=False)
    text, machine = draft(tmp_path / "a.csv")
    (error,) = machine.names("error")
    assert machine.names("position") == (machine.channels[error].position,)
    assert "role: error  # guessed: 12 columns whose names differ by a number" in text
    assert {"T1", "T2", "T3"} <= set(machine.channels)
    at, got = sweeps_of(tmp_path / "a.csv", machine, error)
    assert np.allclose(at, AT_MM)
    assert np.allclose(got, error_um(SWEEPS_MIN))
    assert machine.recording.step_s == 10


def test_two_axes_in_columns_are_two_channels() -> None:
    columns = ["time", *(f"x={p}" for p in (0, 60, 90)), *(f"z={p}" for p in (-500, -200, 20)), "T=20"]
    found = guess.position_groups(columns, range(1, len(columns)))
    assert guess.position_groups(["0", "60", "90"], range(3))[0].pattern == "*"
    assert [(g.pattern, g.letter, g.position_mm) for g in found] == [
        ("x=*", "x", (0.0, 60.0, 90.0)),
        ("z=*", "z", (-500.0, -200.0, 20.0)),
    ]


@pytest.mark.parametrize(
    "names",
    [["T1", "T2", "T3"], ["PT01", "PT02", "PT04"], ["1", "2", "3", "4"], ["x1", "x2", "x3"], ["x=1", "x=2"],
     ["ch10", "ch20", "ch30"]],
)  # fmt: skip
def test_numbered_channels_are_no_positions(names: list[str]) -> None:
    assert guess.position_groups(names, range(len(names))) == []


def test_an_axis_that_moves_beside_a_steady_record_is_no_sweep(tmp_path: Path) -> None:
    t = np.arange(0, 240.0)
    table = {"time [min]": t, "P [mm]": np.resize(AT_MM, 240), "dz [um]": 10 * (1 - np.exp(-t / 60)), "T nut": nut(t)}
    pd.DataFrame(table).to_csv(tmp_path / "a.csv", index=False)
    _, machine = draft(tmp_path / "a.csv")
    assert machine.channels["P_mm"].role == "position" and machine.channels["dz_um"].position is None
    assert machine.recording.step_s == 60
