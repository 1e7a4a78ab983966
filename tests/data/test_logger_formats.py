"""Formats of common loggers, phones and databases: each draft reads its own file right; keys override what is found."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.describe import drafted, notes
from data.errors import InputError
from data.machine import Form, Machine, parse_machine
from data.recording import read_batches

N = 60
START = pd.Timestamp("2026-01-14 07:30:00")
STAMPS = [START + pd.Timedelta(minutes=i) for i in range(N)]
RISE = 8 * (1 - np.exp(-np.arange(N) / 30))
FRONT, BED, Z = np.round(22 + RISE, 2), np.round(21.5 + 0.4 * RISE, 2), np.round(4.6 * RISE, 1)
Lines = Sequence[str]


def rows(form: str, comma: bool = False) -> list[str]:
    """A line for each row: {t} its stamp, {s} its seconds, {i} its number, {f}, {b}, {z} the readings."""
    lines = []
    for i, t in enumerate(STAMPS):
        cells = {"f": FRONT[i], "b": BED[i], "z": Z[i], "z_mm": Z[i] / 1e3, "F": FRONT[i] * 1.8 + 32}
        texts = {k: f"{v:.5g}".replace(".", "," if comma else ".") for k, v in cells.items()}
        lines.append(form.format(t=t, s=60 * i, i=i + 1, **texts))
    return lines


def interleaved(form: str, comma: bool = False) -> list[str]:
    """A line for each reading, scan by scan: {n} the channel, {v} its value."""
    channels = {"front": FRONT, "bed": BED, "z_um": Z}
    return [
        form.format(t=t + pd.Timedelta(milliseconds=20 * k), n=n, v=str(v[i]).replace(".", "," if comma else "."))
        for i, t in enumerate(STAMPS)
        for k, (n, v) in enumerate(channels.items())
    ]


LVM = ["LabVIEW Measurement\t", "Separator\tTab", "Decimal_Separator\t.", "X_Columns\t{x}", "Time_Pref\tRelative",
       "Date\t2026/01/14", "Time\t07:30:00", "***End_of_Header***\t", "Channels\t3\t\t\t", "Samples\t60\t60\t60\t",
       "Y_Unit_Label\tdegC\tdegC\tum\t", "X0\t0.0\t0.0\t0.0\t", "Delta_X\t60.0\t60.0\t60.0\t",
       "***End_of_Header***\t\t\t\t", "X_Value\tfront\tbed\tz\tComment"]  # fmt: skip
ANNOTATED = ["#group,false,false,false,false,true", "#datatype,string,long,dateTime:RFC3339,double,string",
             "#default,_result,,,,", ",result,table,_time,_value,_field"]  # fmt: skip
HEAD = "Time,T_front,T_bed,z_um"
# file -> lines, encoding, and whether the file gives a start
FORMATS: dict[str, tuple[Lines, str, bool]] = {
    "annotated.csv": ([*ANNOTATED, *interleaved(",,0,{t:%Y-%m-%dT%H:%M:%S.%fZ},{v},{n}")], "utf-8", True),
    "repeated.csv": (
        [*ANNOTATED, *interleaved(",,0,{t:%Y-%m-%dT%H:%M:%S.%fZ},{v},{n}")[:90], "", *ANNOTATED,
         *interleaved(",,0,{t:%Y-%m-%dT%H:%M:%S.%fZ},{v},{n}")[90:]], "utf-8", True),
    "opc.csv": (["Timestamp;NodeId;Value;Quality",
                 *interleaved("{t:%d.%m.%Y %H:%M:%S.%f};Mill.{n};{v};Good", True)], "utf-8", True),
    "tidy.csv": (["Time,Ch,Reading", *interleaved("{t:%Y-%m-%d %H:%M:%S},{n},{v}")], "utf-8", True),
    "yokogawa.csv": (["Model,GM10", "Tag Comment,,front,bed,disp", "Unit,,°C,°C,mm", "Date,Time,A1,A2,A3",
                      *rows("{t:%Y/%m/%d},{t:%H:%M:%S},{f},{b},{z_mm}")], "cp1252", True),
    "testo.csv": (["Messreihe: A", "", "Datum;Uhrzeit;Fühler 1 [°C];Fühler 2 [°C];Weg [µm]",
                   *rows("{t:%d.%m.%y};{t:%H:%M:%S};{f};{b};{z}", True)], "cp1252", True),
    "benchvue.csv": (["Instrument,34972A", "", "Scan,Time,101 <f> (C),Alarm 101,102 <b> (C),103 <disp> (um)",
                      *rows("{i},{t:%m/%d/%Y %H:%M:%S}:123,{f},0,{b},{z}")], "utf-16", True),
    "siemens.csv": (["Trace name;Trace_1", "Timestamp;Index;DB1.T_f;DB1.T_b;DB1.z_um",
                     *rows("{t:%Y-%m-%d %H:%M:%S},000;{i};{f};{b};{z}", True)], "utf-8", True),
    "relative.lvm": ([*LVM, *rows("{s}\t{f}\t{b}\t{z}")], "utf-8", True),
    "without_x.lvm": ([x.format(x="No") for x in LVM] + rows("\t{f}\t{b}\t{z}"), "utf-8", True),
    "fahrenheit.csv": (["Date/Time,Front (Deg. F),Bed [°C],Probe µm (S/N: 1234)",
                        *rows("{t:%m/%d/%Y %I:%M %p},{F},{b},{z}")], "utf-8", True),
    "cells.csv": (["Zeit;front;bed;z", *rows("{t:%d.%m.%Y %H:%M};{f}°C;{b} °C;{z_mm} mm", True)], "utf-8", True),
    "ctime.csv": ([HEAD, *rows("{t:%a %b %d %H:%M:%S %Y},{f},{b},{z}")], "utf-8", True),
    "zone.csv": ([HEAD, *rows("{t:%Y-%m-%d %H:%M:%S} CET,{f},{b},{z}")], "utf-8", True),
    "noon.csv": ([HEAD.replace(",", ";"), *rows("{t:%d/%m/%Y %I:%M:%S} a. m.;{f};{b};{z}", True)], "utf-8", True),
    "rfc.csv": (["date,T1,T2,z_um", *rows('"{t:%a, %d %b %Y %H:%M:%S} +0100",{f},{b},{z}')], "utf-8", True),
    "apache.csv": (["time,T1,T2,z_um", *rows("{t:%d/%b/%Y:%H:%M:%S} +0100,{f},{b},{z}")], "utf-8", True),
    "lines.csv": (['Time,"Front\n(°F)","Bed\n(°C)","Displ\n(µm)"', *rows("{t:%Y-%m-%d %H:%M:%S},{F},{b},{z}")],
                  "utf-8", True),
    "latin.csv": (["Zeit;T1;T2;Weg µm", *rows("{t:%d.%m.%Y %H:%M:%S};{f};{b};{z}", True)], "cp1252", True),
    "micro.csv": ([HEAD, *(f"{int(t.timestamp() * 1e6)},{f},{b},{z}"
                           for t, f, b, z in zip(STAMPS, FRONT, BED, Z, strict=True))], "utf-8", True),
    "days.csv": (["Elapsed;T1;T2;z_um", *(f"{i // 1440}d {i // 60 % 24:02d}:{i % 60:02d}:00;{f};{b};{z}"
                                        for i, f, b, z in zip(range(N), FRONT, BED, Z, strict=True))], "utf-8", False),
    "signs.csv": (["time_s,T1,T2,z_um", *rows("{s},+ {f},+ {b},+ {z}")], "utf-8", False),
    "aligned.txt": (["% Time                 T_front   T_bed    z_um",
                     *rows("  {t:%Y-%m-%d %H:%M:%S}   {f:>8} {b:>9}  {z:>6}")], "utf-8", True),
    "clocks.csv": (["t [s],front [°C],t [s],bed [°C],t [s],z [µm]", *rows("{s},{f},{s},{b},{s},{z}")], "utf-8", False),
}  # fmt: skip


def saved(folder: Path, name: str, lines: Lines, encoding: str = "utf-8") -> Path:
    (folder / name).write_bytes(("\n".join(lines) + "\n").encode(encoding))
    return folder / name


def drafted_machine(*paths: Path) -> Machine:
    return parse_machine(drafted(paths)[0], "draft")


def read(path: Path, text: str) -> Batch:
    (batch,) = read_batches(path, parse_machine(text, "draft"))
    return batch


@pytest.mark.parametrize("name", FORMATS)
def test_a_draft_reads_its_own_file(tmp_path: Path, name: str) -> None:
    lines, encoding, dated = FORMATS[name]
    path = saved(tmp_path, name, lines, encoding)
    text = drafted([path])[0]
    assert not any("ingest" in note for note in notes(text))
    batch = read(path, text)
    assert batch.start is None if not dated else abs(batch.start - START) <= pd.Timedelta("123ms")
    wanted = [c for c, v in batch.channels.items() if "alarm" not in c.lower() and c not in ("table",)]
    assert [(batch.channels[c].role, batch.channels[c].unit) for c in wanted] == [
        ("temperature", "degC"), ("temperature", "degC"), ("error", "um"),
    ]  # fmt: skip
    for channel, expected in zip(wanted, (FRONT, BED, Z), strict=True):
        assert batch.n_rows == N and np.abs(batch.values(channel) - expected).max() < 6e-3
    assert batch.time_s[-1] == 60 * (N - 1)


@pytest.mark.parametrize(
    ("header", "role", "unit"),
    [("load_kg", "driver", "kg"), ("oil [psi]", "driver", "psi"), ("air [%RH]", "driver", "%RH"),
     ("flux [W/m²]", "driver", "W/m**2"), ("x [slpm]", "driver", "slpm"), ("Temp_C_Avg", "temperature", "degC"),
     ("Temp, °F (S/N: 27)", "temperature", "degC"), ("Coolantwall", "temperature", "degC"),
     ("Temp (A)", "temperature", "degC"), ("humidity", "driver", "1")],
)  # fmt: skip
def test_a_column_of_values_near_22(tmp_path: Path, header: str, role: str, unit: str) -> None:
    path = saved(tmp_path, "run.csv", [f'time_s,"{header}",z_um', *rows("{s},{f},{z}")])
    channel = next(iter(drafted_machine(path).channels.values()))
    assert (channel.role, channel.unit) == (role, unit)


def test_a_column_of_states_makes_no_long_table(tmp_path: Path) -> None:
    """Not where the clock restarts or rows repeat a time either."""
    plain = rows("{t:%Y-%m-%d %H:%M:%S},{f},{z},")
    table = [x + ("rest" if i % 40 >= 20 else "heat") for i, x in enumerate([*plain, *plain[:5], *plain[:1] * 3])]
    path = saved(tmp_path, "run.csv", ["Time,T1,z_um,state", *table])
    machine = drafted_machine(path)
    assert machine.recording.pivot is None and machine.ignore == ["state"]


def machine(recording: str, clock: str = "{column: Time, unit: timestamp}") -> Machine:
    return parse_machine(
        f"{{machine: m, recording: {{step_s: 60, time: {clock}, {recording}}}, channels: {{"
        "f: {role: temperature, unit: degC, column: T_front}, z: {role: error, unit: um, column: z_um}}}",
        "test",
    )


@pytest.mark.parametrize(("separator", "decimal"), [("!", "."), ("~", ","), ("\\t", ".")])
def test_separator_decimal_and_encoding_can_be_given(tmp_path: Path, separator: str, decimal: str) -> None:
    own = separator.replace("\\t", "\t")
    cells = ("{t:%Y-%m-%d %H:%M:%S}", "{f}", "{z}")
    lines = [own.join(("Time", "T_front", "z_um")), *rows(own.join(cells), decimal == ",")]
    path = saved(tmp_path, "a.log", lines, "utf-16-le")
    m = machine(f'separator: "{separator}", decimal: "{decimal}", encoding: utf-16-le')
    (batch,) = read_batches(path, m)
    assert np.array_equal(batch.values("z"), Z) and batch.start == START


def test_header_rows_and_units_row_can_be_given(tmp_path: Path) -> None:
    lines = ["1,2,3", "Time,T_front,z_um", "4,5,6", "s,°F,mm", *rows("{s},{F},{z_mm}")]
    path = saved(tmp_path, "a.csv", lines)
    text = drafted([path], Form(header_rows=4, units_row=4))[0]
    assert "header_rows: 4" in text
    batch = read(path, text)
    assert batch.values("T_front") == pytest.approx(FRONT, abs=6e-3) and batch.values("z_um") == pytest.approx(Z)


def test_an_hour_that_comes_twice_in_a_time_zone(tmp_path: Path) -> None:
    utc = pd.date_range("2025-10-26 00:00", periods=N, freq="3min", tz="UTC")
    local = utc.tz_convert("Europe/Berlin")
    lines = [f"{t:%Y-%m-%d %H:%M:%S},{f},{b},{z}" for t, f, b, z in zip(local, FRONT, BED, Z, strict=True)]
    path = saved(tmp_path, "a.csv", [HEAD, *lines])
    (batch,) = read_batches(path, machine("max_gap_s: 900, timezone: Europe/Berlin"))
    assert batch.time_s[-1] == 3 * 60 * (N - 1) and batch.repairs["backward_steps"] == 0
    assert batch.start == pd.Timestamp("2025-10-26 02:00")
    with pytest.raises(InputError, match="unknown time zone 'Berlin'"):
        machine("timezone: Berlin")


def test_a_pivot_that_does_not_fit_names_its_key(tmp_path: Path) -> None:
    path = saved(tmp_path, "a.csv", FORMATS["tidy.csv"][0])
    with pytest.raises(
        InputError, match=r"no line with the columns 'sensor', 'Reading', 'Time'; got Time, Ch, Reading"
    ):
        list(read_batches(path, machine("pivot: {name: sensor, value: Reading}")))


def test_a_clock_contradicted_by_its_keys() -> None:
    with pytest.raises(InputError, match="clock: elapsed contradicts the other keys, which mean stamp"):
        machine("header: true", "{column: Time, unit: timestamp, clock: elapsed}")
    assert machine("header: true", "{column: Time, clock: stamp}").recording.time.unit == "timestamp"


def test_a_time_in_no_known_format_is_named(tmp_path: Path) -> None:
    path = saved(tmp_path, "a.csv", [HEAD, *rows("day 3 hour {i}:xx,{f},{b},{z}")])
    (note, *_) = notes(drafted([path])[0])
    assert note.startswith("column 'Time' (a time in no known format, such as 'day 3 hour 1:xx'): set recording.time")


def test_every_column_is_shown_with_what_becomes_of_it(tmp_path: Path) -> None:
    path = saved(tmp_path, "a.csv", ["No,Time,front [°F],z_um,note", *rows("{i},{t:%Y-%m-%d %H:%M},{F},{z},ok")])
    _, shown, _ = drafted([path])
    assert [(c.column, c.becomes) for c in shown["a.csv"]] == [
        ("No", "left out: numbers the rows, or is another clock"), ("Time", "clock: its cells look like it"),
        ("front [°F]", "temperature front, degF → degC"), ("z_um", "error z_um, um"),
        ("note", "left out: text, such as 'ok'"),
    ]  # fmt: skip
    assert shown["a.csv"][2].numbers == pytest.approx(FRONT[:3], abs=6e-3)


def long_recording(cycles: int = 3, pause_s: float = 0.0) -> pd.DataFrame:
    """Warm-ups of an hour and as long a rest, each after a pause."""
    minute = np.arange(120)
    level = np.where(minute < 60, 1 - np.exp(-minute / 15), np.exp(-(minute - 60) / 10))
    t = np.concatenate([k * (7200 + pause_s) + 60.0 * minute for k in range(cycles)])
    warm = np.tile(np.round(20 + 12 * level, 2), cycles)
    return pd.DataFrame({"time_s": t, "T1": warm, "z_um": np.round(3 * (warm - 20), 1)})


def with_split(text: str, split: str) -> str:
    return text.replace("channels:\n", f"  split: {split}\nchannels:\n", 1)


@pytest.mark.parametrize(
    ("pause_s", "split", "rows_of"),
    [(1800.0, "{pause: 20 min}", [120, 120, 120]), (0.0, "{every: 3 h}", [180, 180]),
     (0.0, "{driver: T1, above: 23}", None)],
)  # fmt: skip
def test_one_long_recording_is_cut_into_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pause_s: float, split: str, rows_of: list[int] | None
) -> None:
    path = tmp_path / "year.csv"
    long_recording(3, pause_s).to_csv(path, index=False)
    text = with_split(drafted([path])[0], split)
    for block in (1 << 20, 300):
        monkeypatch.setattr("data.readers.csv._BLOCK_BYTES", block)
        batches = list(read_batches(path, parse_machine(text, "draft")))
        sizes = [b.repairs["rows_in"] - b.repairs["rows_before_run"] for b in batches]
        assert sum(b.repairs["rows_in"] for b in batches) == 360
        assert sizes == rows_of if rows_of else len(batches) == 3 and max(sizes[:-1]) == 120


@pytest.mark.parametrize(("pause_s", "proposed"), [(3600.0, "pause: 600 s"), (0.0, "driver: T1, above: 2")])
def test_a_draft_proposes_how_to_cut_one_long_recording(tmp_path: Path, pause_s: float, proposed: str) -> None:
    path = tmp_path / "year.csv"
    long_recording(3, pause_s).to_csv(path, index=False)
    text = drafted([path])[0]
    (line,) = [x for x in text.splitlines() if "# split:" in x]
    assert proposed in line and "3 runs" in line
    proposal = line.strip().removeprefix("# split: ").partition("  #")[0]
    assert len(list(read_batches(path, parse_machine(with_split(text, proposal), "draft")))) == 3


def test_a_line_that_says_simulated_marks_the_machine(tmp_path: Path) -> None:
    for title in ("# simulated recording", "# simulated recording, sample year, seed 0, shop, hall"):
        assert drafted_machine(saved(tmp_path, "a.csv", [title, HEAD, *rows("{t},{f},{b},{z}")])).simulated
    path = saved(tmp_path, "b.csv", ["Time,T_simulated,z_um", *rows("{t},{f},{z}")])
    assert not drafted_machine(path).simulated


def test_without_an_error_the_draft_says_how_to_name_one(tmp_path: Path) -> None:
    path = saved(tmp_path, "a.csv", ["Time,T1,T2", *rows("{t},{f},{b}")])
    (note,) = notes(drafted([path])[0])
    assert note.startswith("no channel is the measured error; set role: error and its unit where it is, such as T1, T2")


def test_errors_without_a_clock_are_joined_row_by_row(tmp_path: Path) -> None:
    warm = saved(tmp_path, "temperatures.csv", ["Time,T1,T2", *rows("{t:%Y-%m-%d %H:%M:%S},{f},{b}")])
    error = saved(tmp_path, "errors.csv", ["z_um", *rows("{z}")])
    text = drafted([warm, error])[0]
    machine = parse_machine(text, "draft")
    assert machine.recording.files == ["temperatures.csv"] and machine.recording.joined["errors"].time.step == "60 s"
    assert np.array_equal(read(warm, text).values("z_um"), Z)


def test_files_of_other_columns_are_not_in_the_pattern(tmp_path: Path) -> None:
    first = saved(tmp_path, "warm.csv", ["time_s,T1,z_um", *rows("{s},{f},{z}")])
    other = saved(tmp_path, "notes.csv", ["time_s,T1", *rows("{s},{f}")])
    text = drafted([first, other])[0]
    assert parse_machine(text, "draft").recording.files == ["warm.csv"] and "# left out: notes.csv" in text


def test_a_split_needs_exactly_one_way() -> None:
    with pytest.raises(InputError, match="expected exactly one of driver, pause and every"):
        machine("split: {pause: 1 h, every: 1 d}")


def test_a_log_of_a_3d_printer(tmp_path: Path) -> None:
    """Its counter is no channel, though rows of it come twice, and the displacement is proposed as the error."""
    table = [f"{i - i // 50},{0.098 * (1 - np.exp(-i / 60)):.4f},{210 - 185 * np.exp(-i / 9):.2f},{f}"
             for i, f in enumerate(FRONT)]  # fmt: skip
    path = saved(tmp_path, "klipper.csv", ["sample,mcu_pos_z,he_t,bed_t", *table])
    text, shown, _ = drafted([path])
    machine = parse_machine(text.replace("? s", "2 s"), "draft")
    assert {n: c.role for n, c in machine.channels.items()} == {
        "mcu_pos_z": "error", "he_t": "temperature", "bed_t": "temperature",
    }  # fmt: skip
    assert shown["klipper.csv"][0].becomes == "left out: numbers the rows, or is another clock"
    assert "mcu_pos_z (no unit) is taken for the measured error; else set its role" in notes(text)


@pytest.mark.parametrize("micro", ["\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"])
def test_names_of_channels_can_be_typed(tmp_path: Path, micro: str) -> None:
    """Without the unit in brackets and accents, in the header's case; the column is found by either µ."""
    path = saved(tmp_path, "a.csv", [f"Zeit;Temp1_äC;Verlagerung_z [{micro}m]", *rows("{t:%d.%m.%Y %H:%M};{f};{z}")])
    text = drafted([path])[0]
    machine = parse_machine(text, "draft")
    assert [(n, c.role, c.unit) for n, c in machine.channels.items()] == [
        ("Temp1_aC", "temperature", "degC"), ("Verlagerung_z", "error", "um"),
    ]  # fmt: skip
    for other in ("\N{MICRO SIGN}", "\N{GREEK SMALL LETTER MU}"):
        assert np.array_equal(read(path, text.replace(micro, other)).values("Verlagerung_z"), Z)


def test_fractions_of_the_clock_and_alarms_are_no_channels(tmp_path: Path) -> None:
    head = "Time,us,ms,Alarm 101,min,T1,z_um"
    path = saved(tmp_path, "a.csv", [head, *rows("{t:%Y-%m-%d %H:%M},{F},{b},0,{f},{f},{z}")])
    text, shown, _ = drafted([path])
    assert parse_machine(text, "draft").ignore == ["us", "ms", "Alarm 101"]
    assert [c.becomes for c in shown["a.csv"][1:4]] == 2 * ["left out: a part of the clock"] + ["left out: an alarm"]
    assert list(parse_machine(text, "draft").channels) == ["min", "T1", "z_um"]


@pytest.mark.parametrize("name", ["Time", "clock"])
@pytest.mark.parametrize("ticks", ["ticks", "Tick [ms]"])
def test_a_clock_that_jumps_back_by_an_hour_stays_the_clock(tmp_path: Path, name: str, ticks: str) -> None:
    jumped = [START + pd.Timedelta(minutes=3 * i - 60 * (i >= N // 2)) for i in range(N)]
    table = [
        f"{t:%Y-%m-%d %H:%M:%S},{180000 * i},{f},{z}" for i, (t, f, z) in enumerate(zip(jumped, FRONT, Z, strict=True))
    ]
    path = saved(tmp_path, "a.csv", [f"{name},{ticks},T1,z_um", *table])
    text = drafted([path])[0]
    assert parse_machine(text, "draft").recording.time.column == name
    assert notes(text)[0].startswith("the clock jumps back by an hour at 2026-01-14 ")
    batch = read(path, text)
    assert np.array_equal(batch.values("z_um"), Z) and batch.repairs["clock_restarts"] == 1
    assert (batch.start, batch.time_s[-1]) == (START, 180 * (N - 1))


@pytest.mark.parametrize("runs", [[""], ["_01", "_02", "_03"]])
def test_the_step_of_recordings_without_a_clock_is_asked_once(tmp_path: Path, runs: Sequence[str]) -> None:
    """It is that of the joined files and of the grid."""
    for run in runs:
        pd.DataFrame({"T1": FRONT, "T2": BED}).to_excel(tmp_path / f"t{run}.xlsx", index=False)
        pd.DataFrame({"z_um": Z}).to_excel(tmp_path / f"z{run}.xlsx", index=False)
    text = drafted(sorted(tmp_path.glob("*.xlsx")))[0]
    assert text.count("fill in") == 1 == text.count("step:") and "step_s" not in text
    batch = read(tmp_path / f"t{runs[-1]}.xlsx", text.replace("? s", "20 s"))
    assert batch.step_s == 20 and np.array_equal(batch.values("z_um"), Z) and np.array_equal(batch.values("T1"), FRONT)


def test_a_slow_channel_among_fast_rows_has_no_holes(tmp_path: Path) -> None:
    """Temperatures every 20 s in rows of their own between rows of z every 2 s."""
    fast = [(2.0 * i, f"{2 * i},,{i / 10}") for i in range(10 * N)]
    slow = [(20.0 * i + 0.7, f"{20 * i + 0.7},{f},") for i, f in enumerate(FRONT)]
    path = saved(tmp_path, "a.csv", ["time_s,T1,z_um", *(line for _, line in sorted(fast + slow))])
    text = drafted([path])[0]
    batch = read(path, text)
    assert batch.repairs["rows_dropped"] == 0 == batch.repairs["channel_gaps"]
    t = batch.time_s[1:-10]
    assert np.abs(batch.values("T1")[1:-10] - np.interp(t, 20.0 * np.arange(N) + 0.7, FRONT)).max() < 1e-9


@pytest.mark.parametrize(
    ("body", "cause"),
    [(b"", "holds no row below its first line"), (b"0,20,1\n", "holds one row of numbers"),
     (b"0,NaN,NaN\n60,NaN,NaN\n120,NaN,NaN\n", r"no column of numbers next to the clock: T1 \(empty or NaN\), z_um "),
     (b"0,20,1\n60,21,2\n120,22,3\n\0\0\0", "3 NUL bytes from line 5 on, as a crash leaves them")],
)  # fmt: skip
def test_each_unusable_file_has_its_cause(tmp_path: Path, body: bytes, cause: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"time_s,T1,z_um\n" + body)
    with pytest.raises(InputError, match=rf"\Aa.csv: .*{cause}.*\Z"):
        drafted([path])


@pytest.mark.parametrize(
    ("text", "cause"),
    [("\n \n\n", "the table holds nothing, it is blank"),
     ("time_s," + "x" * (1 << 20), "first line is longer than 1 MB"),
     ("\n".join(",".join(["n", "T"][i < 1] + str(i + k) for k in range(5000)).replace("n", "") for i in range(9)),
      "5000 columns of numbers; expected 1 to 2000")],
)  # fmt: skip
def test_each_strange_file_has_its_cause(tmp_path: Path, text: str, cause: str) -> None:
    path = saved(tmp_path, "a.csv", text.split("\n"))
    with pytest.raises(InputError, match=rf"\Aa.csv: .*{cause}"):
        drafted([path])


def test_text_named_lvm_without_labviews_header_states_no_unit_of_time(tmp_path: Path) -> None:
    path = saved(tmp_path, "a.lvm", [f"{i}\t{f}\t{z}" for i, (f, z) in enumerate(zip(FRONT, Z, strict=True))])
    text = drafted([path])[0]
    assert "named so" not in text and any("no header gives the unit of time" in note for note in notes(text))
