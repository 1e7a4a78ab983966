"""A table that is written in a format and read back, whole, cut and damaged, for every registered reader."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal

from data.batch import Batch
from data.errors import InputError
from data.machine import parse_machine
from data.readers import READERS
from data.recording import read_batches

NAMES, N = ("t", "front", "z", "part"), 40
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
LVM = "LabVIEW Measurement\t\nDecimal_Separator\t.\n***End_of_Header***\t\n"
WRITERS: dict[str, Callable[[pd.DataFrame, Path], object]] = {  # a line for each reader
    "csv": lambda table, path: table.to_csv(path, index=False),
    "xlsx": lambda table, path: table.to_excel(path, index=False),
    "parquet": lambda table, path: table.to_parquet(path),
    "lvm": lambda table, path: path.write_text(LVM + table.to_csv(sep="\t", index=False)),
}


@dataclass(frozen=True)
class Case:
    """A reader and a file of its format in a folder of the test's own."""

    key: str
    path: Path

    @property
    def table(self) -> pd.DataFrame:
        """40 rows of time, two numbers of which one each is missing, and a text of digits."""
        rng = np.random.default_rng(0)
        front, z = (np.round(rng.normal(20, 5, N), 3) for _ in range(2))
        front[5], z[17] = np.nan, np.nan
        part = [f"{k:03d}" for k in range(N)]
        return pd.DataFrame({"t": 10.0 * np.arange(N), "front": front, "z": z, "part": part})

    def columns(self, positions: Sequence[int], skip: int = 0, text: Sequence[int] = ()) -> list[list[Any]]:
        """Cells of the first sheet below the header and `skip` rows."""
        out: list[list[Any]] = [[] for _ in positions]
        with READERS[self.key]().open(self.path, NAMES) as sheets:
            head = [[str(cell) for cell in row[: len(NAMES)]] for row in sheets[0].head]
            for block in sheets[0].blocks(head.index(list(NAMES)) + 1 + skip, positions, text):
                assert set(block.columns) == set(positions) and len({len(a) for a in block.columns.values()}) == 1
                for cells, p in zip(out, positions, strict=True):
                    cells += block.columns[p].to_pylist()
        return out

    def batch(self) -> Batch:
        (batch,) = read_batches(self.path, parse_machine(MACHINE, "mill"))
        return batch


@pytest.fixture(params=READERS, name="c")
def case(request: pytest.FixtureRequest, tmp_path: Path) -> Case:
    made = Case(request.param, tmp_path / f"run.{request.param}")
    WRITERS[request.param](made.table, made.path)
    return made


def numbers(cells: Sequence[Any]) -> list[float]:
    return [float("nan") if cell is None or cell == "" else float(cell) for cell in cells]


def test_numbers_come_back_and_missing_ones_stay_missing(c: Case) -> None:
    assert_array_equal([numbers(cells) for cells in c.columns([0, 1, 2])], c.table[list(NAMES[:3])].to_numpy().T)


def test_only_the_given_positions_are_read_from_the_given_row(c: Case) -> None:
    assert_array_equal(numbers(c.columns([2])[0]), c.table["z"].to_numpy())
    assert_array_equal(numbers(c.columns([0], skip=5)[0]), c.table["t"].to_numpy()[5:])


def test_text_columns_stay_text(c: Case) -> None:
    """A part number 007 is no 7."""
    assert c.columns([3], text=[3]) == [list(c.table["part"])]


def test_a_recording_becomes_a_batch(c: Case) -> None:
    batch, known = c.batch(), c.table["front"].notna().to_numpy()
    assert_array_equal(batch.values("front")[known], c.table["front"].to_numpy()[known])
    counts = {k: batch.repairs.get(k) for k in ("rows_in", "rows_dropped", "unparsable_values")}
    assert counts == {"rows_in": N, "rows_dropped": 0, "unparsable_values": 0}


@pytest.mark.parametrize("junk", JUNK, ids=["bytes", "zip", "parquet", "png"])
def test_another_format_is_one_line(c: Case, junk: bytes) -> None:
    c.path.write_bytes(junk)
    with pytest.raises(InputError, match=rf"\A.*run.{c.key}: .*\Z"):
        c.batch()


@pytest.mark.parametrize("share", [0.05, 0.4, 0.8, 0.98])
def test_a_cut_file_is_a_batch_or_one_line(c: Case, share: float) -> None:
    """A copy over a network stops half-way."""
    whole = c.path.read_bytes()
    c.path.write_bytes(whole[: int(share * len(whole))])
    try:
        c.batch()
    except InputError as error:
        assert str(error).startswith("run.") and "\n" not in str(error)
