"""Files as loggers write them: a draft is accepted by its own ingest and gives the values, roles, units and start."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.describe import drafted, notes
from data.ingest import ingest
from data.lake import Lake
from data.machine import Machine, parse_machine

LOGGERS = Path(__file__).parents[3] / "shared" / "data" / "loggers"
pytestmark = pytest.mark.skipif(not LOGGERS.is_dir(), reason="the loggers' files are not on this machine")

MORNING = pd.Timestamp("2026-01-14 07:30:00")
FRONT, BED, Z = ("temperature", "degC", "front_degC"), ("temperature", "degC", "bed_degC"), ("error", "um", "z_um")
# file -> start, (role, unit, column of the truth) in the order of its channels
READINGS = {
    "hobo.csv": (MORNING, [FRONT, BED, Z]),
    "toa5.dat": (MORNING, [FRONT, BED, Z]),
    "influx1.csv": (MORNING, [FRONT, BED, Z]),
    "ns.csv": (MORNING, [FRONT, BED, Z]),
    "ha_long.csv": (MORNING, [FRONT, BED, Z]),
    "grafana.csv": (MORNING, [FRONT, BED, Z]),
    "dup.csv": (MORNING, [FRONT, BED, Z]),
    "white.txt": (None, [FRONT, BED, Z]),
    "pico.csv": (MORNING, [FRONT, BED, Z]),
    "lvm_txt.txt": (MORNING + pd.Timedelta("123ms"), [FRONT, BED, Z]),
    "hms48.csv": (None, [FRONT, BED, Z]),
    "jan.csv": (MORNING, [FRONT, BED, Z]),
    "truth.csv": (None, [FRONT, BED, Z]),
    "units_unknown.csv": (None, [FRONT, BED, Z, ("driver", "psi", None), ("driver", "psi", None),
                                 ("driver", "kg", None), ("driver", "%RH", None), ("driver", "gpm", None)]),
    "weight.csv": (None, [FRONT, ("error", "kg", None)]),
}  # fmt: skip


def ingested(path: Path, machine: Machine, tmp_path: Path) -> Batch:
    report = ingest([path], machine, Lake(tmp_path / "lake"))
    assert [r.status for r in report.rows] == ["new"], [r.reason for r in report.rows]
    (batch,) = Lake(tmp_path / "lake").load_all(machine.machine)
    return batch


@pytest.mark.parametrize("name", READINGS)
def test_a_draft_reads_its_own_file(name: str, tmp_path: Path) -> None:
    start, channels = READINGS[name]
    truth = pd.read_csv(LOGGERS / "truth.csv")
    text = drafted([LOGGERS / name])[0]
    assert not any("ingest" in note for note in notes(text))
    batch = ingested(LOGGERS / name, parse_machine(text, "draft"), tmp_path)
    assert batch.start == start
    assert [(c.role, c.unit) for c in batch.channels.values()] == [(role, unit) for role, unit, _ in channels]
    for channel, (_, unit, column) in zip(batch.channels, channels, strict=True):
        values = batch.values(channel)[:180]
        assert np.isfinite(values).all() and batch.repairs["rows_used"] == 180
        if column is not None:  # °F are written to a hundredth
            assert np.abs(values - truth[column]).max() < (0.006 if unit == "degC" else 1e-6)
    assert batch.time_s[179] == 179 * (1200 if name == "hms48.csv" else 60)


def test_local_times_over_the_start_of_summer_time(tmp_path: Path) -> None:
    path = LOGGERS / "dst_spring.csv"
    text = drafted([path])[0]
    (note,) = notes(text)
    assert "the clock jumps by an hour at 2025-03-30 02:00" in note and "recording.timezone" in note
    with_zone = text.replace("  header: true\n", "  header: true\n  timezone: Europe/Berlin\n")
    batch = ingested(path, parse_machine(with_zone, "draft"), tmp_path)
    assert batch.start == pd.Timestamp("2025-03-30 01:00") and batch.n_rows == 180
    assert batch.repairs["gaps"] == 0 and np.isfinite(batch.values("z_um")).all()


def test_what_is_doubtful_is_asked_for() -> None:
    assert notes(drafted([LOGGERS / "units_unknown.csv"])[0]) == [
        "load_kg (kg): taken for drivers; set role: error if one is measured"
    ]
    assert notes(drafted([LOGGERS / "weight.csv"])[0]) == [
        "W_raw_kg (kg) is taken for the measured error; else set its role"
    ]
