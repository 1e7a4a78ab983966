"""Samples from standard input and growing CSV files, corrections to standard output and CSV files."""

from __future__ import annotations

import io
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from compensation.connectors import open_sink, open_source
from compensation.connectors.messages import overall_state
from compensation.connectors.network import Inbox
from compensation.connectors.streams import CsvSink, CsvSource, StandardInput, StandardOutput
from compensation.contracts import Correction, Sample, Source
from data.errors import InputError, WorkError
from data.machine import Machine, parse_machine

TIMEOUT_S = 30.0
MACHINE = """
machine: mill
ignore: [remark]
channels:
  front: {role: temperature, unit: degC, column: Head Front}
  room: {role: ambient, unit: degC, column: Room F, unit_in_file: degF}
  spindle_rpm: {role: driver, unit: rpm, source: schedule}
  y: {role: position, unit: mm}
  z: {role: error, unit: um, unit_in_file: mm, column: Disp Z}
  ey: {role: error, unit: um, position: y}
"""
CORRECTION = Correction(
    100.5,
    {"z": -12.25, "ey": 1.0},
    {"ey": 3.5},
    {"z": "active", "ey": "hold"},
    {"ey": "sensor front is silent, since 3 min"},
)


@pytest.fixture
def machine() -> Machine:
    return parse_machine(MACHINE, "test")


def taken(source: Source, n: int, meanwhile: Callable[[], object] = lambda: None) -> list[Sample]:
    """The next `n` samples; `meanwhile` runs at the first silence."""
    found: list[Sample] = []
    until_s = time.monotonic() + TIMEOUT_S
    iterator = source.samples()
    while len(found) < n:
        assert time.monotonic() < until_s, f"{len(found)} of {n} samples"
        sample = next(iterator)
        if sample is not None:
            found.append(sample)
        else:
            meanwhile()
            meanwhile = lambda: None  # noqa: E731
    return found


def all_of(source: Source) -> list[Sample]:
    return [s for s in source.samples() if s is not None]


def from_text(text: str, machine: Machine) -> list[Sample]:
    return all_of(StandardInput("-", machine, io.BytesIO(text.encode())))


# ----- lines


def test_json_lines_nested_and_flat_give_the_same_sample(machine: Machine) -> None:
    nested = {"time_s": 100.0, "values": {"front": 25.5, "room": None}, "readings_um": {"z": 3}}
    flat = {"timestamp": "1970-01-01T00:01:40Z", "front": "25.5", "z": 3.0}
    one, other = from_text(json.dumps(nested) + "\n" + json.dumps(flat), machine)
    assert one == other == Sample(100.0, {"front": 25.5}, {"z": 3.0})


def test_csv_columns_are_in_the_unit_of_the_file_and_names_in_that_of_the_channel(machine: Machine) -> None:
    (by_column,) = from_text("time_s,Head Front,Room F,Disp Z\n5,25.5,68,0.002\n", machine)
    assert by_column.values == pytest.approx({"front": 25.5, "room": 20.0})
    assert by_column.readings_um == pytest.approx({"z": 2.0})
    (by_name,) = from_text("time_s,front,room,z,spindle_rpm\n5,25.5,20,2,4000\n", machine)
    assert by_name.values == pytest.approx({"front": 25.5, "room": 20.0, "spindle_rpm": 4000.0})
    assert by_name.readings_um == pytest.approx({"z": 2.0})


def test_empty_cells_are_absent_and_a_probe_that_did_not_measure_gives_no_reading(machine: Machine) -> None:
    (sample,) = from_text("time_s,front,room,z\n5,,nan,\n", machine)
    assert sample == Sample(5.0, {}, {})


def test_comments_are_no_samples(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    (sample,) = from_text("# simulated recording\ntime_s,front\n# pause\n5,20\n", machine)
    assert sample == Sample(5.0, {"front": 20.0}, {}) and not capsys.readouterr().err


def test_a_dead_sensor_does_not_change_the_decimal_mark(machine: Machine) -> None:
    one, other = from_text("time_s;front;room\n1700000000;21,512;20,25\n1700000010;21,612;n.a.\n", machine)
    assert one.values == {"front": 21.512, "room": 20.25} and other.values["front"] == 21.612
    (first,) = from_text("time_s;front;room\n1700000010;21,612;n.a.\n", machine)
    assert first.values["front"] == 21.612


def test_semicolons_decimal_commas_and_a_byte_order_mark(machine: Machine) -> None:
    (sample,) = from_text("\ufefftime;FRONT;room\r\n1700000000,5;25,125;20\r\n", machine)
    assert sample == Sample(1700000000.5, {"front": 25.125, "room": 20.0})


def test_unreadable_lines_are_skipped_with_file_line_got_and_expected(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = ["time_s,front,remark", "1,20,a", "2,21", "yesterday,22,b", '{"time_s": 4', "[" * 9000, "\0\xff", "5,23,c"]
    found = from_text("\n".join(lines) + "\n", machine)
    assert [s.time_s for s in found] == [1.0, 5.0]
    reports = capsys.readouterr().err.splitlines()
    assert len(reports) == 5
    assert "standard input line 3: got 2 cells, expected 3; skipped" in reports[0]
    assert "line 4: got time 'yesterday', expected Unix seconds or an ISO time stamp; skipped" in reports[1]
    assert "line 5" in reports[2] and "expected one JSON object" in reports[2]


@pytest.mark.parametrize("time", ["", "  ", "1900-01-01 00:00:00"])
def test_a_sample_without_a_time_is_skipped_and_not_of_1900(
    time: str, machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    found = from_text(f"time_s,front\n1700000000,20\n{time},21\n1700000010,22\n", machine)
    assert [s.time_s for s in found] == [1700000000.0, 1700000010.0]
    assert f"line 3: got time {time.strip()!r}, expected Unix" in capsys.readouterr().err.replace(
        repr(time), repr(time.strip())
    )


def test_a_long_row_of_unreadable_lines_is_reported_briefly(
    machine: Machine, capsys: pytest.CaptureFixture[str]
) -> None:
    found = from_text("time_s,front\n" + "broken\n" * 5000 + "7,20\n", machine)
    assert [s.time_s for s in found] == [7.0]
    assert len(capsys.readouterr().err.splitlines()) == 10


def test_one_broken_cell_costs_one_channel(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    found = from_text("time_s,front,room\n1,---,20\n2,---,21\n3,25,22\n", machine)
    assert [dict(s.values) for s in found] == [{"room": 20.0}, {"room": 21.0}, {"front": 25.0, "room": 22.0}]
    (report,) = capsys.readouterr().err.splitlines()
    assert "line 2: front: got '---', expected a number" in report


def test_json_values_that_are_no_numbers_are_left_out(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    (sample,) = from_text('{"time_s": 1, "front": Infinity, "room": true, "frnt": 3, "spindle_rpm": 1e3}\n', machine)
    assert sample.values == {"spindle_rpm": 1000.0}
    assert "unknown channel 'frnt': did you mean 'front'?" in capsys.readouterr().err


def test_time_column_of_the_machine_file_with_its_format(machine: Machine) -> None:
    stamped = parse_machine(
        "machine: m\nrecording: {time: {column: Zeit, unit: timestamp, format: '%d.%m.%Y %H:%M:%S%z'}}\n"
        "channels: {a: {role: temperature, unit: degC}}",
        "test",
    )
    (sample,) = from_text("Zeit;a\n01.01.1970 00:01:00+0000;20,5\n", stamped)
    assert sample == Sample(60.0, {"a": 20.5})
    bare = parse_machine(
        "machine: m\nrecording: {header: false, time: {column: 0, unit: min}}\n"
        "channels: {a: {role: temperature, unit: degC, column: 2}}",
        "test",
    )
    assert from_text("2,9,20.5\n", bare) == [Sample(120.0, {"a": 20.5})]


@pytest.mark.parametrize(
    ("header", "message"),
    [("when,front", "the header has no time column"), ("time_s,a,b", "the header has no column of a channel")],
)
def test_a_header_without_time_or_channel_ends_the_command(machine: Machine, header: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        from_text(f"{header}\n1,2\n", machine)


# ----- standard input


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        with suppress(OSError):
            os.close(end)


def test_standard_input_gives_none_in_silence_and_waits_for_the_end_of_a_line(
    machine: Machine, pipe: tuple[int, int]
) -> None:
    read_end, write_end = pipe
    os.write(write_end, b"time_s,front\n1,20\n2,2")
    stream = os.fdopen(read_end, "rb")
    source = StandardInput("-", machine, stream)
    samples = source.samples()
    assert next(s for s in samples if s is not None).values == {"front": 20.0}
    assert next(samples) is None
    os.write(write_end, b"5\n3,30")
    os.close(write_end)
    assert [s.values["front"] for s in samples if s is not None] == [25.0, 30.0]
    source.close()
    source.close()
    stream.close()


# ----- growing files


def append(path: Path, text: str) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(text)


def test_a_csv_file_is_followed_as_it_grows(machine: Machine, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time_s,front\n1,20\n2,2")
    source = open_source(str(path), machine)
    found = taken(source, 2, lambda: append(path, "1\n"))
    assert [s.values["front"] for s in found] == [20.0, 21.0]
    source.close()
    assert all_of(source) == []


def test_a_replaced_file_and_a_truncated_one_are_followed(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time_s,front\n1,20\n")
    source = CsvSource(str(path), machine)

    def rotate() -> None:
        append(path, "2,21\n3,2")  # read after the rename; the cut row is not
        path.rename(tmp_path / "log.1.csv")
        path.write_text("room,time_s,front\n22,4,23\n")

    assert [s.time_s for s in taken(source, 3, rotate)] == [1.0, 2.0, 4.0]
    assert "expected a whole line" in capsys.readouterr().err
    path.write_text("")
    found = taken(source, 1, lambda: append(path, "time_s,room\n5,24\n"))
    assert found == [Sample(5.0, {"room": 24.0})]

    def empty_under_a_writer_that_writes_no_header_again() -> None:
        path.write_text("6,25\n")

    assert taken(source, 1, empty_under_a_writer_that_writes_no_header_again) == [Sample(6.0, {"room": 25.0})]
    source.close()


def test_a_file_that_does_not_exist_yet_is_waited_for(
    machine: Machine, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "log.csv"
    source = CsvSource(str(path), machine)
    found = taken(source, 1, lambda: path.write_text("time_s,front\n1,20\n"))
    assert found == [Sample(1.0, {"front": 20.0})]
    assert capsys.readouterr().err.count("does not exist yet") == 1
    source.close()
    with pytest.raises(InputError, match="no such folder"):
        CsvSource(str(tmp_path / "nowhere" / "log.csv"), machine)


def test_a_replay_ends_at_the_end_of_the_file(machine: Machine, tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("time_s,front\n1,20\n2,21")
    assert [s.time_s for s in all_of(open_source(str(path), machine, follow=False))] == [1.0, 2.0]
    with pytest.raises(InputError, match="no such file"):
        open_source(str(tmp_path / "other.csv"), machine, follow=False)
    with pytest.raises(InputError, match="a live source has no end"):
        open_source("mqtt://localhost/mill", machine, follow=False)


# ----- sinks


def test_json_lines_to_standard_output(machine: Machine, capsys: pytest.CaptureFixture[str]) -> None:
    sink = open_sink("-", machine)
    sink.write(CORRECTION)
    sink.close()
    sink.close()
    assert json.loads(capsys.readouterr().out) == {
        "time_s": 100.5,
        "offset_um": {"z": -12.25, "ey": 1.0},
        "slope_um_per_m": {"ey": 3.5},
        "state": {"z": "active", "ey": "hold"},
        "reasons": {"ey": "sensor front is silent, since 3 min"},
        "heartbeat": 0,
        "valid_until_s": 0.0,
    }


def test_a_reader_that_does_not_read_blocks_one_write_only(machine: Machine, pipe: tuple[int, int]) -> None:
    read_end, write_end = pipe
    os.set_blocking(write_end, False)
    with pytest.raises(BlockingIOError):
        while True:
            os.write(write_end, b"\n" * 4096)
    os.set_blocking(write_end, True)
    stream = os.fdopen(os.dup(write_end), "w")
    sink = StandardOutput("-", machine, stream)
    for message in ("blocked for", "still waits for its reader"):
        with pytest.raises(WorkError, match=message):
            sink.write(CORRECTION)
    while b"}" not in os.read(read_end, 1 << 16):
        pass
    until_s = time.monotonic() + TIMEOUT_S
    while True:
        try:
            sink.write(CORRECTION)
            break
        except WorkError:
            assert time.monotonic() < until_s
    sink.close()
    stream.close()


def test_csv_rows_with_one_header_over_several_runs(machine: Machine, tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    for _ in range(2):
        sink = open_sink(str(path), machine)
        sink.write(CORRECTION)
        assert path.read_text().endswith("\n")  # flushed
        sink.close()
        sink.close()
    row = '100.5,-12.2500,active,,1.0000,3.5000,hold,"sensor front is silent, since 3 min"'
    header = "time_s,z_offset_um,z_state,z_reason,ey_offset_um,ey_slope_um_per_m,ey_state,ey_reason"
    assert path.read_text().splitlines() == [header, row, row]


def test_a_cut_last_row_is_ended_and_another_table_is_refused(machine: Machine, tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    CsvSink(str(path), machine).close()
    append(path, "99.5,-12")
    sink = CsvSink(str(path), machine)
    sink.write(CORRECTION)
    sink.close()
    assert [line.partition(",")[0] for line in path.read_text().splitlines()] == ["time_s", "99.5", "100.5"]
    path.write_text("time_s,front\n")
    with pytest.raises(InputError, match="holds another table"):
        CsvSink(str(path), machine)
    with pytest.raises(InputError, match="cannot be written"):
        CsvSink(str(tmp_path / "nowhere" / "out.csv"), machine)


# ----- addresses and what all share


def test_an_unknown_address_names_the_closest_and_the_allowed(machine: Machine, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unknown scheme or file extension 'mqt': did you mean 'mqtt'") as caught:
        open_source("mqt://user:secret@localhost/mill", machine)
    assert "secret" not in str(caught.value)
    with pytest.raises(InputError, match=r"'\.txt'.*Allowed: -, \.csv, mqtt"):
        open_sink(str(tmp_path / "out.txt"), machine)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("mqtt://user:secret@localhost/mill", "THERMODRIFT_MQTT_PASSWORD in the environment"),
        ("opc.tcp://user:secret@localhost", "THERMODRIFT_OPCUA_PASSWORD in the environment"),
        ("mqtt://localhost:http/mill", "got the port 'http'"),
        ("mqtt://localhost", "topic prefix"),
        ("mqtt://localhost/mill/+", "topic prefix"),
        ("mqtt://localhost/mill/#", "got '#'"),
        ("mqtt:///mill", "got no host"),
        ("mqtt://localhost/mill?interval=2", "unknown key 'interval' after '?': did you mean 'interval_s'"),
        ("mqtt://localhost/mill?interval_s=0", "expected a number of seconds above 0"),
        ("mqtts://localhost/mill?ca=nowhere.pem", "certificate nowhere.pem: cannot be read"),
        ("opc.tcp://localhost:4840", "no node file"),
        ("opc.tcp://localhost:4840?nodes=nowhere.yml", "node file nowhere.yml: cannot be read"),
    ],
)
def test_an_unusable_address_is_one_clear_line(machine: Machine, address: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        open_source(address, machine)
    assert message in str(caught.value) and "secret" not in str(caught.value) and "\n" not in str(caught.value)


def test_a_full_inbox_drops_the_oldest_with_one_report(capsys: pytest.CaptureFixture[str]) -> None:
    inbox = Inbox("test", size=3)
    for i in range(10):
        inbox.put(Sample(float(i), {}))
    assert [inbox.get(0.0) for _ in range(4)] == [*(Sample(float(i), {}) for i in (7, 8, 9)), None]
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_the_overall_state_is_off_only_where_every_axis_is() -> None:
    assert overall_state(Correction(0.0, {}, {}, {"x": "off", "z": "hold"})) == "hold"
    assert overall_state(Correction(0.0, {}, {}, {"x": "active", "z": "hold"})) == "active"
    assert overall_state(Correction(0.0, {}, {}, {"x": "off"})) == overall_state(Correction(0.0, {})) == "off"
