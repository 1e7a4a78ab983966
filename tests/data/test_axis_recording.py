"""Errors at positions along an axis: from both usual shapes of file through the machine file into the lake and back."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from data.checks import check_batch
from data.errors import InputError
from data.ingest import ingest
from data.lake import Lake
from data.machine import Machine, parse_machine
from data.recording import read_batches
from data.sweeps import Readings, position_bins, sweep_numbers
from features.rises import zeroed_error_um

AT_MM = np.array([0.0, 60.0, 120.0, 180.0])
SWEEPS_MIN = (0, 30, 60)
LONG = """
machine: lathe
recording: {time: {column: time, unit: min}, step_s: 10, max_gap_s: 120}
channels:
  nut: {role: temperature, unit: degC}
  x_at: {role: position, unit: mm, column: P, unit_in_file: cm}
  x: {role: error, unit: um, column: deviation, unit_in_file: mm, position: x_at}
"""
WIDE = """
machine: lathe
recording: {time: {column: time, unit: min}, step_s: 10, max_gap_s: 120}
channels:
  nut: {role: temperature, unit: degC}
  x_at: {role: position, unit: mm}
  x: {role: error, unit: um, columns: "x = * mm", position: x_at}
"""


def error_um(position_mm, time_min):
    return (4.0 + 0.02 * position_mm) * time_min / 30.0 + 0.1 * position_mm


def nut(time_min):
    return 20.0 + 0.1 * np.asarray(time_min, float)


def long_table(one_stamp: bool = True) -> pd.DataFrame:
    """Temperatures every minute; a sweep of four positions at 0, 30 and 60 min."""
    log = pd.DataFrame({"time": np.arange(64.0)})
    sweeps = [
        pd.DataFrame({"time": t + (0 if one_stamp else np.arange(4) / 6), "P": AT_MM / 10,
                      "deviation": error_um(AT_MM, t) / 1000})
        for t in SWEEPS_MIN
    ]  # fmt: skip
    log = log[~log["time"].isin(SWEEPS_MIN)]
    table = pd.concat([log, *sweeps]).sort_values("time", kind="stable")
    return table.assign(nut=nut(table["time"]))


def wide_table() -> pd.DataFrame:
    time = np.arange(64.0)
    table = pd.DataFrame({"time": time, "nut": nut(time)})
    for p in AT_MM:
        table[f"X={p:g}mm"] = np.where(np.isin(time, SWEEPS_MIN), error_um(p, time), np.nan)
    return table


def read(path: Path, table: pd.DataFrame, text: str):
    table.to_csv(path, index=False)
    (batch,) = read_batches(path, parse_machine(text, "test"))
    return batch


def adds_up(batch, n: int) -> None:
    r = batch.repairs
    assert r["rows_in"] == n == r["rows_used"] + r["rows_dropped"]


@pytest.mark.parametrize("one_stamp", [True, False])
def test_rows_of_a_sweep_stand_one_below_the_other(tmp_path, one_stamp) -> None:
    table = long_table(one_stamp)
    batch = read(tmp_path / "a.csv", table, LONG)
    rows = np.flatnonzero(np.isfinite(batch.values("x")))
    first = [0, 178, 358] if one_stamp else [0, 180, 360]  # around 30 and 60 min, from the start at 0
    assert rows.tolist() == [r + k for r in first for k in range(4)]
    assert batch.values("x_at")[rows] == pytest.approx(np.tile(AT_MM, 3))
    assert np.isnan(batch.values("x_at")).sum() == batch.n_rows - 12
    assert batch.values("x")[rows] == pytest.approx(np.concatenate([error_um(AT_MM, t) for t in SWEEPS_MIN]))
    assert batch.values("nut") == pytest.approx(nut(batch.time_s / 60))  # goes on in its own rows
    assert batch.channels["x"].position == "x_at" and batch.channels["x_at"].position == ""
    adds_up(batch, len(table))
    assert batch.repairs["rows_dropped"] == 0 == batch.repairs["duplicates"] and batch.repairs["readings"] == 12


@pytest.mark.parametrize("suffix", ["csv", "xlsx", "parquet"])
def test_a_column_for_each_position_is_the_same_recording(tmp_path, suffix) -> None:
    long, path = read(tmp_path / "long.csv", long_table(), LONG), tmp_path / f"wide.{suffix}"
    table = wide_table()
    {"csv": table.to_csv, "xlsx": table.to_excel, "parquet": table.to_parquet}[suffix](path, index=False)
    named = WIDE.replace('"x = * mm"', "{X=0mm: 0, X=60mm: 60, X=120mm: 120, X=180mm: 180}")
    for text in (WIDE, named):
        (wide,) = read_batches(path, parse_machine(text, "test"))
        pd.testing.assert_frame_equal(wide.table[["time_s", "x_at", "x"]], long.table[["time_s", "x_at", "x"]])
        adds_up(wide, len(table))
        assert wide.repairs["readings"] == 12 and "missing_channels" not in wide.repairs
        assert "unknown_columns" not in wide.repairs


def test_headers_that_are_the_positions_alone(tmp_path) -> None:
    table = wide_table().rename(columns=lambda c: c.removeprefix("X=").removesuffix("mm"))
    bare = read(tmp_path / "a.csv", table, WIDE.replace('"x = * mm"', '"*"'))
    long = read(tmp_path / "long.csv", long_table(), LONG)
    assert np.array_equal(bare.values("x"), long.values("x"), equal_nan=True)


def test_columns_without_a_header_are_named_by_their_place(tmp_path) -> None:
    wide_table().to_csv(tmp_path / "w.csv", index=False, header=False)
    text = WIDE.replace("{time: {column: time", "{header: false, time: {column: 0").replace(
        "unit: degC}", "unit: degC, column: 1}"
    )
    text = text.replace('"x = * mm"', "{2: 0, 3: 60, 4: 120, 5: 180}")
    (batch,) = read_batches(tmp_path / "w.csv", parse_machine(text, "test"))
    long = read(tmp_path / "long.csv", long_table(), LONG)
    assert np.array_equal(batch.values("x"), long.values("x"), equal_nan=True)


def test_two_axes_have_sweeps_of_their_own(tmp_path) -> None:
    text = LONG + "  z_at: {role: position, unit: mm}\n  z: {role: error, unit: um, position: z_at}\n"
    table = long_table(one_stamp=False)
    table["z_at"] = np.where(table["time"].isin([10, 11, 40, 41]), -500 + 100 * (table["time"] % 10), np.nan)
    table["z"] = np.where(np.isfinite(table["z_at"]), table["time"], np.nan)
    batch = read(tmp_path / "a.csv", table, text)
    rows = np.flatnonzero(np.isfinite(batch.values("z")))
    assert rows.tolist() == [60, 66, 240, 246] and batch.values("z_at")[rows].tolist() == [-500, -400, -500, -400]
    assert np.isfinite(batch.values("x")).sum() == 12
    assert zeroed_error_um(batch, "z")[rows].tolist() == [0, 0, 30, 30]


def test_from_the_file_through_the_lake_nothing_changes(tmp_path) -> None:
    machine = parse_machine(LONG, "test")
    long_table().to_csv(tmp_path / "a.csv", index=False)
    lake = Lake(tmp_path / "lake")
    report = ingest([tmp_path / "a.csv"], machine, lake)
    assert [r.status for r in report.rows] == ["new"] and report.rows[0].findings == 0
    stored = lake.load("lathe", "a")
    (read_again,) = read_batches(tmp_path / "a.csv", machine)
    pd.testing.assert_frame_equal(stored.table, read_again.table)
    assert stored.channels["x"].position == "x_at"
    assert [r.status for r in ingest([tmp_path / "a.csv"], machine, lake).rows] == ["unchanged"]
    (file,) = (tmp_path / "lake").glob("machine=*/year=*/*.parquet")
    for text in (LONG, WIDE):  # the lake's own files are read as they stand, whatever the recordings look like
        (own,) = read_batches(file, parse_machine(text, "test"))
        pd.testing.assert_frame_equal(own.table[["x_at", "x"]], stored.table[["x_at", "x"]])


def test_sound_sweeps_raise_no_finding_and_a_wild_reading_does(tmp_path) -> None:
    text = LONG.replace("unit_in_file: mm, ", "unit_in_file: mm, range: [-500, 500], ")
    table = long_table()
    machine = parse_machine(text, "test")
    assert check_batch(read(tmp_path / "a.csv", table, text), machine) == ()
    table.loc[(table["time"] == 30) & (table["P"] == 6), "deviation"] = 7.0
    batch = read(tmp_path / "a.csv", table, text)
    (finding,) = check_batch(batch, machine)
    assert (finding.check, finding.channel, finding.start_s) == ("out_of_range", "x", 1790.0)


def test_a_recording_to_predict_keeps_its_positions(tmp_path) -> None:
    table = pd.DataFrame({"time": np.arange(20.0), "nut": 20.0, "P": np.linspace(0, 18, 20)})
    table.to_csv(tmp_path / "a.csv", index=False)
    (batch,) = read_batches(tmp_path / "a.csv", parse_machine(LONG, "test"), need_error=False)
    assert batch.values("x_at")[::6] == pytest.approx(np.linspace(0, 180, 20))
    assert np.isnan(batch.values("x")).all()


def test_an_error_without_a_position_is_counted_and_one_without_any_refused(tmp_path) -> None:
    table = long_table()
    table.loc[(table["time"] == 30) & (table["P"] == 6), "P"] = np.nan
    batch = read(tmp_path / "a.csv", table, LONG)
    assert batch.repairs["readings_without_position"] == 1 and batch.repairs["readings"] == 11
    adds_up(batch, len(table))
    with pytest.raises(
        InputError, match=r"a.csv: x is measured along 'x_at', which the file does not have; correct col"
    ):
        read(tmp_path / "a.csv", table.drop(columns="P"), LONG)
    with pytest.raises(InputError, match=r"a.csv: no error channel; got 'time', 'nut'.*, expected column 'x = \* mm'"):
        read(tmp_path / "a.csv", long_table()[["time", "nut"]], WIDE)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("position: x_at", "position: x_att"), "'x': position 'x_att' is no channel, expected a channel with role"),
        (("position: x_at", "position: x_att"), "did you mean 'x_at'? Allowed: x_at"),
        (("position: x_at", "position: nut"), "position 'nut' is a temperature, expected a channel with role"),
        (("role: error", "role: driver"), "channel 'x' is a driver and has a position; only error channels"),
        (("unit: mm, column: P, unit_in_file: cm", "unit: cm, column: P"),
         "position channel 'x_at' has unit 'cm', expected 'mm'; write unit: mm and unit_in_file: 'cm'"),
        ((", position: x_at", ', columns: "x=*"'), "channel 'x' has columns but no position; add position:"),
        (("role: temperature", "role: temperature, fixed_end: 0"), "'nut' is a temperature and has a fixed_end; give"),
        (("column: deviation", 'columns: "x="'), "columns 'x=', expected a header's pattern with one * where the pos"),
        (("column: deviation", 'column: d, columns: "x=*"'), "has both column and columns; leave column: out"),
        (("column: deviation, unit_in_file: mm, position: x_at}",
          'columns: "x=*", position: x_at}\n  y: {role: error, unit: um, position: x_at}'),
         "one column for each position, but position channel 'x_at' also serves 'y'; give it a position channel alone"),
    ],
)  # fmt: skip
def test_what_does_not_fit_together_is_told_in_one_line(change, words) -> None:
    with pytest.raises(InputError) as caught:
        parse_machine(LONG.replace(*change), "m.yml")
    said = str(caught.value)
    assert said.startswith("machine file m.yml: channel ") and words in said and "\n" not in said


def test_the_machine_says_what_is_measured_along_which_axis() -> None:
    assert parse_machine(LONG, "m").axes() == {"x_at": ("x",)}
    assert Machine.model_validate({"machine": "m", "channels": {"z": {"role": "error", "unit": "um"}}}).axes() == {}


def readings(time_s, position, error) -> Readings:
    t, p, e = (np.asarray(v, float) for v in (time_s, position, error))
    return Readings("x_at", t, p, {"x": e}, np.arange(len(t)))


def test_positions_that_a_laser_sees_twice_are_one_position() -> None:
    there, back = np.linspace(0, 180, 12) + 2e-4, np.linspace(180, 0, 12) - 3e-4
    bins = position_bins(np.concatenate([there, back]))
    assert bins[:12].tolist() == bins[12:][::-1].tolist() and len(set(bins)) == 12
    assert position_bins(np.full(3, 7.0)).tolist() == [0, 0, 0] and position_bins(np.empty(0)).tolist() == []


@pytest.mark.parametrize(
    ("time_min", "position", "sweeps"),
    [
        ([0, 0, 0, 30, 30, 30], [0, 90, 180, 0, 90, 180], [0, 0, 0, 1, 1, 1]),  # one stamp a sweep
        ([0, 1, 2, 30, 31, 32], [0, 90, 180, 180, 90, 0], [0, 0, 0, 1, 1, 1]),  # every other one backward
        ([0, 1, 2, 30, 31, 32], [0, 90, 180, 0, 180, 90], [0, 0, 0, 1, 1, 1]),
        ([0, 1, 2, 3, 4, 30], [0, 90, 180, 180, 90, 0], [0, 0, 0, 0, 1, 1]),  # the turn at 180 belongs to the way there
        ([0, 1, 2, 3, 30, 31], [0, 0, 90, 180, 0, 90], [0, 0, 0, 0, 1, 1]),  # a dwell
        ([0, 9, 10, 11, 30, 31], [0, 90, 120, 180, 0, 90], [0, 0, 0, 0, 1, 1]),  # a break within a sweep ends none
        ([0, 10, 20, 30], [0, 180, 0, 180], [0, 0, 1, 1]),  # two ends, again and again
        ([0], [90], [0]),
        ([], [], []),
    ],
)
def test_a_sweep_ends_where_a_position_comes_back(time_min, position, sweeps) -> None:
    assert sweep_numbers(60.0 * np.array(time_min), np.array(position, float)).tolist() == sweeps


def test_readings_with_stamps_of_their_own_stand_at_them() -> None:
    out = readings([0, 12, 21, 95, 104], [0, 90, 180, 0, 90], [1, 2, 3, 4, 5]).on_grid(10.0, 12, 30.0, "a.csv")
    nan = np.nan
    assert np.array_equal(out["x_at"], [0, 90, 180, *[nan] * 6, 0, 90, nan], equal_nan=True)
    assert np.array_equal(out["x"], [1, 2, 3, *[nan] * 6, 4, 5, nan], equal_nan=True)


def test_a_sweep_under_one_stamp_lies_around_it_and_inside_the_recording() -> None:
    five = np.arange(5.0)
    r = readings(np.repeat([0.0, 200, 390], 5), np.tile(five, 3), np.arange(15.0))
    out = r.on_grid(10.0, 40, 60.0, "a.csv")
    rows = np.flatnonzero(np.isfinite(out["x"]))
    # the first begins at 0 s and the last ends with the recording; the one between stands 20 s to both sides
    assert rows.tolist() == [0, 1, 2, 3, 4, 18, 19, 20, 21, 22, 35, 36, 37, 38, 39]
    assert out["x"][rows].tolist() == list(range(15)) and out["x_at"][rows].tolist() == np.tile(five, 3).tolist()


def test_readings_of_one_position_in_one_row_are_averaged() -> None:
    both_ways = readings([0] * 5 + [100] * 5, [0, 9, 18, 9, 0] * 2, [0, 1, 2, 3, 4, 10, 11, 12, 13, 14])
    out = both_ways.on_grid(10.0, 20, 60.0, "a.csv")
    there = np.isfinite(out["x"])
    assert out["x_at"][there].tolist() == [0, 9, 18, 0, 9, 18] and out["x"][there].tolist() == [2, 2, 2, 12, 12, 12]
    dwell = readings([0, 1, 2, 10, 11, 12], [0, 0, 0, 9, 9, 9], [3, np.nan, 5, 7, 8, 9]).on_grid(10.0, 3, 60.0, "a.csv")
    assert dwell["x"][:2].tolist() == [4, 8] and dwell["x_at"][:2].tolist() == [0, 9]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(0, 300), min_size=1, max_size=6, unique=True), st.integers(1, 9), st.booleans())
def test_no_reading_is_lost_or_moved_past_another(starts, n, one_stamp) -> None:
    stamps = np.sort(np.array(starts, float))
    time_s = np.repeat(stamps, n) if one_stamp else np.sort(np.concatenate([stamps + 1000 * k for k in range(n)]))
    positions = np.tile(np.arange(n, dtype=float), len(starts))
    error = np.arange(len(time_s), dtype=float)
    n_rows = len(time_s) + 1000
    out = readings(time_s, positions, error).on_grid(1.0, n_rows, 1e9, "a.csv")
    kept = out["x"][np.isfinite(out["x"])]
    assert np.all(np.diff(kept) > 0)
    if n == 1 or one_stamp:
        assert kept.tolist() == error.tolist()


def test_the_rows_are_the_nearest_in_the_sum_of_squares() -> None:
    time_s = np.array([0.0, 3, 3, 3, 4])
    out = readings(time_s, [0, 1, 2, 3, 4], range(5)).on_grid(1.0, 8, 60.0, "a.csv")
    rows = np.flatnonzero(np.isfinite(out["x"]))
    best = min(combinations(range(8), 5), key=lambda r: float(((np.array(r) - time_s) ** 2).sum()))
    assert float(((rows - time_s) ** 2).sum()) == float(((np.array(best) - time_s) ** 2).sum())


def test_a_step_too_long_for_sweeps_is_one_clear_line() -> None:
    twelve = readings(np.zeros(12), np.arange(12.0), np.arange(12.0))
    with pytest.raises(InputError, match=r"^a.csv: 12 readings along x_at for 9 rows: recording.step_s is 60 s; lower"):
        twelve.on_grid(60.0, 9, 300.0, "a.csv")
    with pytest.raises(
        InputError,
        match=r"a reading along x_at would stand 660 s from its time, expected at most recording.max_gap_s \(300 s\): "
        "recording.step_s is 60 s; lower it, a sweep takes one row for each position",
    ):
        twelve.on_grid(60.0, 90, 300.0, "a.csv")
