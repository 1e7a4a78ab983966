"""Layout of a sheet: header, units row, first data row, and the column of each channel."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from typing import Any

from data.errors import InputError
from data.machine import Machine
from data.readers.base import Sheet
from data.readers.cells import parse_number, wall_clock_s
from data.readers.csv import normalise

_WORDS = re.compile(r"[^\W\d_]+|\d+")
_UNIT_ROWS = 3  # rows between header and data that may hold units or descriptions


class NotThisTable(InputError):
    """A sheet without any column of the machine file: no recording of this machine."""


@dataclass(frozen=True)
class Layout:
    """First data row, position of time (None: the rows are the clock) and of each channel found, counts of what was
    skipped.

    `sweeps`: error channel -> (key in `positions`, position along its axis) where each position has a column.
    """

    first_row: int
    time: int | None
    positions: Mapping[str, int]
    counts: Mapping[str, int] = field(default_factory=dict)
    sweeps: Mapping[str, tuple[tuple[str, float], ...]] = field(default_factory=dict)
    date: int | None = None  # of the dates, where time holds times of day
    origin_s: float = 0.0  # what the wall clock shows more than the clock of the rows
    above: int = 0  # rows of data above the header


def wanted_columns(machine: Machine) -> dict[str, str | int]:
    """Channel -> column (name, position or pattern of several) for every channel that the file must give."""
    found: dict[str, str | int] = {}
    by_columns = {part.position for part in machine.channels.values() if part.columns is not None}
    for name, part in machine.channels.items():
        if part.columns:
            found[name] = part.columns if isinstance(part.columns, str) else next(iter(part.columns))
        elif part.source == "file" and name not in by_columns:
            found[name] = name if part.column is None else part.column
    return found


def hints(machine: Machine) -> list[str]:
    """The column names that a recording is expected to have."""
    several = [c for part in machine.channels.values() if isinstance(part.columns, dict) for c in part.columns]
    time = machine.recording.time
    columns = [*([time.column, time.date] if time.step is None else []), *wanted_columns(machine).values(), *several]
    return [c for c in columns if isinstance(c, str)]


def _sweep_columns(columns: str | Mapping[str | int, float], header: Sequence[Any]) -> list[tuple[str | int, float]]:
    """(column, position along the axis) of the columns in the file's order; a column of the header by its place."""
    if not isinstance(columns, str):
        return list(columns.items())
    before, _, after = _squeezed(columns).partition("*")
    pattern = re.compile(rf"{re.escape(before)}([-+]?\d+(?:[.,]\d+)?){re.escape(after)}")
    found = ((i, pattern.fullmatch(_squeezed(cell))) for i, cell in enumerate(header) if cell is not None)
    return [(i, float(match[1].replace(",", "."))) for i, match in found if match]


def _squeezed(name: object) -> str:
    return normalise(name).replace(" ", "")


def locate(sheet: Sheet, machine: Machine, where: str, need_error: bool = True) -> Layout:
    """Find header, units row, first data row and the columns.

    Raises:
        NotThisTable: no column of the machine file is there.
        InputError: no time column; no error channel although the machine file has some.
    """
    wanted = wanted_columns(machine)
    time = machine.recording.time
    header: Sequence[Any] = ()
    row = -1
    if machine.recording.header:
        row = _header_row(sheet.head[: machine.recording.header_rows], hints(machine), where)
        header = sheet.head[row]
    width = len(header) or max((len(r) for r in sheet.head[-200:]), default=0)
    by_name: dict[str, int] = {}
    for i, cell in enumerate(header):
        if cell is not None and str(cell).strip():
            by_name.setdefault(normalise(cell), i)

    def position(column: str | int) -> int | None:
        if isinstance(column, str):
            return by_name.get(normalise(column))
        return column if 0 <= column < width else None

    positions: dict[str, int] = {}
    sweeps: dict[str, tuple[tuple[str, float], ...]] = {}
    for name, column in wanted.items():
        if columns := machine.channels[name].columns:
            several = [(p, mm) for c, mm in _sweep_columns(columns, header) if (p := position(c)) is not None]
            sweeps |= {name: tuple((f"{name}@{p}", mm) for p, mm in several)} if several else {}
            positions |= {f"{name}@{p}": p for p, _ in several}
        elif (p := position(column)) is not None:
            positions[name] = p
    got_channels = {*positions, *sweeps} & set(wanted)
    at = position(time.column) if time.step is None else None
    date = None if time.date is None else position(time.date)
    got = _some([str(c) for c in header]) if header else f"{width} columns"
    if not positions:
        raise _unknown(where, width, got, machine)
    if at is None and time.step is None:
        raise InputError(
            f"{where}: time column {time.column!r} is missing; got {got}; correct recording.time.column, or give"
            " time: {step: 60 s} where the recording has no clock"
        )
    if time.date is not None and date is None:
        raise InputError(
            f"{where}: column {time.date!r} of the dates is missing; got {got}; correct recording.time.date"
        )
    errors = [n for n in machine.names("error") if n in wanted]
    if need_error and errors and not any(n in got_channels for n in errors):
        raise InputError(
            f"{where}: no error channel; got {got}, expected column {_some([str(wanted[n]) for n in errors])};"
            " correct column: of the error channels"
        )
    ignored = (position(int(c) if c.isdigit() else c) for c in machine.ignore)
    known = {*positions.values(), *(p for p in (at, date, *ignored) if p is not None)}
    unknown = [c for c, i in by_name.items() if i not in known]
    for name, column in wanted.items():
        if name not in got_channels and isinstance(column, str) and (meant := _misspelt(column, unknown)):
            raise InputError(
                f"{where}: column {column!r} of channel {name!r} is missing; did you mean"
                f" {str(header[by_name[meant]])!r}? Correct column: of the channel, or add that one to ignore"
            )
    named = sum(bool(str(c or "").strip()) for c in header) if header else width
    first = machine.recording.header_rows
    if first is None:
        first = _first_data_row(sheet, row + 1, at, list(positions.values()), bool(header))
    over = [r for i, r in enumerate(sheet.head[:first]) if r and i != row]
    above = sum(_is_row(r, sheet.decimal) for r in over)
    units = sum(bool(r) and not _is_row(r, sheet.decimal) for r in sheet.head[row + 1 : first]) if header else 0
    counts = {
        "preamble_rows": len(over) - above - units,
        "unit_rows": units,
        "unknown_columns": max(0, named - len(known)),
        "missing_channels": len(wanted) - len(got_channels),
    }
    origin_s = sheet.origin_s
    if time.unit == "timestamp" and first < len(sheet.head) and at is not None and at < len(sheet.head[first]):
        origin_s = wall_clock_s(sheet.head[first][at])
    return Layout(first, at, positions, {k: v for k, v in counts.items() if v}, sweeps, date, origin_s, above)


def _is_row(row: Sequence[Any], decimal: str) -> bool:
    """Whether a row above the data is one of data: a clock or number first, and numbers in most other cells."""
    filled = [c for c in row if c is not None and str(c).strip()]
    numbers = sum(parse_number(c, decimal) is not None for c in filled[1:])
    return len(filled) > 1 and _is_clock(filled[0]) and 2 * numbers > len(filled) - 1


def _misspelt(column: str, others: Sequence[str]) -> str | None:
    """The name that differs from a column's by some letters of long words: short ones and numbers name a sensor."""
    words = _WORDS.findall(normalise(column))
    for other in others:
        pairs = zip(words, theirs, strict=True) if len(theirs := _WORDS.findall(other)) == len(words) else ()
        odd = [(a, SequenceMatcher(None, a, b).ratio()) for a, b in pairs if a != b]
        if odd and all(a.isalpha() and len(a) > 4 and ratio >= 0.75 for a, ratio in odd):
            return other
    return None


def _some(names: Sequence[str], n: int = 3) -> str:
    return ", ".join(repr(x[:40]) for x in names[:n]) + (" …" if len(names) > n else "")


def _unknown(where: str, width: int, got: str, machine: Machine) -> NotThisTable:
    expected = _some([str(c) for c in wanted_columns(machine).values()])
    return NotThisTable(
        f"{where}: none of its {width} columns is a channel of machine {machine.machine};"
        f" got {got}, expected {expected};"
        " correct column: in the machine file, or take the machine file of this recording"
    )


def _header_row(head: Sequence[Sequence[Any]], names: Sequence[str], where: str) -> int:
    wanted = {normalise(n) for n in names}
    best, best_row = 0, -1
    for i, row in enumerate(head):
        found = len(wanted & {normalise(c) for c in row if c is not None})
        if found > best:
            best, best_row = found, i
        if best == len(wanted) > 0:
            break
    if best_row >= 0:
        return best_row
    filled = [i for i, row in enumerate(head) if row]
    if not filled:
        raise NotThisTable(
            f"{where}: the table is empty; expected a header and at least 2 rows; record or copy it again"
        )
    return filled[0]


def _first_data_row(sheet: Sheet, start: int, time: int | None, positions: Sequence[int], header: bool) -> int:
    """Row of the first data: behind units, or, without a header, behind any title lines."""
    for i in range(start, len(sheet.head) if not header else min(len(sheet.head), start + _UNIT_ROWS)):
        row = sheet.head[i]
        clock = row[time] if time is not None and time < len(row) else None
        if not row or (clock is None and header and time is not None):
            continue
        numbers = any(parse_number(row[p], sheet.decimal) is not None for p in positions if p < len(row))
        ticks = time is None or _is_clock(clock)
        if (numbers and ticks) or (header and numbers) or (header and time is not None and ticks):
            return i
    return start


def _is_clock(cell: Any) -> bool:
    return not isinstance(cell, str) or bool(re.match(r"\s*[-+\"]?\d", cell))
