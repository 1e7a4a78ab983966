"""Reading of a recording file into batches: time repaired, values on the regular grid, in canonical units.

`Batch.repairs` counts, for every batch; the keys of rows always add up: ``rows_in = rows_used + rows_dropped``.

| key | what |
|---|---|
| `rows_in` | data rows of the source that belong to this batch (no blank lines, no header, units or title lines) |
| `rows_used` | source rows that went into at least one value of the grid (a mean, an interpolation, a held driver) |
| `rows_dropped` | source rows that contributed nothing: the sum of the six reasons below |
| `ragged_rows` | dropped: too many or too few cells, e.g. a last line that was cut |
| `unparsable_time` | dropped: time empty or unreadable |
| `time_outliers` | dropped: a lone row whose time is far off |
| `rows_before_run` | dropped: before the first run of a recording that is cut (counted with the first batch) |
| `rows_empty` | dropped: not one readable value |
| `rows_between` | dropped: between two grid points, needed by neither |
| `rows_out` | rows of the grid |
| `duplicates`, `backward_steps`, `clock_restarts` | repaired times, see `data.timegrid` |
| `gaps`, `channel_gaps` | holes longer than max_gap_s: of all channels, of single ones |
| `unparsable_values` | cells that are no number; empty cells and "NaN" are not counted |
| `missing_channels`, `unknown_columns` | channels without a column, columns without a channel |
| `preamble_rows`, `unit_rows`, `skipped_sheets` | title lines, lines between header and data, sheets of other content |
| `readings` | along axes (see `data.sweeps`): that were read, of errors at a position |
| `readings_without_position` | errors along an axis whose row has no position: nowhere in the grid |
| `start_unreadable` | 1 if the file's name does not fit start_from_name |
"""

from __future__ import annotations

import datetime as dt
import fnmatch
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.batch import Batch
from data.errors import InputError
from data.lakefile import native_parquet
from data.machine import Machine, Schedule
from data.readers import has_reader, reader_for
from data.readers.base import Sheet
from data.readers.cells import parse_number
from data.readers.csv import read_text_table
from data.readers.header import Layout, NotThisTable, hints, locate
from data.rows import Rows, cut_runs, gather, stream
from data.sweeps import Columns, take_readings
from data.timegrid import repair_time, to_grid
from data.units import check_canonical, convert

_LONGER_SHARE = 0.05
_LONGER_S = 600.0


def scheduled(
    schedule: Schedule, directory: Path, batch_ids: tuple[str, ...], time_s: NDArray[np.float64]
) -> tuple[dict[str, NDArray[np.float64]], dict[str, Any]]:
    """Driver channels as recorded in the schedule, piecewise constant on time_s (n,), and the batch's labels.

    `batch_ids` are the names under which the batch may stand there, best first. Stages follow each other from t = 0.
    A recording that goes on clearly longer than its stages (by 5 % or 10 min) had stopped: its drivers are 0 from
    there; otherwise the last stage holds to the end.

    Raises:
        InputError: schedule file or column missing, no row for the batch, a stage without a number.
    """
    path = directory / schedule.file
    if not path.is_file():
        raise InputError(f"{batch_ids[0]}: schedule {schedule.file!r} is missing next to the recording; put it there")
    rows = read_text_table(path)
    columns = [schedule.batch_column, *schedule.labels.values()]
    columns += [c for stage in schedule.stages for c in (stage.hours, *stage.drivers.values())]
    for column in columns:
        if rows and column not in rows[0]:
            raise InputError(
                f"{schedule.file}: no column {column!r}; got {', '.join(rows[0])}; correct recording.schedule"
            )
    by_id = {row[schedule.batch_column].removesuffix(".0"): row for row in rows}
    row = next((by_id[b] for b in batch_ids if b in by_id), None)
    if row is None:
        raise InputError(
            f"{batch_ids[0]}: no row in schedule {schedule.file} with {schedule.batch_column} = {batch_ids[0]!r}"
            f" ({len(rows)} rows); add one or move the recording away"
        )
    labels = {label: _value(row[column]) for label, column in schedule.labels.items()}
    return _drivers(schedule, row, batch_ids[0], time_s), labels


def _drivers(
    schedule: Schedule, row: Mapping[str, str], batch_id: str, time_s: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    values = {name: np.zeros(len(time_s)) for stage in schedule.stages for name in stage.drivers}
    begin = 0.0
    last: dict[str, float] = {}
    for stage in schedule.stages:
        if not row[stage.hours]:
            continue
        end = begin + 3600.0 * _number(row, stage.hours, schedule.file, batch_id)
        during = (time_s >= begin - 1e-6) & (time_s < end - 1e-6)
        for name, column in stage.drivers.items():
            last[name] = _number(row, column, schedule.file, batch_id)
            values[name][during] = last[name]
        begin = end
    beyond = time_s[-1] - begin if len(time_s) else 0.0
    if beyond <= min(_LONGER_SHARE * begin, _LONGER_S):
        for name, value in last.items():
            values[name][time_s >= begin - 1e-6] = value
    return values


def _number(row: Mapping[str, str], column: str, file: str, batch_id: str) -> float:
    value = parse_number(row[column])
    if value is None:
        raise InputError(f"{file} row {batch_id} column {column!r}: got {row[column]!r}, expected a number; correct it")
    return value


def _value(text: str) -> Any:
    number = parse_number(text)
    return text if number is None else number


_FIRST_STAMP_S = 3.0e8  # mid-1979: an earlier stamp is a clock without a date


def recording_files(directory: Path, machine: Machine) -> tuple[list[Path], list[Path]]:
    """(recordings, other files) of a directory, both sorted; the patterns are `recording.files`, case does not matter.

    The schedule file and hidden files are neither.

    Raises:
        InputError: no such directory.
    """
    if not directory.is_dir():
        raise InputError(f"{directory}: no such directory; give the folder of the recordings")
    schedule = machine.recording.schedule
    deep = any("/" in pattern for pattern in machine.recording.files)
    recordings: list[Path] = []
    others: list[Path] = []
    for path in sorted(directory.rglob("*") if deep else directory.iterdir()):
        relative = path.relative_to(directory).as_posix()
        if not path.is_file() or path.name.startswith(".") or (schedule and relative == schedule.file):
            continue
        patterns = (p.lower().removeprefix("./").replace("**/", "*") for p in machine.recording.files)
        fits = any(fnmatch.fnmatchcase(relative.lower(), p) for p in patterns)
        known = has_reader(path) and not path.name.startswith("~$")
        (recordings if fits and known else others).append(path)
    return recordings, others


def read_batches(path: Path, machine: Machine, need_error: bool = True) -> Iterator[Batch]:
    """The batches of one file, without findings, one at a time.

    Several where a workbook has several sheets of recordings (`stem-sheet`) or where `recording.split` cuts a long
    one (`stem-01`, `stem-02`, …). A bad sheet or stretch does not hold back the good ones: its error comes last.
    With `need_error=False` a file without error channels is good as well (to predict from it). A Parquet file that
    thermodrift wrote is read by its own note, not by the machine file's columns (`data.lakefile`).

    Raises:
        InputError: the file, a sheet or a stretch cannot be used; one line.
    """
    _check_file(path)
    check_canonical({n: (c.role, c.unit) for n, c in machine.channels.items()}, f"machine file {machine.machine}")
    own = native_parquet(path)
    if own is None:
        yield from _file_batches(path, machine, need_error)
        return
    for batch in _file_batches(path, own.layout(machine), need_error):
        yield own.marked(batch)


def _file_batches(path: Path, machine: Machine, need_error: bool) -> Iterator[Batch]:
    with reader_for(path).open(path, hints(machine)) as sheets:
        tables: list[tuple[Sheet, Layout]] = []
        errors: list[InputError] = []
        skipped: list[InputError] = []
        several = len(sheets) > 1
        for sheet in sheets:
            try:
                where = f"{path.name} sheet {sheet.name!r}" if several else path.name
                tables.append((sheet, locate(sheet, machine, where, need_error)))
            except NotThisTable as error:
                skipped.append(error)
            except InputError as error:
                errors.append(error)
        if not tables and not errors:
            raise skipped[0]
        extra = {"skipped_sheets": len(skipped)} if skipped else {}
        for sheet, layout in tables:
            batch_id = f"{path.stem}-{sheet.name}" if len(tables) + len(errors) > 1 else path.stem
            where = f"{path.name} sheet {sheet.name!r}" if several else path.name
            try:
                source = _Source(machine, path, batch_id, where, need_error, layout.sweeps)
                yield from _sheet_batches(sheet, layout, source, extra, errors)
            except InputError as error:
                errors.append(error)
            extra = {}
    if errors:
        more = f" (and {len(errors) - 1} more parts of the file cannot be used)" if len(errors) > 1 else ""
        raise InputError(f"{errors[0]}{more}")


def _check_file(path: Path) -> None:
    if path.is_dir():
        raise InputError(f"{path}: is a directory, expected one recording file; give the file, or ingest the directory")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the path of a recording")
    if path.stat().st_size == 0:
        raise InputError(
            f"{path.name}: the file is empty (0 bytes); expected a header and at least 2 rows; copy it again"
        )


@dataclass(frozen=True)
class _Source:
    """Origin of a batch: `where` names it in messages; `sweeps` are the columns of errors along axes."""

    machine: Machine
    path: Path
    batch_id: str
    where: str
    need_error: bool
    sweeps: Columns


def _sheet_batches(
    sheet: Sheet, layout: Layout, source: _Source, extra: dict[str, int], errors: list[InputError]
) -> Iterator[Batch]:
    machine, where = source.machine, source.where
    blocks = stream(sheet, layout, machine, where)
    split = machine.recording.split
    extra = {**extra, **layout.counts}
    if split is None:
        yield _batch(gather(blocks, sheet), source, extra, 0.0)
        return
    if split.driver not in machine.channels:
        raise InputError(f"machine file {machine.machine}: recording.split.driver {split.driver!r} is no channel")
    still = 0.5 * (machine.channels[split.driver].resolution or 0.0)
    first: list[float] = []

    def noting_the_start() -> Iterator[Rows]:
        for rows in blocks:
            if not first:
                first.extend(rows.time_s[np.isfinite(rows.time_s)][:1].tolist())
            yield rows

    for k, rows in enumerate(cut_runs(noting_the_start(), split.driver, split.min_run_s, still, where)):
        part = replace(source, batch_id=f"{source.batch_id}-{k + 1:02d}", where=f"{where} part {k + 1:02d}")
        try:
            yield _batch(rows, part, extra, first[0])
        except InputError as error:
            errors.append(error)
        extra = {}


def _batch(rows: Rows, source: _Source, extra: dict[str, int], file_start: float) -> Batch:
    """`file_start` is the file's first time in s, needed where its name gives the start and the file is cut."""
    machine, path, where, recording = source.machine, source.path, source.where, source.machine.recording
    repaired = repair_time(rows.time_s, recording.max_gap_s)
    n_rows = len(rows)
    if len(repaired.order) < 2:
        raise _too_few(rows, len(repaired.order), machine, where)
    held = set(machine.names("driver"))
    untouched = len(repaired.order) == n_rows and bool((np.diff(repaired.order) == 1).all())
    keep = slice(None) if untouched else repaired.order
    values = {n: v[keep] for n, v in rows.columns.items()}
    unreadable = int(rows.unreadable.sum())
    filled = np.zeros(len(repaired.order), bool)
    for v in values.values():
        if not filled.all():
            filled |= ~np.isnan(v)
    rows.columns.clear()
    readings, read_counts = take_readings(values, repaired.time_s, machine, source.sweeps, where)
    grid = to_grid(repaired.time_s, values, held, recording.step_s, recording.max_gap_s, where)
    is_reading = np.zeros(len(filled), bool)
    for r in readings:
        grid.columns.update(r.on_grid(recording.step_s, len(grid.time_s), recording.max_gap_s, where))
        is_reading[r.row] = True
    if readings:  # rows of a sweep under one time stamp repeat no time
        repeats = np.diff(repaired.time_s, prepend=-1.0) == 0
        repaired.counts["duplicates"] -= int((repeats & is_reading).sum())
    used = (grid.used | is_reading) & filled
    repairs = {
        "rows_in": n_rows + rows.ragged + rows.before_run,
        "rows_used": int(used.sum()),
        "rows_out": len(grid.time_s),
        "ragged_rows": rows.ragged,
        "rows_before_run": rows.before_run,
        **{"time_outliers": 0, "clock_restarts": 0, **repaired.counts},
        "rows_empty": int((~filled).sum()),
        "rows_between": int((filled & ~used).sum()),
        "channel_gaps": grid.channel_gaps,
        "unparsable_values": unreadable,
        **read_counts,
        **extra,
    }
    reasons = ("ragged_rows", "unparsable_time", "time_outliers", "rows_before_run", "rows_empty", "rows_between")
    repairs["rows_dropped"] = sum(repairs[r] for r in reasons)

    columns = {"time_s": grid.time_s}
    labels: dict[str, object] = {}
    from_schedule: dict[str, np.ndarray] = {}
    if recording.schedule:
        from_schedule, labels = scheduled(recording.schedule, path.parent, (source.batch_id, path.stem), grid.time_s)
    for name, part in machine.channels.items():
        column = (from_schedule if part.source == "schedule" else grid.columns).get(name)
        if column is None and part.source == "schedule":
            raise InputError(
                f"machine file {machine.machine}: channel {name!r} has source: schedule, but no stage of"
                " recording.schedule gives it; add it there"
            )
        if column is None:
            columns[name] = np.full(len(grid.time_s), np.nan)
        else:
            here = f"machine file {machine.machine}: channel {name!r}"
            columns[name] = convert(column, part.unit_in_file or part.unit, part.unit, here)
    _check_filled(columns, machine, where, source.need_error, unreadable)
    start = _start(path, machine, repaired.start, file_start)
    if start is None and recording.start_from_name:
        repairs["start_unreadable"] = 1
    return Batch(
        machine=machine.machine, batch_id=source.batch_id, table=pd.DataFrame(columns, copy=False),
        channels=machine.batch_channels(), start=start,
        simulated=machine.simulated, source=path.name, repairs=repairs, labels=labels,
    )  # fmt: skip


def _too_few(rows: Rows, usable: int, machine: Machine, where: str) -> InputError:
    time = machine.recording.time
    seen = len(rows) + rows.ragged
    if seen < 2 or not len(rows):
        return InputError(f"{where}: {seen} data rows, expected at least 2; record or copy it again")
    return InputError(
        f"{where}: {usable} of {seen} rows have a readable time in column {time.column!r} as {time.unit}, expected at"
        " least 2; correct recording.time (unit, format)"
    )


def _check_filled(columns: dict[str, np.ndarray], machine: Machine, where: str, need_error: bool, bad: int) -> None:
    """Something was recorded, and at least one error channel has a value."""
    note = f"; {bad} cells are no numbers" if bad else ""
    from_file = [n for n, c in machine.channels.items() if c.source == "file"]
    if not any(np.isfinite(columns[n]).any() for n in from_file):
        raise InputError(f"{where}: no channel has a value, all are empty or NaN{note}; record again")
    errors = machine.names("error")
    if need_error and errors and not any(np.isfinite(columns[n]).any() for n in errors):
        raise InputError(
            f"{where}: no error channel has a value, {', '.join(errors)} are all empty or NaN{note};"
            " expected the displacement; record again"
        )


def _start(path: Path, machine: Machine, batch_start: float, file_start: float) -> pd.Timestamp | None:
    pattern = machine.recording.start_from_name
    stamped = machine.recording.time.unit == "timestamp" and batch_start > _FIRST_STAMP_S
    if pattern:
        try:
            named = pd.Timestamp(dt.datetime.strptime(path.stem, pattern))
            return named + pd.Timedelta(seconds=batch_start - file_start) if machine.recording.split else named
        except ValueError:
            pass  # counted as start_unreadable; a time column may still give the start
    return pd.Timestamp(0) + pd.Timedelta(seconds=round(batch_start, 6)) if stamped else None
