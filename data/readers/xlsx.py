"""XLSX reader: streams the sheets of a workbook."""

from __future__ import annotations

import datetime as dt
import itertools
import warnings
import zipfile
import zlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import ParseError

import numpy as np
import pyarrow as pa

from data.errors import InputError
from data.readers.base import HEAD_ROWS, Block, Reader, Sheet

_BLOCK_ROWS = 20_000
_DAMAGE = (zipfile.BadZipFile, zlib.error, ParseError, KeyError, ValueError, TypeError, IndexError, AttributeError,
           EOFError, OSError, NotImplementedError, OverflowError)  # fmt: skip
_MIDNIGHT = dt.datetime(1900, 1, 1)


class XlsxSheet(Sheet):
    def __init__(self, path: Path, worksheet: Any) -> None:
        self.name = worksheet.title.strip()
        self._path = path
        self._worksheet = worksheet
        worksheet.reset_dimensions()
        self.head = [list(row) for row in itertools.islice(self._rows(1), HEAD_ROWS)]
        self.summary = f"sheet {self.name!r}"

    def _rows(self, first_row: int) -> Iterator[Sequence[Any]]:
        try:
            for row in self._worksheet.iter_rows(min_row=first_row, values_only=True):
                yield () if all(cell is None for cell in row) else row
        except _DAMAGE as error:
            raise _damaged(self._path, error) from None

    def blocks(self, first_row: int, positions: Sequence[int], text: Collection[int] = ()) -> Iterator[Block]:
        rows = (row for row in self._rows(first_row + 1) if row)
        while chunk := list(itertools.islice(rows, _BLOCK_ROWS)):
            yield Block({i: arrow_column([row[i] if i < len(row) else None for row in chunk]) for i in positions})


def arrow_column(cells: list[Any]) -> Any:
    """Arrow array of numbers, of timestamps, or of text where cells are mixed."""
    kinds = {type(cell) for cell in cells} - {type(None)}
    if kinds <= {int, float}:
        return pa.array(np.array(cells, dtype=np.float64))
    if kinds <= {dt.datetime, dt.date, dt.time, dt.timedelta}:
        return pa.array([_stamp(cell) for cell in cells], pa.timestamp("us"))
    stamps = (dt.datetime, dt.date, dt.time, dt.timedelta)
    return pa.array(
        [None if c is None else _stamp(c).isoformat(" ") if isinstance(c, stamps) else str(c) for c in cells],
        pa.string(),
    )


def _stamp(cell: Any) -> Any:
    """Excel's kinds of time as one; a time of day or a duration counts from 1900-01-01."""
    if isinstance(cell, dt.timedelta):
        return _MIDNIGHT + cell
    if isinstance(cell, dt.time):
        return dt.datetime.combine(_MIDNIGHT.date(), cell.replace(tzinfo=None))
    if isinstance(cell, dt.date) and not isinstance(cell, dt.datetime):
        return dt.datetime.combine(cell, dt.time())
    return cell


def _damaged(path: Path, error: BaseException) -> InputError:
    reason = (str(error).splitlines() or [""])[0]
    return InputError(
        f"{path.name}: damaged or truncated XLSX ({type(error).__name__}: {reason});"
        " expected a workbook that Excel opens; save or copy it again"
    )


class XlsxReader(Reader):
    """One or several sheets; numbers, text and Excel's dates."""

    @contextmanager
    def open(self, path: Path, hints: Sequence[str]) -> Iterator[list[Sheet]]:
        from openpyxl import load_workbook  # takes long to load

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # openpyxl warns of styles and extensions, which do not matter here
            try:
                book = load_workbook(path, read_only=True, data_only=True)
            except _DAMAGE as error:
                raise _damaged(path, error) from None
            try:
                if not book.worksheets:
                    raise InputError(f"{path.name}: the workbook has no worksheet; save or copy it again")
                yield [XlsxSheet(path, worksheet) for worksheet in book.worksheets]
            finally:
                book.close()
