"""Undescribed files: groups of tables with the same columns, their values and clock, and what belongs together."""

from __future__ import annotations

import datetime as dt
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from data import guess
from data.arrays import Array
from data.checks.invalid import sentinels
from data.errors import InputError
from data.guess import Guess, PositionGroup
from data.machine import MAX_NAME, TAKEN, ChannelPart, Form, Machine
from data.peek import Table, look
from data.readers import sheets_of
from data.readers.csv import normalise
from data.readers.header import Layout
from data.rows import Rows, join, stream
from data.timegrid import repair_time
from data.units import TIME_UNITS_S, plain, quantity, stated_unit
from data.yaml_edit import flow

FILL_IN = "? s"  # in place of the step of a recording without a clock
_MAX_TABLES = 20
_MAX_ROWS = 200_000
_NAME_DATES = ("%Y%m%d", "%Y-%m-%d", "%Y_%m_%d", "%Y%m%d_%H%M%S", "%Y-%m-%d_%H%M%S", "%Y%m%d-%H%M%S", "%Y%m%d%H%M%S")
_common = os.path.commonprefix  # of names, character by character
_ANY = ChannelPart(role="temperature", unit="1")  # no range and no physical limits are known yet


@dataclass(frozen=True)
class Clock:
    """The clock of a group: its line in the machine file and why, its unit in s, and what the user must check."""

    line: str
    why: str
    unit_s: float
    note: str = ""


@dataclass(frozen=True)
class Joint:
    """How files of another group belong to the recordings: keys of `recording.joined`, why, `recording.files`."""

    keys: Mapping[str, str]
    why: str
    files: str | None = None


@dataclass
class Group:
    """Tables with the same columns: files, or sheets of workbooks. `notes`: what the user must check.

    `key` is the name in the machine file; `joint` states how the group belongs to the recordings.
    """

    tables: list[tuple[Path, Table]]
    key: str = "file"
    joint: Joint | None = None
    notes: list[str] = field(default_factory=list)
    row_step_s: float | None = None  # of rows without a clock that are those of the recordings

    @property
    def table(self) -> Table:
        """The first table, whose columns are those of all."""
        return self.tables[0][1]

    @property
    def paths(self) -> list[Path]:
        return list(dict.fromkeys(path for path, _ in self.tables))

    @property
    def sheets(self) -> list[str]:
        return list(dict.fromkeys(table.sheet for _, table in self.tables))

    @cached_property
    def names(self) -> dict[str, int]:
        """Channel name -> place of its column, for every column that holds a number in any table."""
        names: dict[str, int] = {}
        for i in sorted({i for _, table in self.tables for i in table.numeric}):
            slug = re.sub(r"[^\w]+", "_", plain(guess.without_unit(self.table.title(i)))).strip("_")
            name = (slug or f"column_{i}")[: MAX_NAME // 2]
            names[name if name not in names and name not in TAKEN else f"{name}_{i}"] = i
        return names

    @cached_property
    def rows(self) -> list[Rows]:
        """Up to 200 000 rows of up to 20 tables, codes for no value removed; time in the file's unit."""
        every = -(-len(self.tables) // _MAX_TABLES)
        found = [self._read(path, table) for path, table in self.tables[::every]]
        for name, i in self.names.items():
            codes: Counter[float] = Counter()
            for rows in found:
                seen = sentinels(rows.columns[name], _ANY, "draft")
                rows.columns[name] = np.where(np.isin(rows.columns[name], list(seen)), np.nan, rows.columns[name])
                codes.update(seen)
            if codes:
                said = ", ".join(f"{v:.6g} ({n}×)" for v, n in codes.items())
                self.notes.append(f"column {self.table.columns[i]!r}: {said} is taken for a missing value")
        return found

    def _read(self, path: Path, table: Table) -> Rows:
        time: dict[str, object] = {}
        if table.stamps:
            time = {"unit": "timestamp", "format": pattern(table), "date": table.clock.date}
        if table.time is None:
            time = {"step": "1 s"}
        channels = {n: {"role": "driver", "unit": table.units[i] or "1"} for n, i in self.names.items()}
        recording = table.form.model_dump(exclude={"time"}) | {"time": time}
        machine = Machine.model_validate({"machine": "draft", "channels": channels, "recording": recording})
        with sheets_of(path, (), table.form) as sheets:
            sheet = next(s for s in sheets if s.name == table.sheet)
            layout = Layout(table.first_row, table.time, self.names, date=table.clock.date)
            return join(list(_limited(stream(sheet, layout, machine, path.name))))

    def column(self, name: str) -> Array:
        """A channel's values in all rows that were read."""
        return np.concatenate([r.columns[name] for r in self.rows])

    @property
    def longest(self) -> Rows:
        return max(self.rows, key=len)

    @cached_property
    def position_groups(self) -> list[PositionGroup]:
        """Columns that are one error at several positions; what is in degrees is none."""
        table = self.table
        places = [i for i in self.names.values() if quantity(table.units[i] or "um") in (None, "length")]
        return guess.position_groups(table.columns, places) if table.header else []

    def unit(self, i: int) -> Guess | None:
        """The unit of a column as its units row, its cells or its header gives it, known or not."""
        if stated := stated_unit(self.table.units[i]):
            return Guess(stated, "given in the units row or the cells")
        header = self.table.title(i)
        named = guess.channel_unit_in_name(header) or guess.unknown_unit_in_name(header)
        return Guess(named, "named so in the header") if named else None

    @cached_property
    def roles(self) -> dict[str, Guess]:
        """Role of each channel, from its name and its longest recording.

        Where none is an error, the one that can be by its unit is; `notes` say so, or how to name one.
        """
        headers = {n: self.table.title(i) for n, i in self.names.items()}
        units = {n: unit.value if (unit := self.unit(i)) else None for n, i in self.names.items()}
        roles = {n: guess.role(headers[n], units[n], self.longest.columns[n]) for n in self.names}
        open_ = [n for n, r in roles.items() if r.value != "error" and guess.may_be_error(headers[n], units[n])]
        open_ = open_ or [n for n, r in roles.items() if r.value == "position" and units[n] is None]
        if any(r.value == "error" for r in roles.values()):
            asked = [f"{n} ({units[n]})" for n in open_ if roles[n].value == "driver"]
            if asked:
                self.notes.append(f"{', '.join(asked)}: taken for drivers; set role: error if one is measured")
        elif len(open_) == 1:
            (name,) = open_
            self.notes.append(f"{name} ({units[name] or 'no unit'}) is taken for the measured error; else set its role")
            by = f"unit {units[name]}" if units[name] else "name"
            roles[name] = Guess("error", f"the only channel that can be it, by its {by}")
        else:
            shown = open_ or [n for n, r in roles.items() if r.value == "driver"] or [*roles]
            self.notes.append(
                f"no channel is the measured error; set role: error and its unit where it is, such as"
                f" {', '.join(shown[:4])}, or join the file that holds it (recording.joined)"
            )
        return roles

    def named(self, role: str) -> list[str]:
        return [n for n, r in self.roles.items() if r.value == role]

    @cached_property
    def clock(self) -> Clock:
        table = self.table
        if table.time is None and (step_s := self.row_step_s or table.step_s):
            why = "as in the recording, which has as many rows" if self.row_step_s else "the file's header gives it"
            return Clock(f"{{step: {f'{step_s:g} s'!r}}}", why, 1.0)
        if table.time is None:
            unread = [f"{table.columns[i]!r} ({why})" for i, why in table.left.items() if why.startswith("a time")]
            note = (
                f"column {', '.join(unread)}: set recording.time to {{column, unit: timestamp, format: its strptime "
                "pattern}, or write" if unread else "no column is a clock: write"
            )  # fmt: skip
            return Clock(
                f"{{step: {FILL_IN!r}}}", "fill in: no column is a clock; the time between two rows, such as 60 s", 1.0,
                f"{note} the time between two rows as recording.time.step, such as 60 s",
            )  # fmt: skip
        column = flow(table.key(table.time))
        if table.clock.elapsed:
            return Clock(f"{{column: {column}, clock: elapsed}}", "durations from 0, or beyond a day", 1.0)
        if table.stamps:
            form = f", format: {flow(pattern(table))}" if pattern(table) else ""
            at = table.clock.date
            form = form if at is None else f", date: {flow(table.key(at))}{form}"
            others = f" (or {', '.join(table.stamps[1:])})" if len(table.stamps) > 1 else ""
            note = f"time stamps can be {' or '.join(table.stamps)}: day and month" if others else self._summer_time()
            return Clock(f"{{column: {column}, unit: timestamp{form}}}", f"its cells look like it{others}", 1.0, note)
        unit, unit_s, note = self._time_unit(table.title(table.time))
        return Clock(f"{{column: {column}, unit: {unit.value}}}", unit.why, unit_s, note)

    def _summer_time(self) -> str:
        """What to check where stamps without a zone jump back by an hour, or forward in a night of March or April."""
        if self.table.form.timezone:
            return ""
        for rows in self.rows:
            step_s = np.diff(rows.time_s)
            usual = float(np.nanmedian(step_s)) if len(step_s) else 0.0
            for at in np.flatnonzero(np.abs(np.abs(step_s - usual) - 3600.0) < 0.5 * usual):
                when, back = dt.datetime.fromtimestamp(rows.time_s[at] + usual, dt.UTC), step_s[at] < 0
                if back or (when.month in (3, 4) and when.weekday() == 6 and when.hour < 4):
                    way, end = ("back by an hour", "end") if back else ("by an hour", "start")
                    return (
                        f"the clock jumps {way} at {when:%Y-%m-%d %H:%M}, as at the {end} of summer time; if so, "
                        "set recording.timezone, such as Europe/Berlin"
                    )
        return ""

    def _time_unit(self, header: str) -> tuple[Guess, float, str]:
        """Unit of a numeric clock, in s, and what to check."""
        step, length = self.step_and_length
        written = stated_unit(self.table.units[self.table.time or 0]) or guess.time_unit_in_name(header)
        written = written if written in TIME_UNITS_S else None
        warm = self.named("temperature")
        rates = [guess.sustained_rate(r.time_s, r.columns[n]) for r in self.rows for n in warm]
        unit, note = guess.time_unit(written, step, length, max(rates, default=0.0))
        return unit, TIME_UNITS_S[unit.value], note

    @cached_property
    def step_and_length(self) -> tuple[float, float]:
        """Median step and longest recording, in the file's unit of time; the step of the densest channel."""
        intervals, lengths = [], []
        for rows in self.rows:
            time = repair_time(rows.time_s, np.inf).time_s
            lengths.append(float(time[-1]) if len(time) else 0.0)
            dense = any(np.isfinite(v).mean() > 0.5 for v in rows.columns.values())
            sparse = [np.sort(rows.time_s[np.isfinite(v)]) for v in rows.columns.values()] if not dense else [time]
            steps = [step[step > 0] for t in sparse if len(step := np.diff(t[np.isfinite(t)]))]
            intervals += [float(np.median(step)) for step in steps if len(step)]
        return min(intervals, default=1.0), max(lengths)

    @property
    def start_from_name(self) -> str | None:
        """The strptime pattern of all files' names, or of the sheets' names in workbooks of several recordings."""
        several = len(self.tables) > len(self.paths)
        stems = [table.sheet for _, table in self.tables] if several else [p.stem for p in self.paths]
        split = [re.fullmatch(r"(\D*)(\d[\d_-]*\d)(\D*)", stem) for stem in stems]
        around = {(m[1], m[3]) for m in split if m}
        if len(around) != 1 or None in split:
            return None
        before, after = (text.replace("%", "%%") for text in around.pop())
        for form in _NAME_DATES:
            try:
                years = {dt.datetime.strptime(m[2], form).year for m in split if m}
            except ValueError:
                continue
            if all(1980 <= y <= 2100 for y in years):
                return f"{before}{form}{after}"
        return None


def pattern(table: Table) -> str | None:
    """The strptime pattern that the machine file must give."""
    return table.stamps[0] if table.stamps and table.stamps[0] not in ("", "ISO8601") else None


def _limited(blocks: Iterator[Rows]) -> Iterator[Rows]:
    left = _MAX_ROWS
    for rows in blocks:
        yield rows if len(rows) <= left else rows.part(0, left)
        left -= len(rows)
        if left <= 0:
            return


def grouped(files: Sequence[Path], form: Form | None = None) -> tuple[list[Group], list[str]]:
    """Groups of the files' tables, the recordings first, and a line for each file without a table.

    The recordings are the group of most tables, or else of most temperatures.

    Raises:
        InputError: no file holds a table of numbers.
    """
    groups: dict[tuple[object, ...], Group] = {}
    left_out: list[str] = []
    for path in files:
        try:
            for table in look(path, form):
                groups.setdefault((table.columns, table.header), Group([])).tables.append((path, table))
        except InputError as error:
            left_out.append(f"{path.name}: {str(error).removeprefix(f'{path}: ').removeprefix(f'{path.name}: ')}")
    if not groups:
        raise InputError(left_out[0])
    if len(groups) == 1:
        return [*groups.values()], left_out
    return sorted(groups.values(), key=lambda g: (-len(g.tables), -len(g.named("temperature")))), left_out


def joint(main: Group, other: Group) -> Joint | None:
    """How tables with other columns belong to the recordings; None where they do not or it cannot be seen."""
    mine, theirs = ({normalise(g.table.columns[i]) for i in g.names.values()} for g in (main, other))
    if main.table.header and other.table.header and mine & theirs:
        return None
    if main.paths == other.paths:
        same = len(other.sheets) == 1 and other.sheets[0] not in main.sheets
        return Joint({"sheet": other.sheets[0]}, "the sheet has other columns of the same run") if same else None
    folder = Path(os.path.relpath(other.paths[0].resolve().parent, main.paths[0].resolve().parent))
    single = {"file": (folder / other.paths[0].name).as_posix()}
    here, there = _runs(main.paths, other.paths), _runs(other.paths, main.paths)
    if here and there and here[1] == there[1] and (other.table.time is not None or main.table.time is None):
        files = {"file": (folder / there[0]).as_posix()}
        return Joint(files, "the names of the files differ by the same text", here[0])
    if other.table.time is None:
        steps = np.diff(main.longest.time_s)
        if len(main.paths) > 1 or len(other.paths) > 1 or len(main.longest) != len(other.longest) or np.ptp(steps) > 0:
            return None
        other.row_step_s = float(steps[0]) * main.clock.unit_s
        return Joint(single, "given together with the recording, with as many rows", main.paths[0].name)
    if len(other.paths) == 1:
        if len(main.paths) == 1 and (main.sheets == other.sheets or len(main.sheets) == len(other.sheets) == 1):
            return Joint(single, "given together with the recording", main.paths[0].name)
        if {*other.sheets} & {*main.sheets, *(p.stem for p in main.paths)} - {""}:
            return Joint(single, "its sheets are called as those of the recordings, or as their files")
    if main.table.stamps and other.table.stamps and _overlap(main, other):
        found = single["file"] if len(other.paths) == 1 else (folder / files_pattern(other.paths)).as_posix()
        return Joint({"file": found, "by": "time"}, "its time stamps are those of the recordings")
    return None


def _runs(paths: Sequence[Path], others: Sequence[Path]) -> tuple[str, list[str]] | None:
    """A pattern with one * of the files' names, and what the * stands for; None where a name gives no such part."""
    stems = [p.stem for p in paths]
    if len(stems) == 1:
        digits = [m for m in re.findall(r"\d[\d\-_]{4,}\d", stems[0]) if m in others[0].stem]
        if len(others) > 1 or not digits:
            return None
        before, _, after = stems[0].partition(digits[0])
        runs = [digits[0]]
    else:
        before = _common(stems).rstrip("0123456789")
        after = _common([s[len(before) :][::-1] for s in stems])[::-1].lstrip("0123456789")
        runs = sorted(s[len(before) : len(s) - len(after)] for s in stems)
    return f"{before}*{after}{paths[0].suffix}", runs


def _overlap(main: Group, other: Group) -> bool:
    """Whether every recording that was read has rows of the other files at its times."""
    theirs = np.sort(np.concatenate([r.time_s[np.isfinite(r.time_s)] for r in other.rows]))
    spans = [(np.nanmin(r.time_s), np.nanmax(r.time_s)) for r in main.rows if np.isfinite(r.time_s).any()]
    return all(np.searchsorted(theirs, a) < np.searchsorted(theirs, b, "right") for a, b in spans)


def files_pattern(paths: Sequence[Path]) -> str:
    """A pattern of the files' names: digits first, or what they begin with."""
    suffix = paths[0].suffix
    stems = [p.stem for p in paths]
    if all(s[:1].isdigit() for s in stems):
        return f"[0-9]*{suffix}"
    prefix = _common(stems).rstrip("0123456789") if len(stems) > 1 else ""
    return f"{prefix if len(prefix) > 2 else ''}*{suffix}".replace("[", "?")
