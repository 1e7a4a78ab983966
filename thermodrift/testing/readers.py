"""The contract of a reader of a file format."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine, parse_machine
from data.readers.base import Reader
from data.recording import read_batches
from thermodrift.testing.contract import Suite, expect, expect_close, expect_refused

Write = Callable[[pd.DataFrame, Path], object]
NAMES = ("t", "front", "z", "part")
N = 40
JUNK = (
    b"\0\1\2\3" * 100, b"PK\3\4" + bytes(range(256)) * 8, b"PAR1" + b"\0" * 64, b"\x89PNG\r\n\x1a\n" + b"\0" * 9,
)  # fmt: skip
MACHINE = """
machine: mill
ignore: [part]
recording: {step_s: 10, max_gap_s: 1000, time: {column: t, unit: s}}
channels:
  front: {role: temperature, unit: degC, column: front}
  z: {role: error, unit: um, column: z}
"""


@dataclass(frozen=True)
class ReaderCase:
    """A reader, its files' suffix without the dot, and how to write a table in its format."""

    reader: type[Reader]
    suffix: str
    write: Write

    @cached_property
    def table(self) -> pd.DataFrame:
        """40 rows of time, two numbers and a text of digits; two numbers are missing."""
        rng = np.random.default_rng(0)
        front, z = (np.round(rng.normal(20, 5, N), 3) for _ in range(2))
        front[5], z[17] = np.nan, np.nan
        part = [f"{k:03d}" for k in range(N)]
        return pd.DataFrame({"t": 10.0 * np.arange(N), "front": front, "z": z, "part": part})

    @property
    def machine(self) -> Machine:
        return parse_machine(MACHINE, "thermodrift.testing")

    @contextmanager
    def file(self, content: bytes | None = None) -> Iterator[Path]:
        """A file of the table, or of these bytes."""
        with TemporaryDirectory() as folder:
            path = Path(folder) / f"run.{self.suffix}"
            if content is None:
                self.write(self.table, path)
            else:
                path.write_bytes(content)
            yield path

    def columns(
        self, path: Path, positions: Sequence[int], skip: int = 0, text: Sequence[int] = ()
    ) -> dict[int, list[Any]]:
        """Cells of the first sheet below the header and `skip` rows, by position."""
        with self.reader().open(path, NAMES) as sheets:
            first = header_row(sheets[0].head) + 1 + skip
            out: dict[int, list[Any]] = {p: [] for p in positions}
            for block in sheets[0].blocks(first, positions, text):
                expect(set(block.columns) == set(positions), f"blocks with columns {positions}", set(block.columns))
                sizes = {len(a) for a in block.columns.values()}
                expect(len(sizes) == 1, "columns of one length in a block", sizes)
                for p, array in block.columns.items():
                    out[p] += array.to_pylist()
            return out

    def batch(self, path: Path) -> Batch:
        (batch,) = read_batches(path, self.machine)
        return batch


def header_row(head: Sequence[Sequence[Any]]) -> int:
    for k, row in enumerate(head):
        if [str(cell) for cell in row[: len(NAMES)]] == list(NAMES):
            return k
    expect(False, f"the column names {NAMES} in a row of `head`", [list(row) for row in head[:3]])
    return 0


def numbers(cells: Sequence[Any]) -> list[float]:
    return [float("nan") if cell is None or cell == "" else float(cell) for cell in cells]


SUITE: Suite[ReaderCase] = Suite()


@SUITE.check("a reading that comes back as another number is worse than none")
def numbers_come_back(c: ReaderCase) -> None:
    expect(issubclass(c.reader, Reader), "a subclass of data.readers.base.Reader", c.reader)
    with c.file() as path:
        got = c.columns(path, [0, 1, 2])
    for p, name in enumerate(NAMES[:3]):
        expect_close(numbers(got[p]), c.table[name].to_numpy(), f"the values of {name}, missing ones as None or empty")


@SUITE.check("files have hundreds of columns; those that no channel names are not read")
def only_the_given_positions_are_read(c: ReaderCase) -> None:
    with c.file() as path:
        expect_close(numbers(c.columns(path, [2])[2]), c.table["z"].to_numpy(), "the column at position 2 alone")


@SUITE.check("units and titles stand between header and data in many files")
def data_begin_at_the_given_row(c: ReaderCase) -> None:
    with c.file() as path:
        expect_close(numbers(c.columns(path, [0], skip=5)[0]), c.table["t"].to_numpy()[5:], "the rows from row 5 on")


@SUITE.check("a part number 007 is no 7, a date 010203 is no number")
def text_columns_stay_text(c: ReaderCase) -> None:
    with c.file() as path:
        got = c.columns(path, [3], text=[3])[3]
    expect(got == list(c.table["part"]), "the cells of a text column as written", got[:3])


@SUITE.check("an ingest goes through it: rows, gaps and repairs of the batch")
def a_recording_becomes_a_batch(c: ReaderCase) -> None:
    with c.file() as path:
        batch = c.batch(path)
    known = c.table["front"].notna().to_numpy()
    expect_close(batch.values("front")[known], c.table["front"].to_numpy()[known], "the temperature in the batch")
    counts = {k: batch.repairs.get(k) for k in ("rows_in", "rows_dropped", "unparsable_values")}
    expect(counts == {"rows_in": N, "rows_dropped": 0, "unparsable_values": 0}, f"{N} rows, none lost", counts)


@SUITE.check("a file of another format under this suffix goes to quarantine with a reason")
def another_format_is_one_line(c: ReaderCase) -> None:
    for junk in JUNK:
        with c.file(junk) as path:
            expect_refused(lambda path=path: c.batch(path), f"run.{c.suffix}: ")  # type: ignore[misc]


@SUITE.check("a copy over a network stops half-way")
def a_cut_file_is_a_batch_or_one_line(c: ReaderCase) -> None:
    with c.file() as path:
        whole = path.read_bytes()
    for share in (0.05, 0.4, 0.8, 0.98):
        with c.file(whole[: int(share * len(whole))]) as path:
            try:
                c.batch(path)
            except InputError as error:
                expect(str(error).startswith("run.") and "\n" not in str(error), "one line with the file", str(error))
