"""Drafts a machine file from recordings: what can be seen is written down, every guess is marked as one."""

from __future__ import annotations

import datetime as dt
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data import guess
from data.errors import InputError
from data.guess import Guess
from data.machine import Machine, parse_machine
from data.peek import Table, look, look_at, sheets_of
from data.readers.header import Layout
from data.readers.text import normalise
from data.rows import Rows, join, stream
from data.timegrid import repair_time
from data.units import conversion, known_unit, quantity

_MAX_FILES = 20
_MAX_ROWS = 200_000
_NAME_DATES = ("%Y%m%d", "%Y-%m-%d", "%Y_%m_%d", "%Y%m%d_%H%M%S", "%Y-%m-%d_%H%M%S", "%Y%m%d-%H%M%S", "%Y%m%d%H%M%S")


def draft_machine_file(files: Sequence[Path]) -> str:
    """YAML text of a machine file for recordings of one machine that have the same columns.

    Every guess carries a comment ``# guessed: why`` and stands in the channel's ``guessed`` list. Values are taken
    from up to 20 of the files and their first 200 000 rows.

    Raises:
        InputError: no files, or none holds a table of numbers with a time column.
    """
    if not files:
        raise InputError("describe: no files given, expected recordings of one machine; name at least one")
    tables: list[tuple[Path, Table]] = []
    left_out: list[str] = []
    for path in files:
        try:
            table = look(path)
        except InputError as error:
            left_out.append(f"{path.name}: {str(error).removeprefix(path.name + ': ')}")
            continue
        if tables and table.columns != tables[0][1].columns:
            left_out.append(f"{path.name}: its columns are others than those of {tables[0][0].name}")
            continue
        tables.append((path, table))
    if not tables:
        raise InputError(left_out[0])
    every = max(1, -(-len(tables) // _MAX_FILES))
    rows = [_values(path, table) for path, table in tables[::every]]
    return _write([path for path, _ in tables], tables[0][1], rows, left_out)


def _slug(column: str, i: int, header: bool) -> str:
    if not header:
        return f"column_{i}"
    return re.sub(r"[^\w]+", "_", normalise(column) if not column.isascii() else column).strip("_") or f"column_{i}"


def _names(table: Table) -> dict[str, int]:
    names: dict[str, int] = {}
    for i in table.numeric:
        name = _slug(table.columns[i], i, table.header)
        names[name if name not in names and name != "time_s" else f"{name}_{i}"] = i
    return names


def _values(path: Path, table: Table) -> Rows:
    unit = "timestamp" if table.stamps else "s"
    machine = Machine.model_validate(
        {"machine": "draft", "channels": {}, "recording": {"time": {"unit": unit, "format": _pattern(table)}}}
    )
    with sheets_of(path) as sheets:
        for sheet in sheets:
            try:
                found = look_at(sheet, path.name)
            except InputError:
                continue
            layout = Layout(found.first_row, table.time, _names(table))
            return join(list(_limited(stream(sheet, layout, machine, path.name))))
    raise InputError(f"{path.name}: no table of numbers found; expected a time column and channels; export it as CSV")


def _limited(blocks: Iterator[Rows]) -> Iterator[Rows]:
    left = _MAX_ROWS
    for rows in blocks:
        yield rows if len(rows) <= left else rows.part(0, left)
        left -= len(rows)
        if left <= 0:
            return


def _pattern(table: Table) -> str | None:
    return table.stamps[0] if table.stamps and table.stamps[0] not in ("", "ISO8601") else None


def _write(paths: Sequence[Path], table: Table, rows: Sequence[Rows], left_out: Sequence[str]) -> str:
    time = table.columns[table.time]
    repaired = [repair_time(r.time_s, np.inf).time_s for r in rows]
    steps = np.concatenate([np.diff(t) for t in repaired])
    interval = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    length = max(float(t[-1]) if len(t) else 0.0 for t in repaired)
    if table.stamps:
        alternatives = f" (or {', '.join(table.stamps[1:])})" if len(table.stamps) > 1 else ""
        unit = Guess("timestamp", f"its cells look like it{alternatives}")
    elif written := known_unit(table.units[table.time]):
        unit = Guess(written if written in ("s", "min", "h") else "s", "the units row says so")
    else:
        unit = guess.time_unit(time if table.header else "", interval, length)
    interval *= {"min": 60.0, "h": 3600.0}.get(unit.value, 1.0)
    step_s = guess.grid_step_s(interval)
    column = _yaml(time) if table.header else str(table.time)
    pattern = f", format: {_yaml(_pattern(table))}" if _pattern(table) else ""
    folder = re.sub(r"[^a-z0-9_\-]+", "_", paths[0].resolve().parent.name.lower()).strip("_-") or "machine"
    names = [p.name for p in paths]
    lines = [
        f"# Drafted from {len(names)} file{'s' * (len(names) > 1)}: {names[0]}{' … ' + names[-1] if names[1:] else ''}",
        f"# ({table.words}). Look at every line marked 'guessed', correct it, and empty the guessed lists.",
        *(f"# left out: {line}" for line in left_out),
        f"machine: {_yaml(folder)}  # guessed: the folder's name",
        "recording:",
        f"  files: [{_yaml(_files(paths))}]  # guessed: the names of the files",
        f"  header: {'true' if table.header else 'false'}",
        f"  time: {{column: {column}, unit: {unit.value}{pattern}}}  # guessed: {unit.why}",
        f"  step_s: {step_s:g}  # guessed: samples are {interval:.4g} s apart (median)",
        f"  max_gap_s: {5 * step_s:g}  # guessed: 5 steps",
    ]
    if start := _start_in_name(paths):
        lines.append(f"  start_from_name: {_yaml(start)}  # guessed: the files are named by date")
    lines.append("channels:")
    for name, i in _names(table).items():
        longest = max(rows, key=len).columns[name]
        lines += _channel(name, i, table, longest, np.concatenate([r.columns[name] for r in rows]))
    others = [c for i, c in enumerate(table.columns) if c and i != table.time and i not in table.numeric]
    if others and table.header:
        lines.append(f"ignore: [{', '.join(map(_yaml, dict.fromkeys(others)))}]  # guessed: no numbers in them")
    text = "\n".join(lines) + "\n"
    parse_machine(text, "draft")
    return text


def _channel(name: str, i: int, table: Table, longest: NDArray[np.float64], values: NDArray[np.float64]) -> list[str]:
    """Lines of one channel; its role shows in the `longest` recording, range and resolution in all `values`."""
    header = table.columns[i] if table.header else ""
    written = known_unit(table.units[i]) or guess.unit_in_name(header)
    role = guess.role(header, written, longest)
    unit = Guess(written, "the units row says so") if known_unit(table.units[i]) and written else None
    unit = unit or guess.unit(role.value, header, values)
    kept = {"temperature": "degC", "ambient": "degC", "error": "um"}.get(role.value, unit.value)
    convertible = quantity(kept) == quantity(unit.value)
    kept = kept if convertible else unit.value
    lines = [f"  {_yaml(name)}:", f"    role: {role.value}  # guessed: {role.why}"]
    lines.append(
        f"    unit: {_yaml(kept)}" + (f"  # guessed: {unit.why}" if kept == unit.value else "  # what the lake keeps")
    )
    column = _yaml(header) if table.header else str(i)
    if column != _yaml(name):
        lines.append(f"    column: {column}")
    guessed = ["role", "unit"]
    factor, offset = 1.0, 0.0
    if kept != unit.value:
        lines.append(f"    unit_in_file: {_yaml(unit.value)}  # guessed: {unit.why}")
        guessed.append("unit_in_file")
        factor, offset = conversion(unit.value, kept, name)
    step = guess.resolution(values)
    if step is not None:
        lines.append(f"    resolution: {step * abs(factor):.6g}  # guessed: smallest step seen")
        guessed.append("resolution")
    if np.isfinite(values).any():
        low, high = np.nanmin(values) * factor + offset, np.nanmax(values) * factor + offset
        if span := guess.plausible_range(role.value, float(low), float(high)):
            lines.append(
                f"    range: [{_number(span[0])}, {_number(span[1])}]  # guessed: seen {low:.4g} to {high:.4g}, widened"
            )
            guessed.append("range")
    return [*lines, f"    guessed: [{', '.join(guessed)}]"]


def _number(x: float) -> str:
    """A number that YAML reads as one: 1e+06 would be text."""
    return repr(float(x)) if abs(x) < 1e15 else f"{x:.1f}"


def _yaml(text: str | None) -> str:
    """Plain where YAML reads it back as the same text, else quoted."""
    text = text or ""
    words = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}
    plain = re.fullmatch(r"[A-Za-z][\w%/\-]*", text, re.ASCII) and text.lower() not in words
    return text if plain else json.dumps(text, ensure_ascii=False)


def _files(paths: Sequence[Path]) -> str:
    suffix = paths[0].suffix
    stems = [p.stem for p in paths]
    if all(s[:1].isdigit() for s in stems):
        return f"[0-9]*{suffix}"
    same = next((k for k, letters in enumerate(zip(*stems, strict=False)) if len(set(letters)) > 1), 0)
    prefix = stems[0][:same].rstrip("0123456789")
    return f"{prefix if len(prefix) > 2 else ''}*{suffix}".replace("[", "?")


def _start_in_name(paths: Sequence[Path]) -> str | None:
    for pattern in _NAME_DATES:
        try:
            years = {dt.datetime.strptime(p.stem, pattern).year for p in paths}
        except ValueError:
            continue
        if all(1980 <= y <= 2100 for y in years):
            return pattern
    return None
