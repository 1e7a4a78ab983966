"""Drafts a machine file from recordings: what can be seen is written down, every guess is marked as one."""

from __future__ import annotations

import datetime as dt
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data import guess
from data.errors import InputError
from data.guess import Guess, PositionGroup
from data.machine import Machine, parse_machine
from data.peek import Table, look, look_at, sheets_of
from data.readers.csv import normalise
from data.readers.header import Layout
from data.rows import Rows, join, stream
from data.timegrid import repair_time
from data.units import conversion, known_unit, quantity
from data.yaml_edit import flow

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
        unit = Guess(written if written in ("s", "min", "h") else "s", "given in the units row")
    else:
        unit = guess.time_unit(time if table.header else "", interval, length)
    in_s = {"min": 60.0, "h": 3600.0}.get(unit.value, 1.0)
    step_s = usual_s = guess.grid_step_s(interval * in_s)
    step_words = f"samples are {interval * in_s:.4g} s apart (median)"
    names, groups = _names(table), _groups(table)
    longest = max(rows, key=len)
    of_group = {i for g in groups for i in g.places}
    columns = {n: _Column.of(table, i, longest.columns[n]) for n, i in names.items() if i not in of_group}
    roles = {r: [n for n, c in columns.items() if c.role.value == r] for r in ("error", "position")}
    linked = guess.along_axis(roles["error"], roles["position"], longest)
    if linked or groups:
        sweeps = [longest.columns[g.value] for g in linked.values()]
        fine_s = guess.sweep_step_s(longest.time_s * in_s, sweeps, [len(g.places) for g in groups])
        if fine_s < step_s:
            step_s, step_words = fine_s, "each reading of a sweep takes a row"
    time_column = flow(time) if table.header else str(table.time)
    pattern = f", format: {flow(_pattern(table))}" if _pattern(table) else ""
    folder = re.sub(r"[^a-z0-9_\-]+", "_", paths[0].resolve().parent.name.lower()).strip("_-") or "machine"
    files = [p.name for p in paths]
    lines = [
        f"# Drafted from {len(files)} file{'s' * (len(files) > 1)}: {files[0]}{' … ' + files[-1] if files[1:] else ''}",
        f"# ({table.summary}). Look at every line marked 'guessed', correct it, and empty the guessed lists.",
        *(f"# left out: {line}" for line in left_out),
        f"machine: {flow(folder)}  # guessed: the folder's name",
        "recording:",
        f"  files: {flow([_files(paths)])}  # guessed: the names of the files",
        f"  header: {'true' if table.header else 'false'}",
        f"  time: {{column: {time_column}, unit: {unit.value}{pattern}}}  # guessed: {unit.why}",
        f"  step_s: {step_s:g}  # guessed: {step_words}",
        f"  max_gap_s: {5 * usual_s:g}  # guessed: 5 {'steps' if step_s == usual_s else 'samples'}",
    ]
    if start := _start_in_name(paths):
        lines.append(f"  start_from_name: {flow(start)}  # guessed: the files are named by date")
    lines.append("channels:")
    for name, column in columns.items():
        lines += _channel(name, column, np.concatenate([r.columns[name] for r in rows]), linked.get(name))
    key_of = {i: name for name, i in names.items()}
    for group in groups:
        stacked = np.concatenate([r.columns[key_of[i]] for r in rows for i in group.places])
        lines += _axis(group, stacked, [*columns])
    others = [c for i, c in enumerate(table.columns) if c and i != table.time and i not in table.numeric]
    if others and table.header:
        lines.append(f"ignore: {flow(list(dict.fromkeys(others)))}  # guessed: no numbers in them")
    text = "\n".join(lines) + "\n"
    parse_machine(text, "draft")
    return text


@dataclass(frozen=True)
class _Column:
    """What is known of a column before its values are looked at closely; `key` is how the file finds it, as YAML."""

    header: str
    written: str | None
    units_row: bool
    role: Guess
    key: str

    @classmethod
    def of(cls, table: Table, i: int, longest: NDArray[np.float64]) -> _Column:
        """The role shows in the longest recording."""
        header = table.columns[i] if table.header else ""
        in_row = known_unit(table.units[i])
        written = in_row or guess.unit_in_name(header)
        role = guess.role(header, written, longest)
        return cls(header, written, in_row is not None, role, f"column: {flow(header) if table.header else i}")


def _groups(table: Table) -> list[PositionGroup]:
    """Columns that are one error at several positions; what is in degrees is none."""
    places = [i for i in table.numeric if quantity(known_unit(table.units[i]) or "um") == "length"]
    return guess.position_groups(table.columns, places) if table.header else []


def _axis(group: PositionGroup, values: NDArray[np.float64], taken: Sequence[str]) -> list[str]:
    """Lines of the position channel and the error channel of columns that differ by a position."""
    words = re.sub(r"[^a-z]+", "_", group.pattern.partition("*")[0].lower()).strip("_")
    stem = group.letter or words or "axis"
    position, error = f"{stem}_position", f"{stem}_axis" if stem != "axis" else "axis_error"
    if {position, error} & set(taken):
        position, error = f"{position}_2", f"{error}_2"
    why = Guess("error", f"{len(group.places)} columns whose names differ by a number")
    column = _Column(group.pattern.partition("*")[0], None, False, why, f"columns: {flow(group.pattern)}")
    lines = _channel(error, column, values, Guess(position, "the number in the names is taken for the position"))
    return [
        f"  {position}:",
        "    role: position  # guessed: from the names of the columns",
        "    unit: mm  # guessed: usual for positions",
        "    guessed: [role, unit]",
        *lines,
    ]


def _channel(name: str, column: _Column, values: NDArray[np.float64], along: Guess | None) -> list[str]:
    """Lines of one channel; range and resolution show in all `values`."""
    role, written = column.role, column.written
    unit = Guess(written, "given in the units row") if column.units_row and written else None
    unit = unit or guess.unit(role.value, column.header, values)
    kept = {"temperature": "degC", "ambient": "degC", "error": "um"}.get(role.value, unit.value)
    convertible = quantity(kept) == quantity(unit.value)
    kept = kept if convertible else unit.value
    lines = [f"  {flow(name)}:", f"    role: {role.value}  # guessed: {role.why}"]
    lines.append(
        f"    unit: {flow(kept)}" + (f"  # guessed: {unit.why}" if kept == unit.value else "  # what the lake keeps")
    )
    if column.key != f"column: {flow(name)}":
        lines.append(f"    {column.key}")
    guessed = ["role", "unit"]
    if along is not None:
        lines.append(f"    position: {flow(along.value)}  # guessed: {along.why}")
        guessed.append("position")
    factor, offset = 1.0, 0.0
    if kept != unit.value:
        lines.append(f"    unit_in_file: {flow(unit.value)}  # guessed: {unit.why}")
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
                f"    range: {flow([float(v) for v in span])}  # guessed: seen {low:.4g} to {high:.4g}, widened"
            )
            guessed.append("range")
    return [*lines, f"    guessed: {flow(guessed)}"]


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
