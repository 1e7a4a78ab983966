"""Reading of a recording file into batches: time repaired, values on the regular grid, in canonical units.

`Batch.repairs` counts, for every batch; the keys of rows always add up: ``rows_in = rows_used + rows_dropped``.

| key | what |
|---|---|
| `rows_in` | data rows of the source that belong to this batch (no blank lines, no header, units or title lines) |
| `rows_used` | source rows that went into at least one value of the grid (a mean, an interpolation, a held driver) |
| `rows_dropped` | source rows that contributed nothing: the sum of the six reasons below |
| `ragged_rows` | dropped: too many or too few cells, e.g. a last line that was cut, or above the header |
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
| `joined_rows` | rows of other files or sheets (`recording.joined`) that were read as well, in no count above |
| `skipped_sources` | other files that could not be read and hold no channel that is needed |
| `readings_without_position` | errors along an axis whose row has no position: nowhere in the grid |
| `start_unreadable` | 1 if neither the file's name nor its sheet's fits start_from_name |
"""

from __future__ import annotations

import datetime as dt
import fnmatch
import os
import unicodedata
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Batch, Finding
from data.checks.invalid import take_invalid
from data.errors import InputError
from data.joined import Place, read_joined
from data.lakefile import native_parquet
from data.machine import Machine, Schedule
from data.readers import has_reader, sheets_of
from data.readers.base import Sheet
from data.readers.cells import parse_number
from data.readers.csv import read_text_table
from data.readers.header import Layout, NotThisTable, hints, locate
from data.rows import Rows, cut_runs, gather, stream
from data.sweeps import Columns, take_readings
from data.timegrid import check_step, repair_time, to_grid
from data.units import check_canonical, conversion, convert

DROPPED = {
    "ragged_rows": "with another number of cells", "unparsable_time": "without a readable time",
    "time_outliers": "with a time far off", "rows_before_run": "before the first run",
    "rows_empty": "without a value", "rows_between": "between two grid points",
}  # fmt: skip
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


def recording_files(directory: Path, machine: Machine) -> tuple[list[Path], list[tuple[Path, str]]]:
    """(recordings, ignored files and folders with the reason) of a directory and its subfolders, both sorted.

    A pattern of `recording.files` without a slash is that of a file's name, one with a slash that of its path in the
    directory; ``./*.csv`` takes no file of a subfolder. Case does not matter. Files that are read with the recordings
    (the schedule, `recording.joined`) are neither. Hidden folders and lakes are not entered, links to folders and to
    files outside are not followed; the lake's folder of this machine, given as the directory, gives its files whatever
    the patterns.

    Raises:
        InputError: no such directory.
    """
    if not directory.is_dir():
        raise InputError(f"{directory}: no such directory; give the folder of the recordings")
    part = machine.recording
    side = [*([part.schedule.file] if part.schedule else []), *(j.file for j in part.joined.values() if j.file)]
    recordings: list[Path] = []
    ignored: list[tuple[Path, str]] = []
    unreadable: list[OSError] = []
    inside = directory.resolve()
    for folder, subfolders, names in os.walk(directory, onerror=unreadable.append):
        for name in list(subfolders):
            if reason := _folder_ignored(Path(folder, name)):
                subfolders.remove(name)
                ignored.append((Path(folder, name), reason))
        for path in (Path(folder, name) for name in names):
            relative = path.relative_to(directory).as_posix()
            reason = _file_ignored(path, inside)
            if not reason and any(_fits(relative, p) or _fits(path.name, p) for p in side):
                continue
            own = path.suffix == ".parquet" and f"machine={machine.machine}" in path.parts
            if not reason and not own and not any(_fits(relative, p) for p in part.files):
                reason = f"not in recording.files ({', '.join(part.files)})"
            if not reason and not has_reader(path):
                reason = f"no reader for {path.suffix or 'a file without suffix'}"
            if reason:
                ignored.append((path, reason))
            else:
                recordings.append(path)
    ignored += [(Path(e.filename), f"cannot be read ({e.strerror})") for e in unreadable]
    return sorted(recordings), sorted(ignored)


def _fits(relative: str, pattern: str) -> bool:
    """Whether a file's path in the directory has the pattern (see `recording_files`)."""
    relative, pattern = relative.lower(), pattern.lower().replace("**/", "*")
    if pattern.startswith("./"):
        return "/" not in relative and fnmatch.fnmatchcase(relative, pattern[2:])
    return fnmatch.fnmatchcase(relative if "/" in pattern else relative.rpartition("/")[2], pattern)


def _folder_ignored(folder: Path) -> str:
    """Why a folder is not entered; empty where it is."""
    if folder.name.startswith("."):
        return "hidden"
    if folder.is_symlink():
        return "link to a folder"
    return "a lake" if (folder / "_manifest.json").is_file() else ""


def steers(name: str) -> bool:
    """Whether a name holds what steers a terminal or forges a line of a log: it would name a batch everywhere."""
    return any(unicodedata.category(c) == "Cc" for c in name)


def _file_ignored(path: Path, inside: Path) -> str:
    """Why a file is no recording whatever the patterns; empty where it may be one."""
    if path.name.startswith(("~$", ".~")):
        return "lock file of an open document"
    if path.name.startswith("."):
        return "hidden"
    if steers(path.name):
        return "control characters in the name; rename it"
    if path.is_symlink() and not path.resolve().is_relative_to(inside):
        return "link to a file outside of the folder; name that file itself to read it"
    return "" if path.is_file() else "not a file"


def read_batches(
    path: Path, machine: Machine, need_error: bool = True, channels: Collection[str] | None = None
) -> Iterator[Batch]:
    """The batches of one file, one at a time, with findings of cells that hold no value and none of other checks.

    Several where a workbook has several sheets of recordings (`stem-sheet`) or where `recording.split` cuts a long
    one (`stem-01`, `stem-02`, …). A bad sheet or stretch does not hold back the good ones: its error comes last.
    With `need_error=False` a file without error channels is good as well (to predict from it). `channels` are those
    that are needed, None: all. A schedule or joined file that gives none of them may be missing or lack the run: its
    channels are then empty. The recording itself is read as a whole. A Parquet file that
    thermodrift wrote is read by its own note, not by the machine file's columns (`data.lakefile`).

    Raises:
        InputError: the file, a sheet or a stretch cannot be used; one line.
    """
    check_canonical({n: (c.role, c.unit) for n, c in machine.channels.items()}, f"machine file {machine.machine}")
    needed = set(machine.channels if channels is None else channels)
    if not need_error:
        needed -= set(machine.names("error"))
    own = native_parquet(path)
    if own is None:
        yield from _file_batches(path, machine, need_error, needed)
        return
    for batch in _file_batches(path, own.layout(machine), need_error, needed):
        yield own.marked(batch)


def _file_batches(path: Path, machine: Machine, need_error: bool, needed: Collection[str]) -> Iterator[Batch]:
    with sheets_of(path, hints(machine), machine.recording) as sheets:
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
                name = sheet.name if len(tables) + len(errors) > 1 else ""
                place = Place(path, name, batch_id)
                source = _Source(machine, place, where, need_error, needed, layout.sweeps, layout.origin_s)
                batches = _sheet_batches(sheet, layout, source, extra, errors)
                yield from _last_truncated(batches) if sheet.cut else batches
            except InputError as error:
                errors.append(error)
            extra = {}
    if errors:
        more = f" (and {len(errors) - 1} more parts of the file cannot be used)" if len(errors) > 1 else ""
        raise InputError(f"{errors[0]}{more}")


def _last_truncated(batches: Iterator[Batch]) -> Iterator[Batch]:
    """The batches, of which the last one says that its file ends within a row."""
    last = next(batches, None)
    for batch in batches:
        assert last is not None
        yield last
        last = batch
    if last is not None:
        yield replace(last, repairs={**last.repairs, "truncated": 1})


@dataclass(frozen=True)
class _Source:
    """Origin of a batch: `where` names it in messages; `sweeps` are the columns of errors along axes."""

    machine: Machine
    place: Place
    where: str
    need_error: bool
    needed: Collection[str]
    sweeps: Columns
    origin_s: float = 0.0  # what the wall clock shows more than the clock of the rows

    def needs(self, source: str) -> bool:
        """Whether a needed channel comes from there."""
        channels = self.machine.channels
        return any(channels[n].source == source for n in self.needed if n in channels)


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
    still = 0.0
    if split.driver is not None:
        if split.driver not in machine.channels:
            raise InputError(f"machine file {machine.machine}: recording.split.driver {split.driver!r} is no channel")
        part = machine.channels[split.driver]
        factor, offset = conversion(part.unit, part.unit_in_file or part.unit, split.driver)
        still = 0.5 * (part.resolution or 0.0) * abs(factor)
        still = still if split.above is None else factor * split.above + offset
    first: list[float] = []

    def noting_the_start() -> Iterator[Rows]:
        for rows in blocks:
            if not first:
                first.extend(rows.time_s[np.isfinite(rows.time_s)][:1].tolist())
            yield rows

    for k, rows in enumerate(cut_runs(noting_the_start(), split, still, where)):
        place = replace(source.place, batch_id=f"{source.place.batch_id}-{k + 1:02d}")
        of_run = replace(source, place=place, where=f"{where} part {k + 1:02d}")
        try:
            yield _batch(rows, of_run, extra, first[0])
        except InputError as error:
            errors.append(error)
        extra = {}


@dataclass(frozen=True)
class _Samples:
    """Rows of one file or sheet in order of time, with codes and text as missing values; not yet on the grid."""

    machine: Machine  # describes this file
    where: str
    sweeps: Columns
    time_s: Array  # (n,) from the first row
    start: float  # time of the first row as the file gives it
    values: dict[str, Array]
    invalid: dict[str, NDArray[np.bool_]]
    filled: NDArray[np.bool_]  # (n,) rows with a value
    findings: tuple[Finding, ...]
    unreadable: int
    counts: dict[str, int]

    @classmethod
    def of(cls, rows: Rows, machine: Machine, where: str, sweeps: Columns, batch_id: str) -> _Samples:
        """Raises InputError where fewer than two rows have a time. The rows are emptied."""
        repaired = repair_time(rows.time_s, machine.recording.max_gap_s)
        if len(repaired.order) < 2:
            raise _too_few(rows, len(repaired.order), machine, where)
        if machine.recording.split is None:
            recording = machine.recording
            check_step(repaired.time_s, recording.step_s, recording.time.unit, where, bool(sweeps or machine.axes()))
        untouched = len(repaired.order) == len(rows) and bool((np.diff(repaired.order) == 1).all())
        keep = slice(None) if untouched else repaired.order
        unreadable = sum(len(at) for at, _ in rows.texts.values())
        invalid, findings = take_invalid(rows, machine, batch_id, where)
        values = {n: v[keep] for n, v in rows.columns.items()}
        filled = np.zeros(len(repaired.order), bool)
        for v in values.values():
            if not filled.all():
                filled |= ~np.isnan(v)
        counts = {
            "rows_in": len(rows) + rows.ragged + rows.before_run,
            "ragged_rows": rows.ragged,
            "rows_before_run": rows.before_run,
            **{"time_outliers": 0, "clock_restarts": 0, **repaired.counts},
            "rows_empty": int((~filled).sum()),
        }
        rows.columns.clear()
        return cls(
            machine, where, sweeps, repaired.time_s, repaired.start, values, {n: v[keep] for n, v in invalid.items()},
            filled, findings, unreadable, counts,
        )  # fmt: skip

    def on_grid(self, origin_s: float = 0.0) -> tuple[dict[str, Array], dict[str, int]]:
        """Columns (m,) on the grid t = 0, step_s, …, in the file's units, and the counts of rows.

        The grid begins `origin_s` after this file's first row.
        """
        recording = self.machine.recording
        time_s = self.time_s - origin_s
        readings, read_counts = take_readings(self.values, time_s, self.machine, self.sweeps, self.where)
        grid = to_grid(
            time_s, self.values, set(self.machine.names("driver")), recording.step_s, recording.max_gap_s, self.where,
            recording.time.unit, self.invalid,
        )  # fmt: skip
        is_reading = np.zeros(len(self.filled), bool)
        for r in readings:
            r = r.since(-0.5 * recording.step_s)
            grid.columns.update(r.on_grid(recording.step_s, len(grid.time_s), recording.max_gap_s, self.where))
            is_reading[r.row] = True
        counts = dict(self.counts)
        if readings:  # rows of a sweep under one time stamp repeat no time
            repeats = np.diff(self.time_s, prepend=-1.0) == 0
            counts["duplicates"] -= int((repeats & is_reading).sum())
        used = (grid.used | is_reading) & self.filled
        counts |= {
            "rows_used": int(used.sum()),
            "rows_out": len(grid.time_s),
            "rows_between": int((self.filled & ~used).sum()),
            "channel_gaps": grid.channel_gaps,
            "unparsable_values": self.unreadable,
            **read_counts,
        }
        return {"time_s": grid.time_s, **grid.columns}, counts | {"rows_dropped": sum(counts[r] for r in DROPPED)}


def _batch(rows: Rows, source: _Source, extra: dict[str, int], file_start: float) -> Batch:
    """`file_start` is the file's first time in s, needed where its name gives the start and the file is cut."""
    machine, place, where = source.machine, source.place, source.where
    main = _Samples.of(rows, machine, where, source.sweeps, place.batch_id)
    others, skipped = _others(main, source)
    origin_s = max([0.0, *(later_s for _, later_s in others)])
    found, repairs = main.on_grid(origin_s)
    n_rows = len(found["time_s"])
    for samples, later_s in others:
        columns, counts = samples.on_grid(origin_s - later_s)
        missing = np.full(max(0, n_rows - len(columns.pop("time_s"))), np.nan)
        found |= {n: np.concatenate([v[:n_rows], missing]) for n, v in columns.items()}
        repairs["joined_rows"] = repairs.get("joined_rows", 0) + counts["rows_in"]
        repairs["unparsable_values"] += counts["unparsable_values"]
    repairs |= extra
    labels: dict[str, object] = {}
    schedule = machine.recording.schedule
    if schedule:
        try:
            drivers, labels = scheduled(schedule, place.path.parent, (place.batch_id, place.path.stem), found["time_s"])
            found |= drivers
        except InputError:
            if source.needs("schedule"):
                raise
            skipped += 1
    repairs |= {"skipped_sources": skipped} if skipped else {}
    columns = _in_canonical_units(found, machine, skipped > 0)
    _check_filled(columns, machine, where, source.need_error, repairs["unparsable_values"])
    start = _start(source, main.start + origin_s, file_start)
    if start is None and machine.recording.start_from_name:
        repairs["start_unreadable"] = 1
    return Batch(
        machine=machine.machine, batch_id=place.batch_id, table=pd.DataFrame(columns, copy=False),
        channels=machine.batch_channels(), start=start, simulated=machine.simulated, source=place.path.name,
        repairs=repairs, findings=sum((s.findings for s, _ in others), main.findings), labels=labels,
    )  # fmt: skip


def _others(main: _Samples, source: _Source) -> tuple[list[tuple[_Samples, float]], int]:
    """Samples of joined files, each with its start in s after that of the recording; how many were passed over.

    Where one clock is of stamps and the other is not, both files begin together.
    """
    stamped = main.machine.recording.time.unit == "timestamp"
    found, skipped = [], 0
    for key, part in main.machine.recording.joined.items():
        try:
            of_time = (main.start, main.start + float(main.time_s[-1]))
            joined = read_joined(main.machine, key, source.place, of_time)
            samples = _Samples.of(joined.rows, joined.machine, joined.where, joined.sweeps, source.place.batch_id)
        except InputError:
            if source.needs(key):
                raise
            skipped += 1
            continue
        together = stamped != (part.time.unit == "timestamp")
        found.append((samples, 0.0 if together else samples.start - main.start))
    return found, skipped


def _in_canonical_units(found: Mapping[str, Array], machine: Machine, passed_over: bool) -> dict[str, Array]:
    """A column (m,) for every channel, NaN where there is none."""
    columns = {"time_s": found["time_s"]}
    for name, part in machine.channels.items():
        if name in found:
            here = f"machine file {machine.machine}: channel {name!r}"
            columns[name] = convert(found[name], part.unit_in_file or part.unit, part.unit, here)
        elif part.source == "schedule" and not passed_over:
            raise InputError(
                f"machine file {machine.machine}: channel {name!r} has source: schedule, but no stage of"
                " recording.schedule gives it; add it there"
            )
        else:
            columns[name] = np.full(len(found["time_s"]), np.nan)
    return columns


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


def _start(source: _Source, batch_start: float, file_start: float) -> pd.Timestamp | None:
    """When the batch begins, as a clock on the wall shows it."""
    place, recording = source.place, source.machine.recording
    for name in (place.path.stem, place.sheet) if recording.start_from_name else ():
        try:
            named = pd.Timestamp(dt.datetime.strptime(name, recording.start_from_name or ""))
            return named + pd.Timedelta(seconds=batch_start - file_start) if recording.split else named
        except ValueError:
            pass  # counted as start_unreadable; a time column may still give the start
    shown_s = batch_start + source.origin_s
    if (recording.time.unit != "timestamp" and not source.origin_s) or shown_s <= _FIRST_STAMP_S:
        return None
    try:
        if recording.timezone:
            utc = pd.Timestamp(round(batch_start * 1e6), unit="us", tz="UTC")
            return utc.tz_convert(recording.timezone).tz_localize(None)
        return pd.Timestamp(round(shown_s * 1e6), unit="us")
    except (ValueError, OverflowError):  # beyond the year 2262, so a damaged stamp
        return None
