"""Reading of real recordings: lathe, spindle, heater boards, cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.describe import drafted
from data.machine import parse_machine
from data.recording import read_batches, recording_files

REAL = Path(__file__).parents[3] / "shared" / "data"
pytestmark = pytest.mark.skipif(not REAL.is_dir(), reason="real recordings are not on this machine")

SPINDLE = """
machine: spindle
recording: {step_s: 60, split: {driver: rpm}}
channels:
  rpm: {role: driver, unit: rpm, column: spindle_rpm}
  t4: {role: temperature, unit: degC, column: t4_degC}
  ch3: {role: error, unit: um, column: ch3_um}
"""
LATHE = """
machine: lathe
recording:
  files: ["2*.csv"]
  time: {column: Time, unit: min}
  start_from_name: "%Y%m%d"
  schedule:
    file: runs.csv
    batch_column: batch
    stages: [{hours: hours1, drivers: {rpm: rpm1, feed: feed1_mm_min}},
             {hours: hours2, drivers: {rpm: rpm2, feed: feed2_mm_min}},
             {hours: hours3, drivers: {rpm: rpm3, feed: feed3_mm_min}}]
channels:
  PT01: {role: temperature, unit: degC}
  motor: {role: temperature, unit: degC, column: Spindle Motor}
  z: {role: error, unit: um, column: Disp. Z}
  rpm: {role: driver, unit: rpm, source: schedule}
  feed: {role: driver, unit: mm/min, source: schedule}
"""


def test_lathe_runs_with_their_schedule():
    machine = parse_machine(LATHE, "test")
    files, others = recording_files(REAL / "lathe_gv1203", machine)
    assert len(files) == 32 and others == []
    rows, read = 0, {}
    for path in files:
        (batch,) = read_batches(path, machine)
        raw = pd.read_csv(path)
        rows, read[batch.batch_id] = rows + batch.repairs["rows_in"], batch
        assert batch.repairs["rows_in"] == len(raw) == batch.repairs["rows_used"] + batch.repairs["rows_dropped"]
        t = (raw["Time"] - raw["Time"][0]) * 60
        expected = np.interp(batch.time_s, t, raw["PT01"])
        assert np.abs(batch.values("PT01") - expected).max() < 0.11  # within the resolution, whatever the way
        assert batch.start == pd.Timestamp(path.stem)
        assert not np.isnan(batch.values("rpm")).any()
    assert rows > 20_000
    stop = read["20200810"]
    assert [stop.values("rpm")[int(h * 60)] for h in (1, 2.4, 3.0, 3.6, 5.9)] == [1800, 1800, 0, 1200, 1200]


def test_spindle_is_cut_into_its_six_runs():
    path = REAL / "spindle_fl" / "spindle_fl.csv"
    batches = list(read_batches(path, parse_machine(SPINDLE, "test")))
    assert [b.batch_id for b in batches] == [f"spindle_fl-{k:02d}" for k in range(1, 7)]
    assert [b.values("rpm")[0] for b in batches] == [1250, 2500, 3750, 5000, 3500, 500]
    assert sum(b.repairs["rows_in"] for b in batches) == 11_115
    assert batches[0].repairs["rows_before_run"] == 31
    for b in batches:
        assert b.values("rpm")[-1] == 0  # the stop that follows belongs to the run


FILES = ["lathe_gv1203/20200[67]*.csv", "spindle_fl/*.csv", "tclab/hybrid_mimo.csv", "tclab/mhe2nl.txt",
         "tclab/mimo2_data.txt", "tclab/energy_balance_mimo.txt", "cell_30q/*.csv"]  # fmt: skip


@pytest.mark.parametrize("pattern", FILES)
def test_draft_of_a_machine_file_reads_its_own_files(pattern):
    files = sorted(REAL.glob(pattern))
    machine = parse_machine(drafted(files)[0], pattern)
    assert set(files) <= set(recording_files(files[0].parent, machine)[0])
    for path in files[:3]:
        (batch,) = read_batches(path, machine)
        assert batch.repairs["unparsable_values"] == 0
        assert batch.repairs["rows_dropped"] <= 0.15 * batch.repairs["rows_in"]
        assert all(np.isfinite(batch.values(n)).mean() > 0.9 for n in batch.channels)


def test_draft_of_the_lathe_finds_roles_and_units():
    machine = parse_machine(drafted(sorted(REAL.glob("lathe_gv1203/*.csv")))[0], "lathe")
    assert machine.recording.time.unit == "min"
    assert machine.names("error") == ("Disp_X", "Disp_Z")
    assert len(machine.names("temperature")) == 24
    assert machine.channels["PT01"].resolution == 0.1
