"""A file to its batches: nothing is lost uncounted, every unusable file is one clear line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from data.errors import InputError
from data.machine import Machine, parse_machine
from data.recording import read_batches, recording_files

CHANNELS = """
channels:
  front: {role: temperature, unit: degC}
  room: {role: ambient, unit: degC, column: Hall, unit_in_file: degF}
  z: {role: error, unit: um, column: dz, unit_in_file: mm}
"""


def machine(recording: str = "{step_s: 60}", channels: str = CHANNELS) -> Machine:
    return parse_machine(f"machine: mill\nrecording: {recording}\n{channels}", "test")


def frame(n: int = 100, interval_s: float = 10.0, **more) -> pd.DataFrame:
    t = np.arange(n) * interval_s
    return pd.DataFrame({"time_s": t, "front": 20 + t / 1e3, "Hall": 68.0, "dz": t / 1e6, **more})


def save(path: Path, table: pd.DataFrame) -> Path:
    table.to_csv(path, index=False)
    return path


def only(path: Path, m: Machine, **options):
    (batch,) = read_batches(path, m, **options)
    return batch


def adds_up(batch) -> None:
    r = batch.repairs
    reasons = ("ragged_rows", "unparsable_time", "time_outliers", "rows_before_run", "rows_empty", "rows_between")
    assert r["rows_in"] == r["rows_used"] + r["rows_dropped"]
    assert r["rows_dropped"] == sum(r[k] for k in reasons)
    assert r["rows_out"] == batch.n_rows


def test_a_file_becomes_a_batch_in_the_lakes_units(tmp_path):
    batch = only(save(tmp_path / "a7.csv", frame()), machine())
    assert (batch.machine, batch.batch_id, batch.source, batch.digest) == ("mill", "a7", "a7.csv", "")
    assert batch.start is None and not batch.simulated and batch.findings == ()
    assert list(batch.table.columns) == ["time_s", "front", "room", "z"]
    assert batch.time_s.tolist() == [60.0 * i for i in range(17)]
    assert batch.values("room") == pytest.approx(20.0)  # 68 °F
    assert batch.values("z")[1] == pytest.approx(1e3 * np.mean([3, 4, 5, 6, 7, 8]) * 1e-5)  # mm to µm
    assert batch.channels["z"].unit == "um"
    adds_up(batch)


def test_what_is_missing_and_what_is_unknown_is_counted(tmp_path):
    table = frame(extra=1.0, note="ok", known=2.0).drop(columns="Hall")
    m = machine(channels=CHANNELS + "ignore: [known]\n")
    batch = only(save(tmp_path / "a.csv", table), m)
    assert batch.repairs["unknown_columns"] == 2
    assert batch.repairs["missing_channels"] == 1
    assert np.isnan(batch.values("room")).all()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.sampled_from(["good"] * 6 + ["no time", "bad time", "empty", "short", "long", "blank", "twice", "bad cell"]),
        min_size=8,
        max_size=80,
    ),
    st.sampled_from([5, 10, 25, 60]),
)
def test_every_source_row_is_accounted_for(tmp_path, kinds, step_s):
    """Rows of every kind of damage, counted here by hand."""
    lines, t = [], 0.0
    for kind in kinds:
        t += 0.0 if kind == "twice" else 10.0
        lines.append(
            {
                "no time": ",20,68,1", "bad time": "??,20,68,1", "empty": f"{t},,,", "short": f"{t},20",
                "long": f"{t},20,68,1,5,6", "blank": "", "bad cell": f"{t},oops,68,1",
            }.get(kind, f"{t},20,68,1")
        )  # fmt: skip
    path = tmp_path / "a.csv"
    path.write_text("time_s,front,Hall,dz\n0,20,68,0\n10,20,68,0\n" + "\n".join(lines) + "\n")
    try:
        batch = only(path, machine(f"{{step_s: {step_s}, max_gap_s: 900}}"))
    except InputError as error:
        assert "at least 2" in str(error)
        return
    r = batch.repairs
    adds_up(batch)
    assert r["rows_in"] == 2 + sum(k != "blank" for k in kinds)
    assert r["ragged_rows"] == sum(k in ("short", "long") for k in kinds)
    assert r["unparsable_time"] == sum(k in ("no time", "bad time") for k in kinds)
    assert r["rows_empty"] == kinds.count("empty")
    assert r["unparsable_values"] == kinds.count("bad cell")


def test_schedule_gives_drivers_and_labels(tmp_path):
    (tmp_path / "runs.csv").write_text(
        "run,n1,h1,n2,h2,hall\n7,3000,0.25,1000,0.25,warm\n8,2000,0.5,,,cold 5\n9,500,0.25,,,20\n"
    )
    m = machine(
        "{step_s: 60, schedule: {file: runs.csv, batch_column: run, labels: {hall: hall}, stages: ["
        "{hours: h1, drivers: {rpm: n1}}, {hours: h2, drivers: {rpm: n2}}]}}",
        CHANNELS + "  rpm: {role: driver, unit: rpm, source: schedule}\n",
    )
    for name in ("7", "8", "9", "10"):
        save(tmp_path / f"{name}.csv", frame(188))  # 1870 s, 0.5 h and 70 s
    files, others = recording_files(tmp_path, m)
    assert [f.name for f in files] == ["10.csv", "7.csv", "8.csv", "9.csv"] and others == []
    seven, eight, nine = (only(tmp_path / f"{n}.csv", m) for n in "789")
    t = seven.time_s
    assert np.array_equal(seven.values("rpm"), np.where(t < 900, 3000, 1000))  # 70 s longer: the last stage holds
    assert np.array_equal(eight.values("rpm"), np.full(len(t), 2000))
    assert np.array_equal(nine.values("rpm"), np.where(t < 900, 500, 0))  # clearly longer: it had stopped
    assert [b.labels["hall"] for b in (seven, eight, nine)] == ["warm", "cold 5", 20.0]
    with pytest.raises(InputError, match=r"10: no row in schedule runs.csv with run = '10' \(3 rows\)"):
        only(tmp_path / "10.csv", m)
    (tmp_path / "runs.csv").write_text("run,n1,h1,n2,h2\n7,fast,0.25,,\n")
    with pytest.raises(InputError, match=r"runs.csv: no column 'hall'; got run, n1, h1, n2, h2"):
        only(tmp_path / "7.csv", m)
    (tmp_path / "runs.csv").write_text("run,n1,h1,n2,h2,hall\n7,fast,0.25,,,\n")
    with pytest.raises(InputError, match=r"runs.csv row 7 column 'n1': got 'fast', expected a number"):
        only(tmp_path / "7.csv", m)
    (tmp_path / "runs.csv").unlink()
    with pytest.raises(InputError, match=r"schedule 'runs.csv' is missing next to the recording"):
        only(tmp_path / "7.csv", m)


SPLIT = "{step_s: 60, max_gap_s: 900, start_from_name: '%Y%m%d', split: {driver: rpm, min_run_s: 600}}"
RPM = CHANNELS + "  rpm: {role: driver, unit: rpm}\n"


def long_recording() -> tuple[pd.DataFrame, list[int]]:
    """Stop 300 s, run 1200 s, stop, a 300-s jog, stop, run at two speeds, stop, a run cut off after 100 s."""
    levels = [(0, 30), (1000, 120), (0, 100), (500, 30), (0, 60), (2000, 70), (-3000, 70), (0, 50), (4000, 11)]
    rpm = np.concatenate([np.full(n, float(v)) for v, n in levels])
    return frame(len(rpm), rpm=rpm), [30, 30 + 120 + 100 + 30 + 60]


@pytest.mark.parametrize("block_bytes", [16 << 20, 700])
def test_a_long_recording_is_cut_where_runs_begin(tmp_path, monkeypatch, block_bytes):
    monkeypatch.setattr("data.readers.csv._BLOCK_BYTES", block_bytes)
    table, cuts = long_recording()
    batches = list(read_batches(save(tmp_path / "20240229.csv", table), machine(SPLIT, RPM)))
    assert [b.batch_id for b in batches] == ["20240229-01", "20240229-02"]
    ends = [*cuts[1:], len(table)]
    for batch, begin, end in zip(batches, cuts, ends, strict=True):
        assert batch.values("rpm")[0] == table["rpm"][begin]
        assert batch.start == pd.Timestamp("2024-02-29") + pd.Timedelta(seconds=10.0 * begin)
        assert batch.values("front")[0] == table["front"][begin]
        assert batch.n_rows == (end - 1 - begin) // 6 + 1
        adds_up(batch)
    assert batches[0].repairs["rows_before_run"] == 30
    assert sum(b.repairs["rows_in"] for b in batches) == len(table)


def test_cutting_holds_one_batch_at_a_time(tmp_path, monkeypatch):
    monkeypatch.setattr("data.readers.csv._BLOCK_BYTES", 700)
    table = pd.concat([frame(0)] + [frame(200, rpm=np.repeat([900.0, 0.0], 100))] * 5, ignore_index=True)
    table["time_s"] = np.arange(len(table)) * 10.0
    read = []
    stream = __import__("data.rows", fromlist=["stream"]).stream

    def watched(*args):
        for rows in stream(*args):
            read.append(len(rows))
            yield rows

    monkeypatch.setattr("data.recording.stream", watched)
    seen = [sum(read) for _ in read_batches(save(tmp_path / "20240229.csv", table), machine(SPLIT, RPM))]
    assert len(seen) == 5
    assert all(s < 200 * (k + 2) for k, s in enumerate(seen[:-1]))


def test_a_recording_that_never_runs_cannot_be_cut(tmp_path):
    path = save(tmp_path / "20240229.csv", frame(rpm=0.0))
    with pytest.raises(InputError, match=r"rpm never runs for 600 s \(longest run 0 s\)"):
        list(read_batches(path, machine(SPLIT, RPM)))
    with pytest.raises(InputError, match="needs the driver 'rpm', which is not in the file"):
        list(read_batches(save(path, frame()), machine(SPLIT, RPM)))


def test_sheets_are_batches_and_a_bad_one_does_not_hold_back_the_others(tmp_path):
    book = openpyxl.Workbook()
    book.active.title = "notes"
    book.active.append(["made by", "hand"])
    for name, n in (("cold", 50), ("warm", 60), ("short", 1)):
        sheet = book.create_sheet(name)
        sheet.append(["time_s", "front", "Hall", "dz"])
        for row in frame(n).itertuples(index=False):
            sheet.append(list(row))
    book.save(tmp_path / "year.xlsx")
    got = []
    with pytest.raises(InputError, match=r"^year.xlsx sheet 'short': 1 data rows, expected at least 2"):
        for batch in read_batches(tmp_path / "year.xlsx", machine()):
            got.append(batch)
    assert [b.batch_id for b in got] == ["year-cold", "year-warm"]
    assert [b.repairs["rows_in"] for b in got] == [50, 60]
    assert got[0].repairs["skipped_sheets"] == 1


def test_start_from_name_from_stamps_or_unknown(tmp_path):
    named = machine("{start_from_name: '%Y-%m-%d_%H%M'}")
    assert only(save(tmp_path / "2024-05-06_0730.csv", frame()), named).start == pd.Timestamp("2024-05-06 07:30")
    other = only(save(tmp_path / "test.csv", frame()), named)
    assert other.start is None and other.repairs["start_unreadable"] == 1
    stamped = frame()
    stamped["time_s"] = pd.Timestamp("2024-05-06 07:31:02") + pd.to_timedelta(stamped["time_s"], unit="s")
    m = machine("{time: {unit: timestamp}}")
    assert only(save(tmp_path / "b.csv", stamped), m).start == pd.Timestamp("2024-05-06 07:31:02")


def test_recording_files_of_a_mixed_directory(tmp_path):
    m = machine("{files: ['*.csv', 'sub/*.parquet'], schedule: {file: runs.csv, batch_column: run, stages: []}}")
    (tmp_path / "sub").mkdir()
    for name in ("b.CSV", "a.csv", "runs.csv", "note.docx", ".hidden.csv", "sub/x.parquet", "sub/y.csv", "~$a.csv"):
        (tmp_path / name).write_text("x")
    files, ignored = recording_files(tmp_path, m)
    assert [f.relative_to(tmp_path).as_posix() for f in files] == ["a.csv", "b.CSV", "sub/x.parquet", "sub/y.csv"]
    assert [(f.name, reason) for f, reason in ignored] == [
        (".hidden.csv", "hidden"),
        ("note.docx", "not in recording.files (*.csv, sub/*.parquet)"),
        ("~$a.csv", "lock file of an open document"),
    ]
    with pytest.raises(InputError, match="no such directory"):
        recording_files(tmp_path / "gone", m)


def bad_files(folder: Path) -> dict[str, str]:
    """File name -> words that its error must hold."""
    good = frame()
    (folder / "empty.csv").write_bytes(b"")
    (folder / "junk.csv").write_bytes(np.random.default_rng(1).bytes(4000))
    (folder / "run.doc").write_text("x")
    good.to_excel(folder / "whole.xlsx", index=False)
    whole = (folder / "whole.xlsx").read_bytes()
    (folder / "cut.xlsx").write_bytes(whole[: len(whole) // 2])
    save(folder / "foreign.csv", pd.DataFrame(np.ones((5, 200)), columns=[f"A{i}" for i in range(200)]))
    save(folder / "no_error.csv", good.drop(columns="dz"))
    save(folder / "no_time.csv", good.drop(columns="time_s"))
    save(folder / "one_row.csv", good.head(1))
    save(folder / "header.csv", good.head(0))
    save(folder / "nan.csv", good.assign(front=np.nan, Hall=np.nan, dz=np.nan))
    save(folder / "nan_error.csv", good.assign(dz=np.nan))
    save(folder / "text.csv", good.assign(dz="off", front="off", Hall="off"))
    save(folder / "clock.csv", good.assign(time_s="soon"))
    (folder / "folder.csv").mkdir()
    return {
        "gone.csv": "no such file; give the path of a recording",
        "folder.csv": "is a directory, expected one recording file",
        "empty.csv": "the file is empty (0 bytes)",
        "junk.csv": "not a text file (binary content)",
        "run.doc": "unsupported file extension '.doc'",
        "cut.xlsx": "damaged or truncated XLSX",
        "foreign.csv": "none of its 200 columns is a channel of machine mill; got 'A0', 'A1', 'A2' …,"
        " expected 'front', 'Hall', 'dz'",
        "no_error.csv": "no error channel; got 'time_s', 'front', 'Hall', expected column 'dz'",
        "no_time.csv": "time column 'time_s' is missing; got 'front', 'Hall', 'dz'",
        "one_row.csv": "1 data rows, expected at least 2",
        "header.csv": "0 data rows, expected at least 2",
        "nan.csv": "no channel has a value, all are empty or NaN",
        "nan_error.csv": "no error channel has a value, z are all empty or NaN",
        "text.csv": "no channel has a value, all are empty or NaN; 300 cells are no numbers",
        "clock.csv": "0 of 100 rows have a readable time in column 'time_s' as s",
    }


def test_every_unusable_file_is_one_clear_line(tmp_path):
    for name, words in bad_files(tmp_path).items():
        with pytest.raises(InputError) as caught:
            list(read_batches(tmp_path / name, machine()))
        line = str(caught.value)
        assert words in line and name in line and "\n" not in line, (name, line)


def test_prediction_needs_no_error_channel(tmp_path):
    batch = only(save(tmp_path / "a.csv", frame().drop(columns="dz")), machine(), need_error=False)
    assert np.isnan(batch.values("z")).all()


@pytest.mark.parametrize(
    ("part", "words"),
    [
        ("{role: temperature, unit: K}", "has unit 'K', expected 'degC'; write unit: degC and unit_in_file: 'K'"),
        ("{role: temperature, unit: degC, unit_in_file: um}",
         "'um' is a length and cannot become 'degC', a temperature"),
        ("{role: driver, unit: rpm, unit_in_file: rmp}", "unknown unit 'rmp'; did you mean 'rpm'?"),
    ],
)  # fmt: skip
def test_units_that_do_not_fit(tmp_path, part, words):
    m = machine(channels=CHANNELS + f"  extra: {part}\n")
    with pytest.raises(InputError, match="channel 'extra'") as caught:
        only(save(tmp_path / "a.csv", frame(extra=1.0)), m)
    assert words in str(caught.value)
