"""The draft of a machine file: it reads back the files it was drafted from, and marks what it guessed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest

from data import guess
from data.describe import drafted, notes
from data.errors import InputError
from data.machine import Machine, parse_machine
from data.peek import look
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
    text = drafted(files)[0]
    return text, parse_machine(text, "draft")


def draft_of(folder, table):
    """The draft of one table, and what it reads of it."""
    table.to_csv(folder / "a.csv", index=False)
    text, machine = draft([folder / "a.csv"])
    return text, machine, next(read_batches(folder / "a.csv", machine))


@pytest.mark.parametrize(
    ("named", "name"), [("", "my_runs"), ("My Lathe 3", "my_lathe_3"), ("_", "machine"), ("m" * 99, "m" * 80)]
)
def test_the_machine_has_the_name_of_the_file_and_without_one_of_the_folder(tmp_path, named, name):
    (tmp_path / "My Runs").mkdir()
    run(0).to_csv(tmp_path / "My Runs" / "a.csv", index=False)
    text = drafted([tmp_path / "My Runs" / "a.csv"], named=named)[0]
    assert parse_machine(text, "draft").machine == name
    assert f"machine: {name}  # {'the name of this file' if named else 'guessed'}" in text


@pytest.mark.parametrize("suffix", ["csv", pytest.param("xlsx", marks=pytest.mark.slow), "parquet"])
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
        assert np.allclose(batch.values("Oil"), table["Oil [K]"] - 273.15, atol=1e-6)
        assert batch.repairs["rows_dropped"] == 0 == batch.repairs.get("unknown_columns", 0)


def test_every_guess_is_marked_on_its_line_and_in_the_list(tmp_path):
    text, machine, _ = draft_of(tmp_path, run(1))
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
    assert {n: c.role for n, c in machine.channels.items()} == {"主轴温度": "temperature", "位移X": "error"}
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
        drafted([])
    (tmp_path / "a.csv").write_text("hello\nworld\n")
    with pytest.raises(InputError, match=r"^a.csv: no table of numbers found; expected a time column and channels"):
        drafted([tmp_path / "a.csv"])
    with pytest.raises(InputError, match=r"gone\.csv: no such file"):
        drafted([tmp_path / "gone.csv"])


@pytest.mark.parametrize("step", [0.1, 0.25, 0.02, 1.0, 0.488])
def test_resolution_is_the_step_of_the_lattice(step):
    rng = np.random.default_rng(3)
    assert guess.resolution(np.round(rng.normal(20 / step, 8, 500)) * step) == pytest.approx(step)
    assert guess.resolution(rng.normal(20, 5, 500)) is None


def warm_up(clock: str, step: float = 1.0, n: int = 300, **more) -> pd.DataFrame:
    """A warm-up of the spindle with a time constant of an hour if the steps are minutes."""
    t = np.arange(n) * step
    rise = 12 * (1 - np.exp(-np.arange(n) / 60))
    table = {clock: t, "Spindle temp": np.round(20 + rise, 2), "dz [um]": np.round(3 * rise, 1), **more}
    return pd.DataFrame(table)


@pytest.mark.parametrize(
    ("clock", "unit"),
    [
        ("Minutes", "min"), ("Zeit in Minuten", "min"), ("Minuten seit Start", "min"), ("Zeit/min", "min"),
        ("时间(分)", "min"), ("经过分钟", "min"), ("時間（分）", "min"), ("Tiempo (minutos)", "min"),
        ("Temps en minutes", "min"),
        ("Tempo [minuti]", "min"), ("t_min", "min"), ("t [s]", "s"), ("Sekunden", "s"), ("経過秒数", "s"),
        ("Stunden", "h"), ("Temps (heures)", "h"), ("Laufzeit h", "h"), ("Time [ms]", "ms"), ("días", "d"),
    ],
)  # fmt: skip
def test_the_unit_of_time_is_read_from_the_header(tmp_path, clock, unit):
    per_minute = {"s": 60, "min": 1, "h": 1 / 60, "ms": 60_000, "d": 1 / 1440}[unit]
    text, machine, batch = draft_of(tmp_path, warm_up(clock, per_minute))
    assert (machine.recording.time.column, machine.recording.time.unit) == (clock, unit)
    assert machine.recording.step_s == 60 and "# check" not in text
    assert batch.time_s[-1] == pytest.approx(299 * 60)


@pytest.mark.parametrize(
    ("clock", "step", "unit", "words"),
    [
        ("Time", 1.0, "min", "no header gives the unit of time; steps of 1 over 299 are taken for min; s would give"),
        ("Time", 60.0, "s", "no header gives the unit of time; steps of 60 over 1.794e+04 are taken for s"),
        (
            "Time [s]",
            1.0,
            "s",
            "the header's unit of time s gives a recording of 0.0831 h and temperatures that change",
        ),
    ],
)
def test_an_unknown_or_implausible_unit_of_time_is_pointed_out(tmp_path, clock, step, unit, words):
    text, machine, _ = draft_of(tmp_path, warm_up(clock, step))
    assert machine.recording.time.unit == unit
    (said,) = notes(text)
    assert said.startswith(words)


@pytest.mark.parametrize("counter", [None, "No.", "Nr", "index", "序号", "Unnamed: 0"])
def test_without_a_clock_the_draft_asks_for_the_step(tmp_path, counter):
    table = warm_up("x").drop(columns="x").assign(T9=20 + np.arange(300) * 1.01e-4)  # rises with every row
    if counter is not None:
        table.insert(0, counter, np.arange(300))
    table.to_csv(tmp_path / "a.csv", index=False)
    text = drafted([tmp_path / "a.csv"])[0]
    assert notes(text) == ["no column is a clock: write the time between two rows as recording.time.step, such as 60 s"]
    with pytest.raises(InputError, match=r"line \d+: key 'recording.time': .*the time between two rows"):
        parse_machine(text, "draft")
    machine = parse_machine(text.replace("? s", "1 min"), "draft")
    assert {"T9", "Spindle_temp", "dz"} == {*machine.channels}
    assert machine.ignore == ([] if counter is None else [counter])
    (batch,) = read_batches(tmp_path / "a.csv", machine)
    assert batch.time_s.tolist() == [60.0 * i for i in range(300)]


def test_columns_that_are_no_clock(tmp_path):
    rng = np.random.default_rng(5)
    warm = 20 + 12 * (1 - np.exp(-np.arange(400) / 60))
    for header, values in (("T9", 20 + np.arange(400) * 1e-4), ("Weg", np.arange(400.0)), ("a", warm),
                           ("a", np.cumsum(rng.exponential(1, 400)))):  # fmt: skip
        pd.DataFrame({header: values, "b": 1.0}).to_csv(tmp_path / "a.csv", index=False)
        (table,) = look(tmp_path / "a.csv")
        assert table.time is None


@pytest.mark.parametrize(
    "form",
    [
        "%Y/%m/%d-%H:%M:%S",
        *(pytest.param(f, marks=pytest.mark.slow) for f in ("%Y-%m-%d_%H-%M-%S", "%d.%m.%Y, %H:%M:%S")),
        "%Y%m%d-%H%M%S",
    ],
)
def test_spellings_of_time_stamps(tmp_path, form):
    stamps = pd.date_range("2021-06-15 23:04:41", periods=300, freq="min")
    table = warm_up("Stamp").assign(Stamp=stamps.strftime(form))
    table.to_csv(tmp_path / "a.csv", index=False)
    _, machine = draft([tmp_path / "a.csv"])
    for m in (machine, parse_machine("machine: m\nrecording: {time: {column: Stamp, unit: timestamp}}\nchannels: "
                                     "{z: {role: error, unit: um, column: 'dz [um]'}}", "m")):  # fmt: skip
        (batch,) = read_batches(tmp_path / "a.csv", m)
        assert batch.start == stamps[0] and batch.n_rows == 300


@pytest.mark.parametrize(
    ("suffix", "start"), [pytest.param("csv", "07:00", marks=pytest.mark.slow), ("csv", "22:00"), ("xlsx", "22:00")]
)
def test_dates_and_times_of_day_in_two_columns(tmp_path, suffix, start):
    stamps = pd.date_range(f"2021-06-15 {start}", periods=300, freq="min")
    table = warm_up("Uhrzeit", Datum=stamps.strftime("%d.%m.%Y")).assign(Uhrzeit=stamps.strftime("%H:%M:%S"))
    path = tmp_path / f"a.{suffix}"
    if suffix == "csv":
        table.to_csv(path, index=False, sep=";", decimal=",")
    else:
        book = openpyxl.Workbook()
        book.active.append([*table])
        for row in table.assign(Datum=stamps.date, Uhrzeit=stamps.time).itertuples(index=False):
            book.active.append([*row])
        book.save(path)
    _, machine = draft([path])
    assert (machine.recording.time.column, machine.recording.time.date) == ("Uhrzeit", "Datum")
    assert machine.ignore == []
    (batch,) = read_batches(path, machine)
    assert batch.start == stamps[0] and batch.time_s.tolist() == [60.0 * i for i in range(300)]
    assert batch.repairs.get("unknown_columns", 0) == 0


def test_serial_numbers_of_a_workbook_are_time_stamps(tmp_path):
    _, machine, batch = draft_of(tmp_path, warm_up("Time").assign(Time=44352.25 + np.arange(300) / 1440))
    _, of_unix, _ = draft_of(tmp_path, warm_up("Ora").assign(Ora=1.7e9 + 60.0 * np.arange(300)))
    assert of_unix.recording.time.unit == "timestamp" and of_unix.recording.step_s == 60
    assert batch.start.round("s") == pd.Timestamp("2021-06-05 06:00") and machine.recording.step_s == 60


def test_empty_columns(tmp_path):
    warm_up("Minutes", oil=np.nan).to_csv(tmp_path / "a.csv", index=False)
    warm_up("Minutes", oil=25.0).to_csv(tmp_path / "b.csv", index=False)
    _, machine = draft([tmp_path / "a.csv"])
    assert machine.ignore == ["oil"]
    for order in ("ab", "ba"):
        _, machine = draft([tmp_path / f"{name}.csv" for name in order])
        assert "oil" in machine.channels and not machine.ignore


def test_codes_for_no_value_are_no_readings(tmp_path):
    table = warm_up("Minutes")
    table.loc[50:54, "Spindle temp"] = -999
    table.loc[7, "dz [um]"] = 3.4e38
    text, machine, _ = draft_of(tmp_path, table)
    assert notes(text) == [
        "column 'Spindle temp': -999 (5×) is taken for a missing value",
        "column 'dz [um]': 3.4e+38 (1×) is taken for a missing value",
    ]
    warm, error = machine.channels["Spindle_temp"], machine.channels["dz"]
    assert warm.resolution == 0.01 and warm.range[0] >= -50 and error.range[1] < 1000
    assert guess.seen_range(np.append(np.linspace(20, 30, 50), 1e12)) == (20.0, 30.0)


@pytest.mark.parametrize(
    ("header", "unit"),
    [
        ("位移（微米）", "um"), ("温度℃", "degC"), ("主轴转速(转/分)", "rpm"), ("Temperatur in Grad Celsius", "degC"),
        ("Weg/µm", "um"), ("Leistung in Watt", "W"), ("変位(ミクロン)", "um"), ("Déplacement en micromètres", "um"),
        ("Velocità [giri/min]", "rpm"), ("T_min", None), ("Spindel", None), ("C", None), ("Disp. X", None),
        ("温度A", None),
    ],
)  # fmt: skip
def test_units_in_headers(header, unit):
    assert guess.channel_unit_in_name(header) == unit


# errors along an axis

AT_MM = np.linspace(0, 330, 12)
SWEEPS_MIN = np.arange(0, 241, 30)


def error_um(time_min):
    return (3 + 0.02 * AT_MM) * (1 - np.exp(-np.atleast_1d(time_min)[:, None] / 60))


def nut(time_min):
    return 20 + 5 * (1 - np.exp(-np.asarray(time_min, float) / 60))


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
    text, machine, _ = draft_of(tmp_path, pd.DataFrame(table))
    assert "position: P  # guessed: rows share a time stamp while the position changes" in text
    assert "guessed: [role, unit, position, range]" in text
    assert (machine.recording.step_s, machine.recording.max_gap_s) == (10, 9000)  # 12 rows in two minutes
    at, error = sweeps_of(tmp_path / "a.csv", machine, "deviation")
    assert np.allclose(at, AT_MM) and np.allclose(error, error_um(SWEEPS_MIN))


@pytest.mark.parametrize("pattern", ["x={:g}", "X = {:.1f} mm", "Ex @{:g}", "z {:g}", "dev at {:g}mm"])
def test_a_column_for_each_position(tmp_path: Path, pattern: str) -> None:
    table = {"time [min]": SWEEPS_MIN, "T1": nut(SWEEPS_MIN), "T2": 20.0 + SWEEPS_MIN / 100, "T3": 21.0}
    table |= {pattern.format(p): e for p, e in zip(AT_MM, error_um(SWEEPS_MIN).T, strict=True)}
    text, machine, _ = draft_of(tmp_path, pd.DataFrame(table))
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
    _, machine, _ = draft_of(tmp_path, pd.DataFrame(table))
    assert machine.channels["P"].role == "position" and machine.channels["dz"].position is None
    assert machine.recording.step_s == 60
