"""Recordings in two files or sheets, and files that a prediction does not need."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.describe import drafted
from data.errors import InputError
from data.machine import Machine, parse_machine
from data.recording import read_batches, recording_files

CHANNELS = """
channels:
  front: {role: temperature, unit: degC}
  bed: {role: temperature, unit: degC}
  z: {role: error, unit: um, column: dz, source: errors}
"""
DAY = pd.Timestamp("2024-03-01 08:00")


def machine(joined: str, recording: str = "", channels: str = CHANNELS) -> Machine:
    text = f"machine: mill\nrecording:\n  step_s: 60\n  max_gap_s: 600\n{recording}  joined: {{errors: {joined}}}\n"
    return parse_machine(text + channels, "test")


def rise(minute: np.ndarray | pd.Index) -> np.ndarray:
    return 10 * (1 - np.exp(-np.asarray(minute, float) / 60))


def temperatures(clock: str = "time_s", start: pd.Timestamp | None = None, k: int = 0) -> pd.DataFrame:
    """Three hours, every minute."""
    t = np.arange(180.0)
    times = t * 60 if start is None else start + pd.to_timedelta(t, "min")
    return pd.DataFrame({clock: times, "front": 20 + k + rise(t), "bed": 20 + k + rise(t) / 3})


def errors(clock: str = "time_s", start: pd.Timestamp | None = None, first_min: float = 0.0) -> pd.DataFrame:
    """dz = 3 µm/K of the front's rise, every four minutes."""
    t = np.arange(first_min, 180.0, 4.0)
    times = t * 60 if start is None else start + pd.to_timedelta(t, "min")
    return pd.DataFrame({clock: times, "dz": 3 * rise(t)})


def only(path: Path, m: Machine, **options: object) -> Batch:
    (batch,) = read_batches(path, m, **options)
    return batch


def check(batch: Batch, first_min: float = 0.0) -> None:
    """The error lies at its place in time, to the curvature between two readings."""
    minute = batch.time_s / 60 + first_min
    read = np.isfinite(batch.values("z"))
    assert read[0] and read.mean() > 0.95
    assert np.abs(batch.values("z") - 3 * rise(minute))[read].max() < 0.02
    assert np.abs(batch.values("front") - batch.values("front")[0] - (rise(minute) - rise(minute)[0])).max() < 0.02


def test_files_whose_names_share_the_run(tmp_path: Path) -> None:
    for k in range(2):
        temperatures(k=k).to_csv(tmp_path / f"temp_0{k}.csv", index=False)
        errors("t_min").assign(t_min=lambda e: e["t_min"] / 60).to_csv(tmp_path / f"err_0{k}.csv", index=False)
    m = machine("{file: err_*.csv, time: {column: t_min, unit: min}}", '  files: ["temp_*.csv"]\n')
    files, ignored = recording_files(tmp_path, m)
    assert [f.name for f in files] == ["temp_00.csv", "temp_01.csv"] and ignored == []
    for path in files:
        batch = only(path, m)
        check(batch)
        assert batch.repairs["joined_rows"] == 45
        assert batch.repairs["rows_in"] == 180 == batch.repairs["rows_used"] + batch.repairs["rows_dropped"]
    (tmp_path / "err_01.csv").unlink()
    with pytest.raises(InputError, match=r"temp_01\.csv: 'err_01\.csv' is missing, which holds further channels"):
        only(files[1], m)
    batch = only(files[1], m, need_error=False)
    assert np.isnan(batch.values("z")).all() and np.isfinite(batch.values("front")).all()
    assert batch.repairs["skipped_sources"] == 1


def test_the_batch_begins_where_both_files_have_begun(tmp_path: Path) -> None:
    temperatures("stamp", DAY).to_csv(tmp_path / "a.csv", index=False)
    errors("when", DAY, first_min=6.0).to_csv(tmp_path / "a_err.csv", index=False)
    m = machine(
        "{file: '*_err.csv', time: {column: when, unit: timestamp}}", "  time: {column: stamp, unit: timestamp}\n"
    )
    batch = only(tmp_path / "a.csv", m)
    assert batch.start == DAY + pd.Timedelta(minutes=6)
    check(batch, first_min=6.0)


def test_workbooks_with_a_sheet_for_each_day(tmp_path: Path) -> None:
    with pd.ExcelWriter(tmp_path / "temps.xlsx") as book, pd.ExcelWriter(tmp_path / "errors.xlsx") as other:
        for k in range(3):
            temperatures(k=k).to_excel(book, sheet_name=f"day {k}", index=False)
        for k in (2, 0, 1):
            errors().assign(dz=lambda e, k=k: e["dz"] + k).to_excel(other, sheet_name=f"day {k}", index=False)
    m = machine("{file: errors.xlsx, time: {column: time_s}}", "  files: [temps.xlsx]\n")
    batches = list(read_batches(tmp_path / "temps.xlsx", m))
    assert [b.batch_id for b in batches] == ["temps-day 0", "temps-day 1", "temps-day 2"]
    assert [b.values("z")[0] for b in batches] == pytest.approx([0, 1, 2])


def test_another_sheet_of_the_same_workbook(tmp_path: Path) -> None:
    with pd.ExcelWriter(tmp_path / "a.xlsx") as book:
        temperatures().to_excel(book, sheet_name="T", index=False)
        errors().to_excel(book, sheet_name="probe", index=False)
    check(only(tmp_path / "a.xlsx", machine("{sheet: probe, time: {column: time_s}}")))


def test_rows_of_one_long_file_by_their_time(tmp_path: Path) -> None:
    days = [DAY + pd.Timedelta(days=k) for k in range(3)]
    for k, day in enumerate(days):
        temperatures("stamp", day, k).to_csv(tmp_path / f"log{k}.csv", index=False)
    pd.concat([errors("when", day) for day in days[:2]]).to_csv(tmp_path / "probe.csv", index=False)
    m = machine(
        "{file: probe.csv, by: time, time: {column: when, unit: timestamp}}",
        "  files: ['log*.csv']\n  time: {column: stamp, unit: timestamp}\n",
    )
    for k in range(2):
        batch = only(tmp_path / f"log{k}.csv", m)
        assert batch.start == days[k] and batch.repairs["joined_rows"] == 45
        check(batch)
    with pytest.raises(InputError, match=r"log2\.csv: probe\.csv has no row at the recording's times"):
        only(tmp_path / "log2.csv", m)


def test_sheets_that_are_not_distinguished_are_named(tmp_path: Path) -> None:
    temperatures().to_csv(tmp_path / "a.csv", index=False)
    with pd.ExcelWriter(tmp_path / "e.xlsx") as book:
        for name in ("one", "two"):
            errors().to_excel(book, sheet_name=name, index=False)
    with pytest.raises(InputError, match=r"a\.csv: 2 sheets hold channels of source 'errors' \('one', 'two'\)"):
        only(tmp_path / "a.csv", machine("{file: e.xlsx, time: {column: time_s}}"))


@pytest.mark.parametrize(
    ("joined", "channels", "words"),
    [
        (
            "{file: e.csv}",
            CHANNELS.replace("source: errors", "source: errrors"),
            "unknown source 'errrors'; did you mean",
        ),
        ("{file: e.csv, by: time}", CHANNELS, "by: time compares time stamps; give time: {column"),
        ("{fil: e.csv}", CHANNELS, "line 5: unknown key 'recording.joined.errors.fil'; did you mean 'file'?"),
    ],
)
def test_mistakes_in_the_machine_file(joined: str, channels: str, words: str) -> None:
    with pytest.raises(InputError) as caught:
        machine(joined, channels=channels)
    assert words in str(caught.value)


def test_a_schedule_without_a_needed_channel_may_be_missing(tmp_path: Path) -> None:
    channels = (
        CHANNELS.replace("source: errors", "source: file") + "  rpm: {role: driver, unit: rpm, source: schedule}\n"
    )
    schedule = "{file: runs.csv, batch_column: run, stages: [{hours: h, drivers: {rpm: n}}]}"
    m = parse_machine(f"machine: mill\nrecording: {{schedule: {schedule}}}\n{channels}", "test")
    temperatures().assign(dz=0.5).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=r"schedule 'runs\.csv' is missing"):
        only(tmp_path / "a.csv", m)
    with pytest.raises(InputError, match=r"schedule 'runs\.csv' is missing"):
        only(tmp_path / "a.csv", m, need_error=False, channels=["front", "rpm"])
    batch = only(tmp_path / "a.csv", m, need_error=False, channels=["front"])
    assert np.isnan(batch.values("rpm")).all() and batch.repairs["skipped_sources"] == 1


# drafts


def as_drafted(files: list[Path]) -> tuple[str, Machine]:
    text = drafted(files)[0]
    return text, parse_machine(text, "draft")


def test_draft_of_pairs_of_files(tmp_path: Path) -> None:
    for day in ("20240301", "20240302"):
        temperatures("Zeit [min]").assign(**{"Zeit [min]": np.arange(180)}).to_csv(tmp_path / f"temp_{day}.csv")
        errors("Zeit [s]").to_csv(tmp_path / f"weg_{day}.csv", index=False)
    text, m = as_drafted(sorted(tmp_path.iterdir()))
    assert "left out" not in text
    assert m.recording.files == ["temp_*.csv"] and m.recording.start_from_name == "temp_%Y%m%d"
    assert m.recording.joined["errors"].file == "weg_*.csv" and m.recording.joined["errors"].time.unit == "s"
    assert m.channels["dz"].source == "errors" and m.channels["front"].source == "file"
    batches = [b for p in recording_files(tmp_path, m)[0] for b in read_batches(p, m)]
    assert [b.start for b in batches] == [pd.Timestamp("2024-03-01"), pd.Timestamp("2024-03-02")]
    assert all(b.repairs["joined_rows"] == 45 for b in batches)


def test_draft_of_two_workbooks_and_of_two_sheets(tmp_path: Path) -> None:
    with pd.ExcelWriter(tmp_path / "B.xlsx") as b, pd.ExcelWriter(tmp_path / "A.xlsx") as a:
        for k in range(2):
            temperatures("Datum", DAY + pd.Timedelta(days=k)).to_excel(b, sheet_name=f"d{k}", index=False)
            errors("Zeit", DAY + pd.Timedelta(days=k)).to_excel(a, sheet_name=f"d{k}", index=False)
    _, m = as_drafted([tmp_path / "A.xlsx", tmp_path / "B.xlsx"])
    assert m.recording.files == ["B.xlsx"] and m.recording.joined["errors"].file == "A.xlsx"
    assert [x.start for x in read_batches(tmp_path / "B.xlsx", m)] == [DAY, DAY + pd.Timedelta(days=1)]
    with pd.ExcelWriter(tmp_path / "days.xlsx") as book:
        for day in ("2024-03-01", "2024-03-02"):
            temperatures("t_s").merge(errors("t_s"), "left").to_excel(book, sheet_name=day, index=False)
    _, m = as_drafted([tmp_path / "days.xlsx"])
    days = [x.start for x in read_batches(tmp_path / "days.xlsx", m)]
    assert days == [pd.Timestamp("2024-03-01"), pd.Timestamp("2024-03-02")]
    with pd.ExcelWriter(tmp_path / "one.xlsx") as book:
        temperatures().to_excel(book, sheet_name="T", index=False)
        errors().to_excel(book, sheet_name="probe", index=False)
    _, m = as_drafted([tmp_path / "one.xlsx"])
    assert m.recording.joined["errors"].sheet == "probe"
    assert only(tmp_path / "one.xlsx", m).repairs["joined_rows"] == 45


def test_draft_of_one_file_of_errors_for_all_recordings(tmp_path: Path) -> None:
    days = [DAY + pd.Timedelta(days=k) for k in range(3)]
    for k, day in enumerate(days):
        temperatures("stamp", day).to_csv(tmp_path / f"log{k}.csv", index=False)
    pd.concat([errors("when", day) for day in days]).to_csv(tmp_path / "probe.csv", index=False)
    _, m = as_drafted(sorted(tmp_path.iterdir()))
    assert (m.recording.joined["errors"].by, m.recording.joined["errors"].file) == ("time", "probe.csv")
    files, _ = recording_files(tmp_path, m)
    assert [b.start for f in files for b in read_batches(f, m)] == days


def test_a_table_that_belongs_to_no_recording_is_left_out(tmp_path: Path) -> None:
    for k in range(3):
        temperatures().to_csv(tmp_path / f"2024030{k + 1}.csv", index=False)
    pd.DataFrame({"batch": [20240301, 20240302, 20240303], "rpm": [1000, 3000, 2000]}).to_csv(
        tmp_path / "runs.csv", index=False
    )
    text, m = as_drafted(sorted(tmp_path.iterdir()))
    assert (
        m.recording.joined == {} and "# left out: runs.csv: its columns are others than those of 20240301.csv" in text
    )
