"""The draft of a machine file: it reads back the files it was drafted from, and marks what it guessed."""

from __future__ import annotations

import re

import numpy as np
import pandas as pd
import pytest

from data import guess
from data.describe import draft_machine_file
from data.errors import InputError
from data.machine import parse_machine
from data.recording import read_batches, recording_files


def run(seed: int, n: int = 400) -> pd.DataFrame:
    rng = np.random.default_rng(seed)
    t = np.arange(n) * 0.5
    rise = 8 * (1 - np.exp(-t / 60))
    return pd.DataFrame(
        {
            "Time": t + 0.013,
            "T1": np.round(20 + rise, 1),
            "Spindle bearing (°C)": np.round(21 + rise + rng.normal(0, 0.05, n), 2),
            "Oil [K]": 293.15 + rise,
            "Hall temperature": np.round(20 + 0.3 * np.sin(t / 50), 1),
            "speed": np.where(t % 60 < 40, 3000, 0),
            "Disp. Z": np.round(4 * rise, 2),
            "gap_mm": np.round(rise / 1e3, 5),
            "mystery": np.where(t > 100, 7.0, -7.0),
            "remark": "ok",
        }
    )


def draft(files):
    text = draft_machine_file(files)
    return text, parse_machine(text, "draft")


@pytest.mark.parametrize("suffix", ["csv", "xlsx", "parquet"])
def test_draft_reads_the_files_it_was_drafted_from(tmp_path, suffix):
    files = []
    for k, stem in enumerate(("20240105", "20240712")):
        path = tmp_path / f"{stem}.{suffix}"
        table = run(k)
        {"csv": table.to_csv, "xlsx": table.to_excel, "parquet": table.to_parquet}[suffix](path, index=False)
        files.append(path)
    _, machine = draft(files)
    assert recording_files(tmp_path, machine)[0] == files
    assert machine.recording.time.unit == "min"
    assert machine.recording.step_s == 30
    assert machine.ignore == ["remark"]
    roles = {c.column or n: (c.role, c.unit, c.unit_in_file) for n, c in machine.channels.items()}
    assert roles == {
        "T1": ("temperature", "degC", None),
        "Spindle bearing (°C)": ("temperature", "degC", None),
        "Oil [K]": ("temperature", "degC", "K"),
        "Hall temperature": ("ambient", "degC", None),
        "speed": ("driver", "rpm", None),
        "Disp. Z": ("error", "um", None),
        "gap_mm": ("error", "um", "mm"),
        "mystery": ("driver", "1", None),
    }
    assert machine.channels["T1"].resolution == 0.1
    assert machine.channels["gap_mm"].resolution == pytest.approx(0.01)
    for k, path in enumerate(files):
        (batch,) = read_batches(path, machine)
        table = run(k)
        assert batch.start == pd.Timestamp(path.stem)
        assert np.allclose(batch.values("Disp_Z"), table["Disp. Z"], atol=1e-6)
        assert np.allclose(batch.values("Oil_K"), table["Oil [K]"] - 273.15, atol=1e-6)
        assert batch.repairs["rows_dropped"] == 0 == batch.repairs.get("unknown_columns", 0)


def test_every_guess_is_marked_on_its_line_and_in_the_list(tmp_path):
    run(1).to_csv(tmp_path / "a.csv", index=False)
    text, machine = draft([tmp_path / "a.csv"])
    for name, part in machine.channels.items():
        block = re.search(rf'\n  "?{re.escape(name)}"?:\n((?:    .*\n)+)', text)[1]
        marked = set(re.findall(r"^    (\w+):.*# guessed: \S", block, re.M))
        assert marked | {"unit"} == set(part.guessed), name
    for key in ("machine", "files", "time", "step_s", "max_gap_s"):
        assert re.search(rf"^ *{key}:.*# guessed: \S", text, re.M), key


def test_units_row_semicolons_and_title_lines(tmp_path):
    path = tmp_path / "log.csv"
    rows = "\n".join(f"{i},5;2{i % 7},1;{i}".replace(".", ",") for i in range(30))
    path.write_bytes(f"Logger 7\nHalle 3\nZeit;Gehäuse;Weg\nmin;°C;µm\n{rows}\n".encode("cp1252"))
    text, machine = draft([path])
    assert "semicolon separated, decimal comma, cp1252" in text
    assert machine.recording.time.unit == "min"
    assert [(c.role, c.unit) for c in machine.channels.values()] == [("temperature", "degC"), ("error", "um")]
    (batch,) = read_batches(path, machine)
    assert batch.values("Weg").tolist() == list(range(30))
    assert batch.repairs["unit_rows"] == 1


def test_without_a_header_columns_are_named_by_position(tmp_path):
    t = np.arange(0, 600, 3.0)
    table = np.column_stack([t, np.where(t > 100, 80, 0), 20 + t / 40, t / 30])
    path = tmp_path / "log.txt"
    np.savetxt(path, table, delimiter=",")
    _, machine = draft([path])
    assert not machine.recording.header
    assert {n: (c.column, c.role) for n, c in machine.channels.items()} == {
        "column_1": (1, "driver"), "column_2": (2, "temperature"), "column_3": (3, "error"),
    }  # fmt: skip
    (batch,) = read_batches(path, machine)
    assert batch.repairs["rows_in"] == 200


def test_timestamps_and_names_in_other_scripts(tmp_path):
    path = tmp_path / "log.csv"
    stamps = pd.date_range("2024-05-06 07:00", periods=40, freq="15s")
    lines = [f"{s:%d.%m.%Y %H:%M:%S},{20 + i / 10},{i / 10}" for i, s in enumerate(stamps + pd.Timedelta("10D"))]
    path.write_bytes(("时间,主轴温度,位移X\n" + "\n".join(lines) + "\n").encode("gb18030"))
    _, machine = draft([path])
    assert machine.recording.time.format == "%d.%m.%Y %H:%M:%S"
    assert {n: c.role for n, c in machine.channels.items()} == {"主轴温度": "temperature", "位移x": "error"}
    (batch,) = read_batches(path, machine)
    assert batch.start == pd.Timestamp("2024-05-16 07:00")
    assert batch.n_rows == 40


def test_files_of_another_kind_are_left_out_and_named(tmp_path):
    run(1).to_csv(tmp_path / "a.csv", index=False)
    (tmp_path / "runs.csv").write_text("run,hall\na,warm\n")
    text, _ = draft([tmp_path / "a.csv", tmp_path / "runs.csv"])
    assert "# left out: runs.csv: no table of numbers found" in text


def test_nothing_to_describe_is_one_clear_line(tmp_path):
    with pytest.raises(InputError, match="describe: no files given"):
        draft_machine_file([])
    (tmp_path / "a.csv").write_text("hello\nworld\n")
    with pytest.raises(InputError, match=r"^a.csv: no table of numbers found; expected a time column and channels"):
        draft_machine_file([tmp_path / "a.csv"])
    with pytest.raises(InputError, match=r"gone\.csv: no such file"):
        draft_machine_file([tmp_path / "gone.csv"])


@pytest.mark.parametrize("step", [0.1, 0.25, 0.02, 1.0, 0.488])
def test_resolution_is_the_step_of_the_lattice(step):
    rng = np.random.default_rng(3)
    assert guess.resolution(np.round(rng.normal(20 / step, 8, 500)) * step) == pytest.approx(step)
    assert guess.resolution(rng.normal(20, 5, 500)) is None
