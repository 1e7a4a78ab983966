"""Tables over time for run plans: a time column and a column per driver or surrounding; CSV, Parquet or Excel."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data.arrays import Array
from data.errors import InputError, closest
from data.machine import Machine
from data.readers import reader_for
from data.readers.base import Sheet
from data.readers.cells import to_float, to_seconds
from data.readers.csv import normalise
from data.units import conversion, convert, known_unit

_WITH_UNIT = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]\s*")
_TIMES = {"time_s": "s", "time_min": "min", "time_h": "h"}


@dataclass(frozen=True)
class PlanTable:
    """`time_s` (m,) from 0, strictly rising; each column (m,) in its channel's unit, NaN where the cell is empty."""

    time_s: Array
    columns: Mapping[str, Array]


def read_plan_table(
    path: Path, machine: Machine, units: Mapping[str, str], where: str, others: bool = False
) -> PlanTable:
    """Read a table; `units` maps every driver and surrounding that it may hold to the unit that is kept.

    A header may name the unit of its column, "spindle_rpm [krpm]". Time is the machine file's time column, time_s,
    time_min, time_h, or "time [unit]". A recording serves as it is: the machine's other channels are passed over,
    and with `others` every column that is not requested.

    Raises:
        InputError: no file, an unknown column (with the closest), no time column, fewer than two rows, a cell that is
            no number, or a time that does not rise, with its row.
    """
    if not path.is_file():
        raise InputError(f"{where}: no such file; give the path of a CSV file, relative to the plan")
    aliases = {normalise(n): n for n in units}
    for name, part in machine.channels.items():
        if name in units and isinstance(part.column, str):
            aliases.setdefault(normalise(part.column), name)
    names = [*aliases, str(machine.recording.time.column), *_TIMES]
    with reader_for(path).open(path, names) as sheets:
        sheet = sheets[0]
        header_row = next((i for i, row in enumerate(sheet.head) if _filled(row)), None)
        if header_row is None:
            raise InputError(f"{where}: the table is empty; expected a header with a time column and at least 2 rows")
        header = [str(cell or "").strip() for cell in sheet.head[header_row]]
        at, unit, pattern = _time_column(header, machine, where)
        found = _columns(header, at, aliases, machine, units, where, others)
        text = (at,) if unit == "timestamp" else ()
        blocks = list(sheet.blocks(header_row + 1, [at, *(p for p, _ in found.values())], text))
    if ragged := sum(b.ragged_rows for b in blocks):
        raise InputError(f"{where}: {ragged} rows have too many or too few cells; correct them")
    time_s = _joined([to_seconds(b.columns[at], unit, pattern, sheet.decimal) for b in blocks])
    _check_time(time_s, header[at], where)
    columns = {n: _column(blocks, p, sheet, u, units[n], f"{where}: column {n!r}") for n, (p, u) in found.items()}
    return PlanTable(time_s - time_s[0], columns)


def fill_short_gaps(values: Array, time_s: Array, max_gap_s: float, hold: bool, where: str) -> Array:
    """NaN filled, same shape: by the value before (`hold`), else linearly; at an end by the nearest value.

    Raises:
        InputError: a gap longer than `max_gap_s`, from its first empty row to the next value.
    """
    bad = np.isnan(values)
    if not bad.any():
        return values
    good = np.flatnonzero(~bad)
    if not len(good):
        raise InputError(f"{where}: has no value at all; fill the column or leave it out")
    first = np.flatnonzero(bad & ~np.r_[False, bad[:-1]])
    behind = np.searchsorted(good, first)
    ends = np.where(behind < len(good), time_s[good[np.minimum(behind, len(good) - 1)]], time_s[-1])
    lengths = ends - time_s[first]
    longest = int(lengths.argmax())
    if lengths[longest] > max_gap_s:
        raise InputError(
            f"{where}: no value for {lengths[longest]:g} s from data row {first[longest] + 1}"
            f" (t = {time_s[first[longest]]:g} s), more than the {max_gap_s:g} s that may be filled;"
            " write the values, or widen max_gap_s"
        )
    if hold:
        last = np.maximum.accumulate(np.where(bad, 0, np.arange(len(values))))
        held = values[last]
        return np.where(np.isnan(held), values[good[0]], held)
    return np.interp(time_s, time_s[good], values[good])


def _filled(row: Sequence[Any]) -> bool:
    return any(str(c or "").strip() for c in row) and not str(row[0] or "").lstrip().startswith("#")


def _name_and_unit(head: str) -> tuple[str, str]:
    split = _WITH_UNIT.fullmatch(head)
    return (split[1], split[2].strip()) if split and split[1] else (head, "")


def _time_column(header: Sequence[str], machine: Machine, where: str) -> tuple[int, str, str | None]:
    """Position, unit and pattern of the time column."""
    own = machine.recording.time
    for i, head in enumerate(header):
        if isinstance(own.column, str) and normalise(head) == normalise(own.column):
            return i, own.unit, own.format
    for i, head in enumerate(header):
        name, unit = _name_and_unit(normalise(head))
        if name in _TIMES:
            return i, _TIMES[name], None
        if name == "time" and known_unit(unit) in ("s", "min", "h"):
            return i, str(known_unit(unit)), None
    raise InputError(f"{where}: no time column among {_some(header)}; name it time_s, time_min or time_h")


def _some(header: Sequence[str]) -> str:
    return ", ".join(repr(h[:40]) for h in header[:6]) + (" …" if len(header) > 6 else "")


def _columns(
    header: Sequence[str],
    time: int,
    aliases: Mapping[str, str],
    machine: Machine,
    units: Mapping[str, str],
    where: str,
    others: bool,
) -> dict[str, tuple[int, str]]:
    """Name -> (position, unit as written) of every driver and surrounding found."""
    passed = {normalise(n) for n in (*machine.channels, *machine.ignore)}
    passed |= {normalise(c.column) for c in machine.channels.values() if isinstance(c.column, str)}
    found: dict[str, tuple[int, str]] = {}
    for i, head in enumerate(header):
        if i == time or not head:
            continue
        whole = aliases.get(normalise(head))
        name, unit = (head, "") if whole else _name_and_unit(head)
        key = whole or aliases.get(normalise(name))
        if key is None:
            if others or normalise(name) in passed:
                continue
            raise InputError(f"{where}: unknown column {name!r}; {closest(name, [*units, *_TIMES])}")
        if key in found:
            raise InputError(f"{where}: column {key!r} is given twice; remove one")
        part = machine.channels.get(key)
        own = (part.unit_in_file or "") if part and normalise(name) == normalise(part.column or key) else ""
        found[key] = (i, unit or own)
    if not found:
        raise InputError(f"{where}: no column {' or '.join(repr(u) for u in units)} among {_some(header)}; add one")
    return found


def _joined(parts: Sequence[Array]) -> Array:
    return np.concatenate(parts) if parts else np.empty(0)


def _check_time(time_s: Array, name: str, where: str) -> None:
    if len(time_s) < 2:
        raise InputError(f"{where}: {len(time_s)} data rows, expected at least 2; the last one ends the plan")
    bad = np.flatnonzero(~np.isfinite(time_s))
    if len(bad):
        raise InputError(f"{where}: data row {bad[0] + 1}: column {name!r} holds no readable time; correct it")
    back = np.flatnonzero(np.diff(time_s) <= 0)
    if len(back):
        k = int(back[0]) + 1
        step = time_s[k] - time_s[k - 1]
        raise InputError(f"{where}: data row {k + 1}: time goes {step:+g} s from the row before; put the rows in order")


def _column(blocks: Sequence[Any], position: int, sheet: Sheet, written: str, unit: str, where: str) -> Array:
    parts, row = [], 0
    for block in blocks:
        values, unreadable = to_float(block.columns[position], sheet.decimal)
        if unreadable is not None:
            k = int(np.flatnonzero(unreadable)[0])
            cell = block.columns[position][k].as_py()
            raise InputError(f"{where} data row {row + k + 1}: got {cell!r}, expected a number in {unit}; correct it")
        parts.append(values)
        row += len(values)
    return convert(_joined(parts), written or unit, unit, where)


_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")


def quantity(given: Any, unit: str, where: str) -> float:
    """The number in `unit` that "4 krpm" or a bare number (already in `unit`) means.

    Raises:
        InputError: no finite number, an unknown unit or one of another quantity; `where` opens the line.
    """
    value, written = _split(given, unit, where)
    factor, offset = conversion(written, unit, where) if written else (1.0, 0.0)
    return factor * value + offset


def difference_K(given: Any, where: str) -> float:
    """A temperature difference: "0.3 K", "0.3 degC" or "0.5 degF" in K. Raises as `quantity`."""
    value, written = _split(given, "K", where)
    return value * (conversion(written, "degC", where)[0] if written else 1.0)


def rate_K_per_s(given: Any, where: str) -> float:
    """A drift such as "0.4 K/h" in K/s; a bare number counts as K/h. Raises as `quantity`."""
    value, written = _split(given, "K/h", where)
    kelvin, slash, time = (written or "K/h").partition("/")
    if not slash:
        raise InputError(f"{where}: got {given!r}, expected a rate such as '0.4 K/h'")
    return value * conversion(kelvin.strip(), "degC", where)[0] / conversion(time.strip(), "s", where)[0]


def in_range(values: Array, name: str, machine: Machine, where: str) -> Array:
    """The values, same shape, if the channel of that name has no range or they lie in it.

    Raises:
        InputError: one lies outside.
    """
    part = machine.channels.get(name)
    if part is None or part.range is None:
        return values
    low, high = part.range
    out = np.flatnonzero((values < low) | (values > high))
    if len(out):
        raise InputError(
            f"{where}: {values[out[0]]:g} {part.unit} is outside the channel's range {low:g} to {high:g} {part.unit};"
            " correct it, or the range in the machine file"
        )
    return values


def _split(given: Any, unit: str, where: str) -> tuple[float, str]:
    """Number and unit as written; the unit is empty where there is none."""
    if isinstance(given, int | float) and not isinstance(given, bool):
        value, written = float(given), ""
    else:
        found = _NUMBER.fullmatch(given) if isinstance(given, str) else None
        if found is None:
            raise InputError(f"{where}: got {given!r}, expected a number in {unit} or with a unit, e.g. '1 {unit}'")
        value, written = float(found[1]), found[2]
    if not math.isfinite(value):
        raise InputError(f"{where}: got {given!r}, expected a finite number in {unit}")
    return value, written


_WAVE = ("start", "drift", "ripple", "period")
_FILE = ("file", "column")


def surrounding_degC(given: Any, name: str, time_s: Array, folder: Path, machine: Machine, where: str) -> Array:
    """One surrounding at the plan's borders `time_s` (n,), shape (n,), degC.

    `given` is a temperature, ``{start, drift, ripple, period}`` (start + drift t + ripple sin(2 pi t / period)), a
    list of [hours, degC] joined by straight lines, its ends held, or ``{file, column}`` with the path relative to
    `folder`. A file may end before the plan by no more than the machine's `max_gap_s`.

    Raises:
        InputError: none of these, a wrong unit, times that do not rise, a file that cannot be used or is too short.
    """
    if isinstance(given, Mapping):
        keys = [str(k) for k in given]
        allowed = _FILE if "file" in given else _WAVE
        for key in keys:
            if key not in allowed:
                raise InputError(f"{where}: unknown key {key!r}; {closest(key, (*_FILE, *_WAVE))}")
        return _file(given, name, time_s, folder, machine, where) if "file" in given else _wave(given, time_s, where)
    if isinstance(given, list):
        return _points(given, time_s, where)
    return np.full(len(time_s), quantity(given, "degC", where))


def _wave(given: Mapping[str, Any], time_s: Array, where: str) -> Array:
    if "start" not in given:
        raise InputError(f"{where}: key 'start' is missing; write e.g. start: 20 degC")
    if ("ripple" in given) != ("period" in given):
        lacking = "period" if "ripple" in given else "ripple"
        raise InputError(f"{where}: key {lacking!r} is missing; a ripple needs ripple (K) and period (min) together")
    out = quantity(given["start"], "degC", f"{where}.start") + np.zeros(len(time_s))
    if "drift" in given:
        out += rate_K_per_s(given["drift"], f"{where}.drift") * time_s
    if "ripple" in given:
        period_s = 60.0 * quantity(given["period"], "min", f"{where}.period")
        if period_s <= 0:
            raise InputError(f"{where}.period: got {given['period']!r}, expected more than 0 min")
        out += difference_K(given["ripple"], f"{where}.ripple") * np.sin(2 * np.pi * time_s / period_s)
    return out


def _points(given: Sequence[Any], time_s: Array, where: str) -> Array:
    if not given:
        raise InputError(f"{where}: got an empty list, expected points [hours, degC]")
    for k, point in enumerate(given, 1):
        if not isinstance(point, list) or len(point) != 2:
            raise InputError(f"{where} point {k}: got {point!r}, expected [hours, degC], e.g. [0, 20]")
    hours = np.array([quantity(p[0], "h", f"{where} point {k}") for k, p in enumerate(given, 1)])
    degC = np.array([quantity(p[1], "degC", f"{where} point {k}") for k, p in enumerate(given, 1)])
    back = np.flatnonzero(np.diff(hours) <= 0)
    if len(back):
        k = int(back[0]) + 1
        raise InputError(
            f"{where} point {k + 1}: {hours[k]:g} h is not after {hours[k - 1]:g} h; put the points in order"
        )
    return np.interp(time_s, hours * 3600.0, degC)


def _file(given: Mapping[str, Any], name: str, time_s: Array, folder: Path, machine: Machine, where: str) -> Array:
    column = str(given.get("column", name))
    path = folder / str(given["file"])
    here = f"{where}: file {path}"
    table = read_plan_table(path, machine, {column: "degC"}, here, others=True)
    max_gap_s = machine.recording.max_gap_s
    if (short_s := time_s[-1] - table.time_s[-1]) > max_gap_s:
        raise InputError(
            f"{here}: ends {short_s:g} s before the plan ({time_s[-1]:g} s), more than max_gap_s {max_gap_s:g};"
            " give a longer file or shorten the plan"
        )
    values = fill_short_gaps(table.columns[column], table.time_s, max_gap_s, False, f"{here}: column {column!r}")
    return np.interp(time_s, table.time_s, values)
