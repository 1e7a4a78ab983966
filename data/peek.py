"""Structure of an undescribed table: header, units row, clock, numeric columns."""

from __future__ import annotations

import datetime as dt
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from data import guess
from data.arrays import Array
from data.errors import InputError
from data.machine import Form, Pivot, TimeColumn
from data.readers import sheets_of
from data.readers.base import Sheet
from data.readers.cells import MISSING, cell_unit, is_elapsed, parse_number, stamp_formats, to_seconds, with_date
from data.readers.csv import normalise
from data.readers.pivot import MOST_NAMES
from data.readers.xlsx import arrow_column
from data.units import stated_unit

_CLOCK_ROWS = 2000  # that are searched for a clock
_EXCEL_DAYS = (36_000.0, 60_000.0)  # 1998 to 2064
_UNIX_S = 1e9  # from 2001 on
_SHOWN_ROWS = 3
_PIVOT_ROWS = 5000  # that are searched for a long table
_HEADER_ROWS = 5  # above the data, that are searched for names and units
_LEAST_ALONE = 5  # numbers below each other that are a table of one column
_LEAST_NUMBERS = 0.1  # of a channel's cells
_NO_UNITS = ("", "ts", "rn")  # in a row of units: Campbell's time stamp and record number
_TIME_LIKE = re.compile(r"\d{1,4}[-/.年]\w{1,3}[-/.月]\d|\d:\d\d")
_MOST = 0.9  # of the cells or steps of a clock: damaged cells and pauses happen


@dataclass(frozen=True)
class Clock:
    """Places of the clock (None: no column is one) and of the dates of a clock of times of day; the strptime patterns
    that fit time stamps; whether the clock shows durations; the columns that number the rows."""

    time: int | None
    date: int | None
    stamps: tuple[str, ...]
    elapsed: bool
    counters: tuple[int, ...]


@dataclass(frozen=True)
class Table:
    """Structure of a sheet, from its first rows. `form` is how its file is to be opened."""

    columns: tuple[str, ...]  # headers, or positions as text
    units: tuple[str, ...]  # of a units row or of the cells, "" where none
    header: bool
    first_row: int
    clock: Clock
    numeric: tuple[int, ...]  # positions of the channels
    left: dict[int, str]  # other columns, and why they are no channels
    cells: tuple[tuple[Any, ...], ...]  # the first ones of each column
    summary: str
    form: Form
    simulated: bool = False  # a line above the table says so
    sheet: str = ""  # its name, where the file has several
    origin_s: float = 0.0
    step_s: float | None = None  # between two rows, where the file says so

    @property
    def time(self) -> int | None:
        """Place of the clock; None: no column is one."""
        return self.clock.time

    @property
    def stamps(self) -> tuple[str, ...]:
        """The strptime patterns that fit, if the clock is of time stamps."""
        return self.clock.stamps

    def title(self, i: int) -> str:
        """The header of a column, "" without any."""
        return self.columns[i] if self.header else ""

    def key(self, i: int) -> str | int:
        """How a machine file names a column: its header, or its place where that is empty or not the only one."""
        name = normalise(self.columns[i])
        alone = sum(normalise(c) == name for c in self.columns) == 1
        return self.columns[i] if self.header and name and alone else i


def look(path: Path, form: Form | None = None) -> list[Table]:
    """The tables of numbers in a file, one for each sheet that holds one. `form` overrides what is found.

    Raises:
        InputError: the file cannot be read, or holds no table of numbers.
    """
    form = form or Form()
    tables: list[Table] = []
    problems: list[InputError] = []
    with sheets_of(path, (), form) as sheets:
        for sheet in sheets:
            try:
                tables.append(_look_at(sheet, path.name, form))
            except InputError as error:
                problems.append(error)
        pivot = _pivot(sheets[0], tables[0]) if len(sheets) == len(tables) == 1 and form.pivot is None else None
    if pivot is not None:
        time = TimeColumn(column=tables[0].key(tables[0].time or 0))
        return look(path, form.model_copy(update={"pivot": pivot, "time": time}))
    if not tables:
        raise problems[0]
    return tables


def _look_at(sheet: Sheet, where: str, form: Form) -> Table:
    first = _first_row(sheet, where, form)
    width = len(sheet.head[first])
    header, units = _headers(sheet, first, width, form)
    columns = [str(c or "").strip() for c in header[:width]] if header else [str(i) for i in range(width)]
    columns += [""] * (width - len(columns))
    body = [row for row in sheet.head[first : first + _CLOCK_ROWS] if len(row) == width]
    filled = [[c for row in body if (c := row[i]) is not None and str(c).strip()] for i in range(width)]
    of_rows = [str(units[i] or "").strip() if i < len(units) else "" for i in range(width)]
    titles = [row for row in sheet.head[:first] if _texts(row) == 1 or len(row) != width]
    stated = [_unit_of(cells[:200]) or of_rows[i] for i, cells in enumerate(filled)]
    clock = _clock(columns, filled, sheet.decimal, bool(header), stated, bool(sheet.origin_s))
    if clock.time is not None:
        clock = replace(clock, **_with_date(body, clock.time, clock.stamps))
    left: dict[int, str] = {}
    numeric = []
    for i, cells in enumerate(filled):
        some = cells[:: max(1, len(cells) // 200)]
        numbers = sum(_kind(c, sheet.decimal) == "n" for c in some)
        if i in (clock.time, clock.date):
            continue
        if i in clock.counters:
            left[i] = "numbers the rows, or is another clock"
        elif header and (why := guess.no_quantity(columns[i])):
            left[i] = why
        elif all(str(c).strip() in MISSING for c in some):
            left[i] = "empty or NaN" if cells else "empty"
        elif numbers <= _LEAST_NUMBERS * len(some):
            time = bool(header) and guess.is_time_name(columns[i]) and clock.time is None
            left[i] = f"{'a time in no known format' if time else 'text'}, such as {str(cells[0])[:30]!r}"
        else:
            numeric.append(i)
    if not 0 < len(numeric) <= MOST_NAMES:
        why = ", ".join(f"{columns[i]} ({text})" for i, text in [*left.items()][:4])
        got = f"{len(numeric)} columns of numbers" if numeric else f"no column of numbers next to the clock: {why}"
        raise InputError(f"{where}: {got}; expected 1 to {MOST_NAMES} channels of a machine; export those")
    return Table(
        tuple(columns), tuple(stated), bool(header), first, clock, tuple(numeric), left,
        tuple(tuple(row[i] for row in body[:_SHOWN_ROWS]) for i in range(width)), sheet.summary, form,
        any("simulat" in str(c).lower() for row in titles for c in row),
        sheet.name, sheet.origin_s, sheet.step_s,
    )  # fmt: skip


def _first_row(sheet: Sheet, where: str, form: Form) -> int:
    """Where similar rows of numbers begin, as wide as most of the last rows."""
    if form.header_rows is not None and form.header_rows < len(sheet.head):
        return form.header_rows
    if sheet.first_row is not None:
        return sheet.first_row
    widths = Counter(len(row) for row in sheet.head[-200:] if row)
    usual = widths.most_common(1)[0][0] if widths else 0
    starts = (i for i in range(len(sheet.head)) if _is_data(sheet, i))
    first = next(starts, None)
    if first is not None and len(sheet.head[first]) != usual:
        first = next((i for i in starts if len(sheet.head[i]) == usual), first)
    if first is None:
        raise InputError(f"{where}: {_why_no_table(sheet)}")
    return first


def _why_no_table(sheet: Sheet) -> str:
    filled = sum(_texts(row) > 0 for row in sheet.head)
    rows = sum(any(_kind(c, sheet.decimal) == "n" for c in row) for row in sheet.head)
    if filled < 2 or rows == 1:
        found = "one row of numbers" if rows else "no row below its first line" if filled else "nothing, it is blank"
        return f"the table holds {found}; expected at least 2 rows below the names; record or copy it again"
    return (
        f"no table of numbers found; expected a time column and channels; it was read as {sheet.summary}:"
        " give separator and header_rows (lines above the data), or export it as CSV"
    )


def _is_data(sheet: Sheet, i: int) -> bool:
    """True where three rows of one kind begin, half of whose cells are numbers or times."""
    rows = [row for row in sheet.head[i : i + 3] if row]
    if not sheet.head[i] or len(rows) < 2 or len({len(r) for r in rows}) > 1:
        return False
    if len(rows[0]) < 2:
        rows = [row for row in sheet.head[i : i + _LEAST_ALONE] if row]
    kinds = [[_kind(c, sheet.decimal) for c in row] for row in rows]
    alike = all(len({k for k in column if k in ("n", "t")}) < 2 for column in zip(*kinds, strict=False))
    enough = all(k.count("n") + k.count("t") >= max(1, 0.5 * (len(k) - k.count("") - 1)) for k in kinds)
    return alike and enough and "n" in kinds[0] and (len(kinds[0]) > 1 or len(kinds) == _LEAST_ALONE)


def _kind(cell: Any, decimal: str) -> str:
    """n, t or x: a number, a time, text; nothing where the cell is empty."""
    if cell is None or not str(cell).strip():
        return ""
    if parse_number(cell, decimal) is not None or cell_unit(cell) is not None:
        return "n"
    return "t" if isinstance(cell, dt.date | dt.time | dt.timedelta) or _TIME_LIKE.search(str(cell)) else "x"


def _headers(sheet: Sheet, first: int, width: int, form: Form) -> tuple[Sequence[Any], Sequence[Any]]:
    """The names of the columns and their units, empty where there are none, from the rows above the data.

    The units are the row in which most cells are units, the names the one with most different texts, the last of these.
    """
    above = sheet.head[max(0, first - _HEADER_ROWS) : first] if form.header_rows is None else sheet.head[:first]
    rows = [row for row in above if 0.5 * width <= len(row) <= width + 1 and _texts(row) >= min(2, width)]
    units: Sequence[Any] = sheet.units
    if form.units_row is not None:
        units = sheet.head[form.units_row - 1]
        rows = [row for row in rows if row is not units]
    elif len(rows) > 1 and _unit_share(best := max(rows, key=_unit_share)) >= 0.5:
        units = best
        rows = [row for row in rows if row is not best]
    if not rows or not form.header:
        return (), units
    header = max(reversed(rows), key=lambda row: (_texts([c for c in row if parse_number(c) is None]), _texts(row)))
    shifted = "blank" in sheet.summary and len(header) != width  # names and cells do not stand under each other
    return () if shifted else header, units


def _texts(row: Sequence[Any]) -> int:
    return len({str(c).strip() for c in row if c is not None and str(c).strip()})


def _unit_share(row: Sequence[Any]) -> float:
    cells = [str(c).strip() for c in row if c is not None and str(c).strip().lower() not in _NO_UNITS]
    return sum(stated_unit(c) is not None for c in cells) / len(cells) if cells else 0.0


def _unit_of(cells: Sequence[Any]) -> str:
    """The unit that stands behind the number in nearly all cells, else nothing."""
    units = Counter(unit for c in cells if (unit := cell_unit(c)))
    unit, n = units.most_common(1)[0] if units else ("", 0)
    return unit if n >= _MOST * len(cells) else ""


def _pivot(sheet: Sheet, table: Table) -> Pivot | None:
    """The columns of names and of readings, if the table holds one reading in a row.

    The times then rise within the rows of each name, and names change with times that repeat or fall: from row to row,
    or from one block of rows to the next. A column that is called like one of names may also change while times rise.
    """
    if table.time is None or not table.header:
        return None
    body = [row for row in sheet.head[table.first_row :] if len(row) == len(table.columns)][:_PIVOT_ROWS]
    kind, stamp = ("timestamp", table.stamps[0] or None) if table.stamps else ("s", None)
    time_s = pd.Series(to_seconds(arrow_column([row[table.time] for row in body]), kind, stamp, sheet.decimal))
    stands = time_s.diff() <= 0
    frame = pd.DataFrame(body).map(lambda c: str(c or "").strip())
    called = [i for i in table.numeric if guess.is_series_name(table.columns[i])]
    texts = [*(i for i, why in table.left.items() if why.startswith("text")), *called]
    names = sorted((i for i in texts if 2 <= frame[i].nunique() <= len(body) / 3), key=lambda i: -frame[i].nunique())
    values = [i for i in table.numeric if i not in names]
    values = [i for i in values if guess.is_value_name(table.columns[i])] or values
    for group in [*([i] for i in names), *([names] if len(names) > 1 else [])]:
        name = frame[group].agg(" ".join, axis=1)
        change = name != name.shift()
        rises = time_s.groupby(name).diff().dropna() > 0
        series = len(values) == 1 and any(guess.is_series_name(table.columns[i]) for i in group)
        scans = change.mean() > 0.3 and (series or stands.mean() > 0.3)
        blocks = bool(stands.any()) and bool(change[stands].all()) and stands[change][1:].mean() > _MOST
        if rises.mean() > _MOST and (scans or blocks) and all(isinstance(table.key(i), str) for i in (*group, *values)):
            keys = [[table.columns[i] for i in places] for places in (group, values)]
            return Pivot(
                name=keys[0][0] if len(group) == 1 else keys[0], value=keys[1][0] if len(values) == 1 else keys[1]
            )
    return None


def _clock(
    columns: Sequence[str],
    filled: Sequence[Sequence[Any]],
    decimal: str,
    header: bool,
    units: Sequence[str],
    begun: bool,
) -> Clock:
    """The clock and the row counters, from the filled cells by column. `begun`: the file states when the clock began.

    A column with a header that says time may repeat times, as the rows of a sweep do; of several such columns the one
    that rises most often is the clock. Any other must rise with every row, in nearly equal steps, and its header must
    not be a channel's.
    """
    named = [i for i, c in enumerate(columns) if header and guess.is_time_name(c)]
    counters: list[int] = []
    ticking: list[int] = []
    # named, rises nearly always, shows times, share of rising steps, place, …: a clock set back, not its tick counter
    found: list[tuple[bool, bool, bool, float, int, tuple[str, ...], bool]] = []
    for i, (column, cells) in enumerate(zip(columns, filled, strict=True)):
        if len(cells) < 2 or (header and i not in named and guess.is_other_name(column)):
            continue
        numbers = [n for c in cells if (n := parse_number(c, decimal)) is not None]
        stamps: tuple[str, ...] = ()
        elapsed = is_elapsed(cells)
        if len(numbers) >= _MOST * len(cells):
            steps = np.diff(np.array(numbers))
            if (
                header
                and i not in named
                and guess.is_counter_name(column)
                and np.mean((steps == 0) | (steps == 1)) > _MOST
            ):
                counters.append(i)
                continue
            if header and bool((steps > 0).all()) and np.ptp(steps) <= 1e-6 * steps[0]:
                ticking.append(i)
            if not begun and _since_1970(numbers, units[i] or guess.time_unit_in_name(column) if header else None):
                stamps = ("",)
        elif elapsed or (stamps := _stamps(cells)):
            unit, pattern = ("s", None) if elapsed else ("timestamp", stamps[0])
            steps = np.diff(to_seconds(arrow_column(list(cells)), unit, pattern, decimal))
        else:
            continue
        if _goes_on(steps) if i in named or stamps or elapsed else _ticks(steps):
            rises = float(np.mean(steps > 0))
            found.append((i in named, rises > _MOST, bool(stamps) or elapsed, rises, -i, stamps, elapsed))
    if not found:
        return Clock(None, None, (), False, tuple(counters))
    *_, place, stamps, elapsed = max(found)
    return Clock(-place, None, stamps, elapsed, (*counters, *(i for i in ticking if i != -place)))


def _with_date(body: Sequence[Sequence[Any]], time: int, stamps: tuple[str, ...]) -> dict[str, Any]:
    """The column of the dates that a clock of times of day needs, and the patterns of both together; for `Clock`."""
    of_day = all(isinstance(row[time], dt.time) for row in body) if stamps == ("",) else True
    if not of_day or any("%d" in s or "8601" in s for s in stamps):
        return {}
    times = arrow_column([row[time] for row in body[:200]])
    for i in range(len(body[0])):
        dates = arrow_column([row[i] for row in body[:200]])
        of_dates = pa.types.is_timestamp(dates.type) or parse_number(body[0][i]) is None
        if i == time or dates.null_count or not of_dates or pa.types.is_floating(times.type):
            continue
        if fits := stamp_formats([text or "" for text in with_date(dates, times).to_pylist()]):
            return {"date": i, "stamps": tuple(fits), "elapsed": False}
    return {}


def _since_1970(numbers: Sequence[float], unit: str | None) -> bool:
    """Numbers like seconds, ms, … since 1970, or like the days of a workbook where no unit is stated."""
    first, step = numbers[0], np.median(np.abs(np.diff(numbers)))
    return first >= _UNIX_S or (not unit and _EXCEL_DAYS[0] <= first <= _EXCEL_DAYS[1] and step < 0.5)


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
