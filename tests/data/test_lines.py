"""Every line of a text file is read, counted or named, however its lines end and whatever divides their cells."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from data.account import Account
from data.batch import Batch
from data.describe import drafted, notes
from data.errors import InputError
from data.machine import parse_machine
from data.recording import read_batches

N = 120
HEAD = "Time,T_front,z_um"
MACHINE = """
machine: mill
recording: {time: {column: Time, unit: timestamp}}
channels:
  T_front: {role: temperature, unit: degC}
  z_um: {role: error, unit: um}
"""


def row(i: int) -> str:
    return f"2026-01-14 {7 + i // 60:02d}:{i % 60:02d}:00,{20 + i**0.5:.2f},{i**0.7:.1f}"


def read(path: Path, text: str) -> Batch:
    (batch,) = read_batches(path, parse_machine(text, "test"))
    return batch


def joined(*lines: str) -> str:
    return "".join(f"{line}\n" for line in lines)


ROWS = [row(i) for i in range(N)]
BOTH = [HEAD.replace(",", ";"), *(r.replace(",", ";") for r in ROWS[40:])]
FILES = {  # text -> rows that the table has, lines that are counted as dropped
    "mixed ends": ("".join(r + "\r\n\r"[k % 3 : k % 3 + 1 + (k % 3 == 0)] for k, r in enumerate([HEAD, *ROWS])), N, 0),
    "old ends after the header": (HEAD + "\n" + "\r".join(ROWS), N, 0),
    "two returns": ("\r\r\n".join([HEAD, *ROWS]), N, 0),
    "another separator at the end": (joined(HEAD, *ROWS[:90], *(r.replace(",", ";") for r in ROWS[90:])), N, 0),
    "another separator, header repeated": (joined(HEAD, *ROWS[:40], *BOTH), N, 1),
    "a note behind some rows": (joined(HEAD, *(r + ",door open" * (i % 4 == 0) for i, r in enumerate(ROWS))), N, 0),
    "a separator behind each row": (joined(HEAD, *(r + ",," for r in ROWS)), N, 0),
    "two cells more than names": (joined(HEAD, *(r + ",ok,ok" for r in ROWS)), N, 0),
    "numbers behind some rows": (joined(HEAD, *(r + ",5" * (i % 4 == 0) for i, r in enumerate(ROWS))), N - 30, 30),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_every_line_is_a_row_or_counted(tmp_path: Path, name: str) -> None:
    text, used, dropped = FILES[name]
    path = tmp_path / "run.csv"
    path.write_bytes(text.encode())
    draft = drafted([path])[0]
    assert list(parse_machine(draft, "draft").channels)[:2] == ["T_front", "z_um"]
    assert any("ingest drops" in note for note in notes(draft)) == (dropped > 0.1 * N)
    for machine in (MACHINE, draft):
        batch = read(path, machine)
        counts = batch.repairs
        assert (counts["rows_used"], counts["rows_dropped"]) == (used, dropped)
        lines = sum(bool(line) for line in re.split(r"\r\n|\n|\r", text))
        assert lines == 1 + counts["rows_in"] and batch.values("z_um")[-1] == round((N - 1) ** 0.7, 1)


def test_rows_above_the_header_are_counted(tmp_path: Path) -> None:
    """A logger that gets another channel writes another header into the same file."""
    path = tmp_path / "run.csv"
    path.write_text(joined("Logger 7", HEAD, *ROWS[:20], HEAD + ",room", *(f"{r},21.5" for r in ROWS[20:])))
    more = MACHINE + "  room: {role: ambient, unit: degC}\n"
    batch = read(path, more)
    assert batch.repairs["rows_in"] == N and batch.repairs["ragged_rows"] == 20 == batch.repairs["rows_dropped"]
    assert batch.repairs["preamble_rows"] == 2
    assert Account.of([batch]).rows == "rows: 120 read, 20 dropped (20 with another number of cells)"


@pytest.mark.parametrize(
    ("change", "message"),
    [(("T_front:", "front: {column: T_fornt, "), "run.csv: column 'T_fornt' of channel 'front' is missing; did you "
      r"mean 'T_front'\? Correct column: of the channel, or add that one to ignore"),
     (("recording: {", "recording: {step_s: 6, "), "run.csv: rows are 60 s apart but recording.step_s is 6 s: 1191 "
      "grid rows from 120; .*raise step_s to 60")],
)  # fmt: skip
def test_a_machine_file_that_does_not_fit_its_recording_is_refused(
    tmp_path: Path, change: tuple[str, str], message: str
) -> None:
    path = tmp_path / "run.csv"
    path.write_text(joined(HEAD, *ROWS))
    text = MACHINE.replace("T_front: {", change[1]) if "T_front" in change[0] else MACHINE.replace(*change)
    with pytest.raises(InputError, match=message):
        read(path, text)


@pytest.mark.parametrize(
    ("missing", "there"),
    [("Disp. X", "Disp. Z"), ("PT01", "PT02"), ("front_left", "front_right"), ("inlet", "outlet"), ("head", "heat")],
)
def test_another_sensor_is_no_misspelt_one(tmp_path: Path, missing: str, there: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(joined(HEAD.replace("T_front", there), *ROWS))
    batch = read(path, MACHINE.replace("unit: degC", f"unit: degC, column: {missing}"))
    assert batch.repairs["missing_channels"] == 1 == batch.repairs["unknown_columns"]


def test_repeated_times_are_in_the_account(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(joined(HEAD, *(r for i, r in enumerate(ROWS) for r in [r] * (1 + i % 2))))
    account = Account.of([read(path, MACHINE)])
    assert account.rows == "rows: 180 read, 0 dropped, 60 averaged with another row of the same time"
