"""Structure of an undescribed table: header, units row, time column, numeric columns."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data import guess
from data.errors import InputError
from data.readers import reader_for
from data.readers.base import Sheet
from data.readers.cells import parse_number, stamp_formats
from data.units import known_unit


@dataclass(frozen=True)
class Table:
    """Structure of a sheet, from its first rows."""

    columns: tuple[str, ...]  # headers, or positions as text
    units: tuple[str, ...]  # of a units row, "" where none
    header: bool
    first_row: int
    time: int
    stamps: tuple[str, ...]  # strptime patterns that fit, if time is a timestamp
    numeric: tuple[int, ...]  # positions of the channels
    summary: str


def look(path: Path) -> Table:
    """The first table of numbers in a file.

    Raises:
        InputError: the file cannot be read, or holds no table with a time column.
    """
    with sheets_of(path) as sheets:
        problems: list[InputError] = []
        for sheet in sheets:
            try:
                return look_at(sheet, path.name)
            except InputError as error:
                problems.append(error)
    raise problems[0]


def sheets_of(path: Path) -> AbstractContextManager[Sequence[Sheet]]:
    """The file's sheets, opened without knowing what to expect."""
    if path.is_dir():
        raise InputError(f"{path.name}: is a directory, expected recordings; give its files, such as {path}/*.csv")
    if not path.is_file():
        raise InputError(f"{path.name}: no such file at {path}; give the path of a recording")
    if path.stat().st_size == 0:
        raise InputError(f"{path.name}: the file is empty (0 bytes), expected a recording; copy it again")
    return reader_for(path).open(path, ())


def look_at(sheet: Sheet, where: str) -> Table:
    """Structure of one sheet. Raises InputError as `look`."""
    head = sheet.head
    first = next((i for i in range(len(head)) if _is_data(sheet, i)), None)
    if first is None:
        raise InputError(f"{where}: no table of numbers found; expected a time column and channels; export it as CSV")
    width = len(head[first])
    above = [row for row in head[max(0, first - 3) : first] if sum(bool(str(c or "").strip()) for c in row) >= 2]
    above = [row for row in above if abs(len(row) - width) <= 1]
    units: Sequence[Any] = ()
    if len(above) > 1 and _unit_share(above[-1]) >= 0.5:
        units, above = above[-1], above[:-1]
    header = above[-1] if above else None
    columns = [str(c or "").strip() for c in header[:width]] if header else [str(i) for i in range(width)]
    columns += [""] * (width - len(columns))
    body = [row for row in head[first : first + 200] if len(row) == width]
    time, stamps = _time(columns, body, sheet.decimal, bool(header), where)
    numeric = tuple(
        i
        for i in range(width)
        if i != time
        and columns[i]
        and columns.index(columns[i]) == i
        and any(parse_number(row[i], sheet.decimal) is not None for row in body)
    )
    if not numeric:
        raise InputError(
            f"{where}: no numeric column in addition to the time column {columns[time]!r}; record channels"
        )
    texts = tuple(str(units[i] or "").strip() if i < len(units) else "" for i in range(width))
    return Table(tuple(columns), texts, bool(header), first, time, stamps, numeric, sheet.summary)


def _is_data(sheet: Sheet, i: int) -> bool:
    """True where similar rows begin, most of whose cells are numbers."""
    rows = [row for row in sheet.head[i : i + 3] if row]
    if not sheet.head[i] or len(rows) < 2 or len({len(r) for r in rows}) > 1 or len(rows[0]) < 2:
        return False
    filled = [c for c in sheet.head[i] if c is not None and str(c).strip()]
    numbers = sum(parse_number(c, sheet.decimal) is not None or isinstance(c, dt.date | dt.time) for c in filled)
    return numbers >= max(1, 0.5 * (len(filled) - 1))


def _unit_share(row: Sequence[Any]) -> float:
    cells = [str(c).strip() for c in row if c is not None and str(c).strip()]
    return sum(known_unit(c) is not None for c in cells) / len(cells) if cells else 0.0


def _time(
    columns: Sequence[str], body: Sequence[Sequence[Any]], decimal: str, header: bool, where: str
) -> tuple[int, tuple[str, ...]]:
    """Position of the time column and, for stamps, the patterns that fit."""
    order = [i for i, c in enumerate(columns) if header and guess.is_time_name(c)]
    order += [i for i in range(len(columns)) if i not in order]
    for i in order:
        cells = [row[i] for row in body if row[i] is not None and str(row[i]).strip()]
        if len(cells) < 2:
            continue
        numbers = [parse_number(c, decimal) for c in cells]
        if all(n is not None for n in numbers):
            steps = np.diff(np.array(numbers, float))
            called_time = header and guess.is_time_name(columns[i])  # then many rows may share a time, as in a sweep
            if np.mean(steps >= 0) > 0.9 and np.mean(steps > 0) > (0.0 if called_time else 0.5):
                return i, ()
        elif all(isinstance(c, dt.date | dt.time | dt.timedelta) for c in cells):
            return i, ("",)
        elif fits := stamp_formats([c for c in cells if isinstance(c, str)]):
            return i, tuple(fits)
    raise InputError(f"{where}: no time column found, expected one that rises or holds timestamps; add one")
