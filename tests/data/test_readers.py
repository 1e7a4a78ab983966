"""Readers: the same table comes back through every spelling; damage gives a batch or one clear line."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from data.errors import InputError
from data.machine import Form, Machine, parse_machine
from data.readers import READERS, reader_for
from data.readers.cells import parse_number, stamp_formats
from data.readers.csv import CsvSheet
from data.recording import read_batches

SAFE = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
NAMES = {  # what a logger of that encoding may write
    "utf-8": ("Zeit", "Spindel °C", "Weg µm"),
    "utf-8-sig": ("时间", "主轴温度", "位移X"),
    "utf-16": ("时间", "主轴温度", "位移X"),
    "utf-16-le": ("Time", "主軸温度", "変位Z"),
    "gb18030": ("时间", "主轴温度", "热误差Z"),
    "cp932": ("時間", "主軸温度", "変位Z"),
    "cp1252": ("Zeit", "Gehäuse °C", "Weg µm"),
}


def machine_for(time: str | int, temp: str | int, error: str | int, **recording: object) -> Machine:
    unit = recording.pop("unit", "s")
    text = f"""
machine: mill
recording: {{step_s: 10, max_gap_s: 1000, header: {str(isinstance(time, str)).lower()},
  time: {{column: {json.dumps(time)}, unit: {unit}}}}}
channels:
  front: {{role: temperature, unit: degC, column: {json.dumps(temp)}}}
  z: {{role: error, unit: um, column: {json.dumps(error)}}}
"""
    return parse_machine(text, "test")


def only(path: Path, machine: Machine):
    (batch,) = read_batches(path, machine)
    return batch


def of_text(folder: Path, text: str, unit: str = "s"):
    """The batch of a file with the columns t, front and z."""
    (folder / "run.csv").write_text(text)
    return only(folder / "run.csv", machine_for("t", "front", "z", unit=unit))


def cell(x: float, decimal: str) -> str:
    return "" if np.isnan(x) else repr(float(x)).replace(".", decimal)


def write_csv(path: Path, names, rows, separator=",", decimal=".", encoding="utf-8", newline="\n", before=(), units=()):
    lines = [*before, separator.join(names)] if names else list(before)
    lines += [separator.join(units)] if units else []
    lines += [separator.join(cell(x, decimal) for x in row) for row in rows]
    path.write_bytes((newline.join(lines) + newline).encode(encoding))


values = st.floats(-200, 500, allow_nan=False).map(lambda x: round(x, 4)) | st.just(float("nan"))
tables = st.lists(st.tuples(values, values), min_size=3, max_size=40).filter(
    lambda rows: any(not np.isnan(r[1]) for r in rows)
)


@SAFE
@given(
    rows=tables,
    spelling=st.sampled_from([(",", "."), (";", ","), (";", "."), ("\t", ","), ("\t", "."), ("|", ".")]),
    encoding=st.sampled_from(sorted(NAMES)),
    newline=st.sampled_from(["\n", "\r\n", "\r"]),
    title=st.integers(0, 3),
    with_units=st.booleans(),
)
def test_a_table_comes_back_through_every_spelling(tmp_path, rows, spelling, encoding, newline, title, with_units):
    names = NAMES[encoding]
    path = tmp_path / "run.csv"
    table = [(10.0 * i, *row) for i, row in enumerate(rows)]
    separator, decimal = spelling
    units = ("s", "°C", "µm") if with_units and encoding != "cp932" else ()
    write_csv(path, names, table, separator, decimal, encoding, newline, ["Logger 7 / test"] * title, units)
    batch = only(path, machine_for(*names))
    expected = np.array([r for r in table])
    for column, name in ((1, "front"), (2, "z")):
        v = expected[:, column]
        known = np.isfinite(v)
        assert np.array_equal(batch.values(name)[known], v[known])
    assert batch.repairs.get("preamble_rows", 0) == title
    assert batch.repairs.get("unit_rows", 0) == bool(units)
    assert batch.repairs["rows_in"] == len(rows) == batch.repairs["rows_used"] + batch.repairs["rows_dropped"]
    assert batch.repairs["unparsable_values"] == 0


@SAFE
@given(rows=tables, spelling=st.sampled_from([(",", "."), (";", ","), ("\t", ",")]))
def test_a_table_without_header(tmp_path, rows, spelling):
    path = tmp_path / "run.txt"
    table = [(10.0 * i, *row) for i, row in enumerate(rows)]
    if np.isnan([r[1:] for r in table[:1]]).all():
        return  # the first row is where the data are seen to begin
    write_csv(path, (), table, *spelling)
    batch = only(path, machine_for(0, 1, 2))
    assert batch.repairs["rows_in"] == len(rows)
    known = np.isfinite([r[2] for r in rows if len(r) > 2] or [r[1] for r in rows])
    assert np.array_equal(batch.values("z")[known], np.array([r[1] for r in rows])[known])


@pytest.mark.parametrize("header", [(), ("t", "front", "z"), ("Time (sec)", " Temperature 1", " z")])
def test_columns_by_position_whatever_the_header_says(tmp_path, header):
    path = tmp_path / "run.txt"
    write_csv(path, header, [(3.0 * i, 20.0 + i, -1.0 * i) for i in range(20)], encoding="utf-8-sig")
    machine = machine_for(0, 1, 2)
    batch = only(path, machine)
    assert batch.repairs["rows_in"] == 20 and batch.repairs.get("preamble_rows", 0) == bool(header)
    assert batch.values("front")[0] == 20.0 and batch.values("z")[0] == 0.0
    assert (batch.values("front")[-1], batch.values("z")[-1]) == (36.5, -16.5)  # at 50 s: rows 15 to 18


@SAFE
@given(rows=tables)
def test_xlsx_and_parquet_give_what_csv_gives(tmp_path, rows):
    frame = pd.DataFrame([(10.0 * i, *row) for i, row in enumerate(rows)], columns=["t", "Disp. X (°C)", "z"])
    machine = machine_for("t", "Disp. X (°C)", "z")
    frame.to_csv(tmp_path / "run.csv", index=False)
    frame.to_parquet(tmp_path / "run.parquet")
    frame.to_excel(tmp_path / "run.xlsx", index=False)
    first = only(tmp_path / "run.csv", machine)
    for name in ("run.parquet", "run.xlsx"):
        other = only(tmp_path / name, machine)
        pd.testing.assert_frame_equal(first.table, other.table)
        assert {**first.repairs} == {**other.repairs}


def test_text_cells_are_read_where_one_reading_is_possible_else_counted(tmp_path):
    cells = ["1,5", "1.234,5", "n/a", "---", "2.345", " 7 ", "NaN", "", "-1,2e1", "OL", "1e999", "3"]
    read = [1.5, 1234.5, None, None, None, 7.0, None, None, -12.0, None, None, 3.0]
    batch = of_text(tmp_path, "t;front;z\n" + "".join(f"{10 * i};{c};{i},5\n" for i, c in enumerate(cells)))
    known = [i for i, x in enumerate(read) if x is not None]
    assert batch.values("front")[known].tolist() == [read[i] for i in known]
    assert batch.values("z").tolist() == [i + 0.5 for i in range(12)]
    assert batch.repairs["unparsable_values"] == 5  # n/a, ---, 2.345 (could be 2345), OL, 1e999


@pytest.mark.parametrize(
    ("text", "decimal", "value"),
    [
        ("12.5", ".", 12.5), ("12,5", ".", 12.5), ("1,234", ".", None), ("1,234.5", ".", 1234.5),
        ("1.234.567", ".", 1234567.0), ("1.234", ",", None), ("−3,5", ",", -3.5), ("+4", ",", 4.0), (".5", ".", 0.5),
        ("inf", ".", None), ("12 mm", ".", None), ("0x10", ".", None), ("1_000", ".", None), ("٣", ".", None),
        (True, ".", None), (3, ".", 3.0), (float("nan"), ".", None),
    ],
)  # fmt: skip
def test_one_cell(text, decimal, value):
    assert parse_number(text, decimal) == value


def test_trailing_separators_blank_lines_and_cut_rows(tmp_path):
    batch = of_text(tmp_path, "t,front,z\n0,20,1,\n\n10,21,2,\n20,22,3,\n30,23\n40,24,5,\n50,2")
    assert batch.values("z").tolist() == [1, 2, 3, 4, 5]
    assert batch.repairs["ragged_rows"] == 2
    assert batch.repairs["rows_in"] == 6
    assert batch.repairs["rows_dropped"] == 2


def test_a_lone_quote_loses_no_row_silently(tmp_path):
    rows = [f'{10 * i},"20",{i}' for i in range(40)]
    rows[20] = '200,"20,20'
    batch = of_text(tmp_path, "t,front,z\n" + "\n".join(rows) + "\n")
    assert batch.repairs["rows_in"] == 40 == batch.repairs["rows_used"] + batch.repairs["rows_dropped"]


def test_thousands_of_title_lines(tmp_path):
    path = tmp_path / "run.csv"
    write_csv(path, ("t", "front", "z"), [(10 * i, 20, i) for i in range(5)], before=["# channel list, z"] * 5000)
    batch = only(path, machine_for("t", "front", "z"))
    assert batch.repairs["preamble_rows"] == 5000
    assert batch.values("z").tolist() == [0, 1, 2, 3, 4]


def test_blocks_end_where_lines_end(tmp_path, monkeypatch):
    monkeypatch.setattr("data.readers.csv._BLOCK_BYTES", 64)
    rows = [(10 * i, 20 + i / 10, i) for i in range(100)]
    for encoding, names in NAMES.items():
        write_csv(tmp_path / "run.csv", names, rows, encoding=encoding, newline="\r\n")
        batch = only(tmp_path / "run.csv", machine_for(*names))
        assert batch.values("z").tolist() == list(range(100)), encoding
        assert batch.repairs["rows_in"] == 100


def test_encoding_is_settled_by_the_expected_names(tmp_path):
    path = tmp_path / "run.csv"
    for encoding, names in NAMES.items():
        write_csv(path, names, [(0, 1, 2)], encoding=encoding)
        head = CsvSheet(path, names, Form()).head[0]
        assert tuple(c.strip("\ufeff") for c in head) == names, encoding
        unaided = CsvSheet(path, (), Form()).head[0]
        assert tuple(c.strip("\ufeff") for c in unaided) == names, encoding


STAMPS = ("%Y-%m-%d %H:%M:%S", "%Y-%m-%dT%H:%M:%S.%f", "%d.%m.%Y %H:%M:%S", "%Y/%m/%d %H:%M", "%Y年%m月%d日 %H:%M:%S",
          "%H:%M:%S", "%d%m%y-%H%M%S")  # fmt: skip
UNKNOWN = STAMPS[-1]  # must be given


@pytest.mark.parametrize("pattern", STAMPS)
def test_timestamps_as_text(tmp_path, pattern):
    begin = pd.Timestamp("2024-11-27 23:58:00")
    stamps = [begin + pd.Timedelta(minutes=i) for i in range(6)]
    path = tmp_path / "run.csv"
    path.write_text("t;front;z\n" + "".join(f"{s.strftime(pattern)};20,5;{i},5\n" for i, s in enumerate(stamps)))
    text = "unit: timestamp" + f", format: '{pattern}'" * (pattern == UNKNOWN)
    machine = parse_machine(
        f"{{machine: mill, recording: {{time: {{column: t, {text}}}, step_s: 60}}, channels: {{"
        "front: {role: temperature, unit: degC}, z: {role: error, unit: um}}}",
        "test",
    )
    batch = only(path, machine)
    assert batch.values("z").tolist() == [i + 0.5 for i in range(6)]
    assert batch.start == (None if pattern == "%H:%M:%S" else begin)


def test_day_and_month_that_cannot_be_told_apart_are_asked_for(tmp_path):
    assert len(stamp_formats(["05/06/2024 10:00", "05/06/2024 10:01"])) == 2
    assert stamp_formats(["13/06/2024 10:00", "13/06/2024 10:01"]) == ["%d/%m/%Y %H:%M"]
    with pytest.raises(InputError, match=r"'%d/%m/%Y %H:%M' or '%m/%d/%Y %H:%M'; set recording.time.format"):
        of_text(tmp_path, "t,front,z\n05/06/2024 10:00,20,1\n05/06/2024 10:01,20,2\n", "timestamp")


def test_stamps_with_an_offset_do_not_jump_with_summer_time(tmp_path):
    stamps = ("2024-10-27T02:59:50+02:00", "2024-10-27T02:00:00+01:00", "2024-10-27T02:00:10+01:00")
    rows = "".join(f"{stamp},20,{i}\n" for i, stamp in enumerate(stamps, 1))
    batch = of_text(tmp_path, f"t,front,z\n{rows}", "timestamp")
    assert batch.values("z").tolist() == [1, 2, 3]
    assert batch.start == pd.Timestamp("2024-10-27 02:59:50")  # as the wall clock shows it


@pytest.mark.parametrize("unit", ["s", "min", "h"])
def test_numeric_time_units(tmp_path, unit):
    seconds = {"s": 1.0, "min": 60.0, "h": 3600.0}[unit]
    path = tmp_path / "run.csv"
    write_csv(path, ("t", "front", "z"), [(10.0 * i / seconds, 20.0, float(i)) for i in range(50)])
    batch = only(path, machine_for("t", "front", "z", unit=unit))
    assert np.allclose(batch.values("z"), np.arange(50), atol=1e-9)


def test_excel_dates_durations_and_serial_numbers(tmp_path):
    begin = dt.datetime(2024, 2, 28, 23, 59, 0)
    times = [begin + dt.timedelta(seconds=10 * i) for i in range(12)]
    serial = [(t - dt.datetime(1899, 12, 30)).total_seconds() / 86400 for t in times]
    durations = [dt.timedelta(seconds=10 * i) for i in range(12)]
    for cells, start in ((times, begin), (serial, begin), (durations, None), ([t.isoformat() for t in times], begin)):
        book = openpyxl.Workbook()
        book.active.append(["t", "front", "z"])
        for i, t in enumerate(cells):
            book.active.append([t, 20.0 if i != 3 else "#N/A", i])
        book.save(tmp_path / "run.xlsx")
        batch = only(tmp_path / "run.xlsx", machine_for("t", "front", "z", unit="timestamp"))
        assert np.allclose(batch.values("z"), np.arange(12), atol=1e-4)
        assert batch.repairs["unparsable_values"] == 1
        assert (batch.start is None) if start is None else abs(batch.start - start) < pd.Timedelta("1ms")


def test_parquet_kinds_of_columns(tmp_path):
    stamps = pd.date_range("2024-05-01", periods=20, freq="10s", tz="Europe/Berlin")
    frame = pd.DataFrame({"t": stamps, "front": pd.array(range(20), "Int32"), "z": [f"{i},5" for i in range(20)]})
    frame.loc[4, "front"] = pd.NA
    frame.to_parquet(tmp_path / "run.parquet")
    batch = only(tmp_path / "run.parquet", machine_for("t", "front", "z", unit="timestamp"))
    assert batch.values("front").tolist() == list(range(20))  # row 4 is interpolated over 20 s
    assert batch.values("z").tolist() == [i + 0.5 for i in range(20)]
    assert batch.start == pd.Timestamp("2024-05-01 00:00:00")  # as the wall clock shows it


def test_unknown_suffix_lists_the_known_ones():
    with pytest.raises(
        InputError, match=r"run\.doc: unsupported file extension '\.doc'; expected one of \.csv, \.xlsx, \.parquet"
    ):
        reader_for(Path("run.doc"))
    assert type(reader_for(Path("RUN.CSV"))) is READERS["csv"]


def test_a_block_without_any_whole_row(tmp_path, monkeypatch):
    monkeypatch.setattr("data.readers.csv._BLOCK_BYTES", 32)
    batch = of_text(tmp_path, "t,front,z\n" + "0,1\n" * 20 + "".join(f"{10 * i},20,{i}\n" for i in range(50)))
    assert batch.values("z").tolist() == list(range(50))
    assert (batch.repairs["ragged_rows"], batch.repairs["rows_in"]) == (20, 70)
