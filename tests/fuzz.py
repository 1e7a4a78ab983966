"""Fuzzing of everything that reads what others write: ``python -m tests.fuzz [--seconds 60] [--seed 0] [TARGET …]``.

Valid input is damaged at random and given to the readers of recordings, the machine file and the samples of the
compensation. Only the documented error may come out, in one line and within `SLOW_S`. A failure is printed
once for each place where it was raised, with the seed that repeats it; its input is written to the folder ``--keep``.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import re
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import openpyxl
import pandas as pd

from compensation.connectors.messages import Decoder
from compensation.connectors.streams import LineParser
from data.errors import InputError
from data.machine import Form, parse_machine
from data.readers.csv import CsvSheet
from data.recording import read_batches

SLOW_S = 20.0  # on one slow core that is shared
MACHINE = """
machine: mill
recording: {time: {column: time_s}, step_s: 60, max_gap_s: 300}
channels:
  front: {role: temperature, unit: degC, column: Head Front, resolution: 0.1, range: [-10, 90]}
  room: {role: ambient, unit: degC, unit_in_file: degF}
  spindle_rpm: {role: driver, unit: rpm}
  y: {role: position, unit: mm}
  z: {role: error, unit: um, resolution: 0.1}
  ey: {role: error, unit: um, position: y}
"""
FILES = sorted((Path(__file__).parents[1] / "machines").glob("*.yml"))
# what breaks parsers: numbers at their limits, separators, quotes, half of a character, deep and repeated structures
TOKENS = (
    b"\0", b"\n", b"\r\n", b"\xff", b"\xc3", b"\xef\xbb\xbf", b"\t", b",", b";", b'"', b"'", b"{", b"}", b"[", b"]",
    b":", b"-", b"|", b"@", b"&a ", b"*a", b"<<: ", b"!!int ", b"? ", b"../", b"nan", b"inf", b"-inf", b"1e999",
    b"1e-999", b"NaN", b"null", b"true", b"0x1f", b"1:2:3", b"9" * 400, b"-1", b"2024-13-45", b"1970-01-01T00:00:00Z",
    b"9999-12-31T23:59:59", b"0001-01-01T00:00:00", b"[" * 300, b'{"a":' * 300, "µ°冬\u2028\U0001f600".encode(), b"1,5",
    b"%", b"time_s", b"z", b"front", b"values", b"\x1a", b"\\u0000",
)  # fmt: skip


@dataclass(frozen=True)
class Failure:
    """What came out instead of the documented error: where, and the input that brought it."""

    target: str
    seed: int
    what: str
    given: bytes


def damaged(good: bytes, dice: random.Random) -> bytes:
    """The bytes after some random changes."""
    body = bytearray(good)
    for _ in range(dice.choice((1, 1, 2, 4, 16))):
        at = dice.randrange(len(body) + 1)
        length = min(dice.choice((1, 2, 8, 64)), len(body) - at)
        match dice.randrange(7):
            case 0:
                body[at:at] = dice.choice(TOKENS)
            case 1:
                body[at : at + length] = dice.choice(TOKENS)
            case 2:
                del body[at : at + length]
            case 3:
                body[at:at] = body[at : at + length] * dice.choice((1, 3, 50))
            case 4 if length:
                body[at] ^= 1 << dice.randrange(8)
            case 5:
                body[at : at + length] = dice.randbytes(length)
            case 6 if dice.random() < 0.3:
                del body[at:]
    return bytes(body)


def _table() -> pd.DataFrame:
    rows = range(40)
    return pd.DataFrame({
        "time_s": [60.0 * i for i in rows], "Head Front": [20.0 + 0.1 * i for i in rows], "room": [68.0] * 40,
        "spindle_rpm": [4000.0] * 40, "y": [100.0 * (i % 5) for i in rows], "z": [0.5 * i for i in rows],
        "ey": [0.3 * i for i in rows],
    })  # fmt: skip


def _good_files() -> dict[str, bytes]:
    """A recording in each format."""
    table, book, parquet, stamped = _table(), io.BytesIO(), io.BytesIO(), _table()
    with contextlib.closing(openpyxl.Workbook()) as workbook:
        for row in [list(table.columns), *table.to_numpy().tolist()]:
            workbook.active.append(row)
        workbook.save(book)
    table.to_parquet(parquet, index=False)
    stamped["time_s"] = pd.date_range("2026-01-01", periods=40, freq="min").astype(str)
    return {
        ".csv": table.to_csv(index=False).encode(),
        ".txt": table.to_csv(index=False, sep=";", decimal=",").encode("cp1252"),
        ".tsv": stamped.to_csv(index=False, sep="\t").encode(),
        ".xlsx": book.getvalue(),
        ".parquet": parquet.getvalue(),
    }


def _damaged_workbook(good: bytes, dice: random.Random) -> bytes:
    """A workbook with one damaged part; bytes of a ZIP archive changed at random rarely get past its checksum."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(good)) as old, zipfile.ZipFile(out, "w") as new:
        chosen = dice.choice(old.namelist())
        for name in old.namelist():
            new.writestr(name, damaged(old.read(name), dice) if name == chosen else old.read(name))
    return out.getvalue()


def _lines(path: Path) -> int:
    """Lines of a text file that are not blank."""
    text = path.read_bytes().decode(CsvSheet(path, (), Form()).encoding, "replace")
    return sum(bool(line.strip(" ")) for line in re.split("\r\n|\n|\r", text))


def _one_line(error: Exception) -> None:
    if len(str(error).splitlines()) > 1:
        raise AssertionError(f"several lines: {error}")


class Recordings:
    """`data.recording.read_batches` with every reader: InputError."""

    allowed: tuple[type[Exception], ...] = (InputError,)

    def __init__(self) -> None:
        self._machines = [
            parse_machine(MACHINE, "fuzz"),
            parse_machine(MACHINE.replace("{column: time_s}", "{column: time_s, unit: timestamp}"), "fuzz"),
        ]
        self._good = _good_files()

    def make(self, dice: random.Random) -> bytes:
        suffix = dice.choice(list(self._good))
        good = self._good[suffix]
        whole = suffix == ".xlsx" and dice.random() < 0.7
        body = _damaged_workbook(good, dice) if whole else damaged(good, dice)
        return suffix.encode() + b"\n" + body

    def run(self, given: bytes) -> None:
        suffix, _, body = given.partition(b"\n")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"run{suffix.decode()}"
            path.write_bytes(body)
            for machine in self._machines:
                try:
                    for batch in read_batches(path, machine):
                        counts = batch.repairs
                        assert counts["rows_in"] == counts["rows_used"] + counts["rows_dropped"]
                        assert batch.n_rows == counts["rows_out"] >= 2
                        if suffix in (b".csv", b".txt", b".tsv") and b'"' not in body:
                            named = (
                                1 + counts["rows_in"] + sum(counts.get(k, 0) for k in ("preamble_rows", "unit_rows"))
                            )
                            assert _lines(path) == named, f"{_lines(path)} lines, {named} in the account"
                except InputError as error:
                    _one_line(error)


class MachineFiles:
    """`data.machine.parse_machine`: InputError."""

    allowed: tuple[type[Exception], ...] = (InputError,)

    def __init__(self) -> None:
        self._good = [MACHINE.encode(), *(f.read_bytes() for f in FILES)]

    def make(self, dice: random.Random) -> bytes:
        return damaged(dice.choice(self._good), dice)

    def run(self, given: bytes) -> None:
        parse_machine(given.decode("utf-8", "replace"), "fuzz.yml")


class Messages:
    """`Decoder.sample`: ValueError."""

    allowed: tuple[type[Exception], ...] = (ValueError,)

    def __init__(self) -> None:
        self._decoder = Decoder(parse_machine(MACHINE, "fuzz"))
        nested = {"time_s": 1e9, "values": {"front": 25.5, "room": None, "spindle_rpm": 4000}, "readings_um": {"z": 3}}
        flat = {"timestamp": "2026-01-01T00:01:40Z", "front": "25.5", "z": 3.0, "y": 100}
        self._good = [json.dumps(m).encode() for m in (nested, flat)]

    def make(self, dice: random.Random) -> bytes:
        return damaged(dice.choice(self._good), dice)

    def run(self, given: bytes) -> None:
        for arrival_s in (None, 1e9):
            try:
                self._decoder.sample(given, "fuzz", arrival_s)
            except ValueError as error:
                _one_line(error)
        self._decoder.sample(given.decode("utf-8", "replace"), "fuzz", 1e9)


class Lines:
    """`LineParser.sample`, line by line: InputError."""

    allowed: tuple[type[Exception], ...] = (InputError,)

    def __init__(self) -> None:
        self._machine = parse_machine(MACHINE, "fuzz")
        good = _good_files()
        self._good = [good[".csv"], good[".txt"], good[".tsv"], b"\n".join(3 * Messages()._good)]

    def make(self, dice: random.Random) -> bytes:
        return damaged(dice.choice(self._good), dice)

    def run(self, given: bytes) -> None:
        parser = LineParser(self._machine, "fuzz")
        for row, line in enumerate(given.split(b"\n"), 1):
            if row == 20:
                parser.restart()
            parser.sample(line, row)


TARGETS: dict[str, type[Recordings] | type[MachineFiles] | type[Messages] | type[Lines]] = {
    "recordings": Recordings,
    "machine": MachineFiles,
    "messages": Messages,
    "lines": Lines,
}


def fuzz(names: list[str], seeds: Iterator[int], more: Callable[[], bool]) -> tuple[dict[str, int], list[Failure]]:
    """Damaged inputs for the targets in turn while `more`; counts of inputs, and failures, one for each place."""
    targets = {name: TARGETS[name]() for name in names}
    counts, failures = dict.fromkeys(names, 0), dict[str, Failure]()
    while more():
        seed = next(seeds)
        for name, target in targets.items():
            given = target.make(random.Random(seed))
            begun = time.monotonic()
            wrong = ""
            try:
                with contextlib.redirect_stderr(io.StringIO()):
                    target.run(given)
            except target.allowed as error:
                wrong = "" if len(str(error).splitlines()) < 2 else f"several lines: {error!s:.100}"
            except Exception as error:
                last = traceback.extract_tb(error.__traceback__)[-1]
                wrong = f"{type(error).__name__} at {Path(last.filename).name}:{last.lineno}: {error!s:.100}"
            counts[name] += 1
            if not wrong and time.monotonic() - begun > SLOW_S:
                wrong = "slow"
            if wrong:
                failures.setdefault(f"{name} {wrong.partition(': ')[0]}", Failure(name, seed, wrong, given))
    return counts, list(failures.values())


def main(arguments: list[str] | None = None) -> int:
    """The command; 1 where something failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"of {', '.join(TARGETS)}; default: all")
    parser.add_argument("--seconds", type=float, default=60.0, help="duration (default 60)")
    parser.add_argument("--seed", type=int, default=None, help="first seed (default: the clock)")
    parser.add_argument("--keep", type=Path, default=Path("var/fuzz"), help="folder for inputs that failed")
    given = parser.parse_args(arguments)
    if unknown := set(given.targets) - set(TARGETS):
        parser.error(f"unknown target {min(unknown)!r}; allowed: {', '.join(TARGETS)}")
    first = int(time.time()) if given.seed is None else given.seed
    until_s = time.monotonic() + given.seconds
    counts, failures = fuzz(
        given.targets or list(TARGETS), iter(range(first, sys.maxsize)), lambda: time.monotonic() < until_s
    )
    print(f"seed {first}: " + ", ".join(f"{n} {name}" for name, n in counts.items()))
    for f in failures:
        given.keep.mkdir(parents=True, exist_ok=True)
        file = given.keep / f"{f.target}-{f.seed}"
        file.write_bytes(f.given)
        print(f"{f.target}: {f.what!r}; seed {f.seed}, input in {file}")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
