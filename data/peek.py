"""Structure of an undescribed table: header, units row, clock, numeric columns."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from data import guess
from data.arrays import Array
from data.errors import InputError
from data.readers import reader_for
from data.readers.base import Sheet
from data.readers.cells import parse_number, stamp_formats, to_seconds, with_date
from data.readers.xlsx import arrow_column
from data.units import known_unit

_CLOCK_ROWS = 2000  # that are searched for a clock
_MOST = 0.9  # of the cells or steps of a clock: damaged cells and pauses happen


@dataclass(frozen=True)
class Clock:
    """Places of the clock (None: no column is one) and of the dates of a clock of times of day; the strptime patterns
    that fit time stamps; the columns that number the rows."""

    time: int | None
    date: int | None
    stamps: tuple[str, ...]
    counters: tuple[int, ...]


@dataclass(frozen=True)
class Table:
    """Structure of a sheet, from its first rows."""

    columns: tuple[str, ...]  # headers, or positions as text
    units: tuple[str, ...]  # of a units row, "" where none
    header: bool
    first_row: int
    clock: Clock
    numeric: tuple[int, ...]  # positions of the channels
    summary: str
    sheet: str = ""  # its name, where the file has several

    @property
    def time(self) -> int | None:
        """Place of the clock; None: no column is one."""
        return self.clock.time

    @property
    def stamps(self) -> tuple[str, ...]:
        """The strptime patterns that fit, if the clock is of time stamps."""
        return self.clock.stamps


def look(path: Path) -> list[Table]:
    """The tables of numbers in a file, one for each sheet that holds one.

    Raises:
        InputError: the file cannot be read, or holds no table of numbers.
    """
    tables: list[Table] = []
    problems: list[InputError] = []
    with sheets_of(path) as sheets:
        for sheet in sheets:
            try:
                tables.append(look_at(sheet, path.name))
            except InputError as error:
                problems.append(error)
    if not tables:
        raise problems[0]
    return tables


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
    body = [row for row in head[first : first + _CLOCK_ROWS] if len(row) == width]
    clock = _clock(columns, body, sheet.decimal, bool(header))
    numeric = tuple(
        i
        for i in range(width)
        if i not in (clock.time, clock.date, *clock.counters)
        and columns[i]
        and columns.index(columns[i]) == i
        and any(parse_number(row[i], sheet.decimal) is not None for row in body)
    )
    if not numeric:
        raise InputError(f"{where}: no numeric column in addition to the time column; record channels")
    texts = tuple(str(units[i] or "").strip() if i < len(units) else "" for i in range(width))
    return Table(tuple(columns), texts, bool(header), first, clock, numeric, sheet.summary, sheet.name)


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


def _clock(columns: Sequence[str], body: Sequence[Sequence[Any]], decimal: str, header: bool) -> Clock:
    """The clock and the row counters.

    A column with a header that says time may repeat times, as the rows of a sweep do; of several such columns the one
    that rises most often is the clock. Any other must rise with every row, in nearly equal steps, and its header must
    not be a channel's.
    """
    named = [i for i, c in enumerate(columns) if header and guess.is_time_name(c)]
    counters = []
    found: list[tuple[float, int, tuple[str, ...]]] = []  # share of rising steps (1 more: named), place, patterns
    for i, column in enumerate(columns):
        cells = [row[i] for row in body if row[i] is not None and str(row[i]).strip()]
        if len(cells) < 2 or (header and i not in named and guess.is_other_name(column)):
            continue
        numbers = [n for c in cells if (n := parse_number(c, decimal)) is not None]
        stamps: tuple[str, ...] = ()
        if len(numbers) >= _MOST * len(cells):
            steps = np.diff(np.array(numbers))
            if header and i not in named and guess.is_counter_name(column) and bool((steps == 1).all()):
                counters.append(i)
                continue
        elif stamps := _stamps(cells):
            steps = np.diff(to_seconds(arrow_column(list(cells)), "timestamp", stamps[0], decimal))
        else:
            continue
        if _goes_on(steps) if i in named or stamps else _ticks(steps):
            found.append((float(np.mean(steps > 0)) + (i in named), -i, stamps))
    if not found:
        return Clock(None, None, (), tuple(counters))
    _, place, stamps = max(found)
    date, stamps = _with_date(body, -place, stamps)
    return Clock(-place, date, stamps, tuple(counters))


def _with_date(body: Sequence[Sequence[Any]], time: int, stamps: tuple[str, ...]) -> tuple[int | None, tuple[str, ...]]:
    """The column of the dates that a clock of times of day needs, and the patterns of both together."""
    of_day = all(isinstance(row[time], dt.time) for row in body) if stamps == ("",) else bool(stamps)
    if not of_day or any("%d" in s or "8601" in s for s in stamps):
        return None, stamps
    times = arrow_column([row[time] for row in body[:200]])
    for i in range(len(body[0])):
        dates = arrow_column([row[i] for row in body[:200]])
        of_dates = pa.types.is_timestamp(dates.type) or parse_number(body[0][i]) is None
        if i == time or dates.null_count or not of_dates:
            continue
        if fits := stamp_formats([text or "" for text in with_date(dates, times).to_pylist()]):
            return i, tuple(fits)
    return None, stamps


def _goes_on(steps: Array) -> bool:
    """Steps of a clock that may stand still."""
    known = steps[np.isfinite(steps)]
    return len(known) > 0 and float(np.mean(known >= 0)) > _MOST and bool((known > 0).any())


def _ticks(steps: Array) -> bool:
    """Steps of a clock that rises with every row, nearly all of them within half of the median step."""
    usual = float(np.median(steps))
    return usual > 0 and bool((steps > 0).all()) and float(np.mean(np.abs(steps - usual) <= 0.5 * usual)) > _MOST


def _stamps(cells: Sequence[Any]) -> tuple[str, ...]:
    """The patterns of cells that are time stamps: "" for those of a workbook."""
    if all(isinstance(c, dt.date | dt.time | dt.timedelta) for c in cells):
        return ("",)
    return tuple(stamp_formats([c for c in cells[:200] if isinstance(c, str)]))
