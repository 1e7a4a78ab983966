"""Further files or sheets that hold channels of the same runs (`recording.joined`): which one belongs, and its rows."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from data.errors import InputError
from data.machine import Form, Joined, Machine
from data.readers import sheets_of
from data.readers.base import Sheet
from data.readers.header import Layout, NotThisTable, hints, locate
from data.rows import Rows, gather, join, stream


@dataclass(frozen=True)
class Place:
    """The recording that other files belong to: its file, its sheet ("" where it has one only), its batch."""

    path: Path
    sheet: str
    batch_id: str


@dataclass(frozen=True)
class JoinedRows:
    """Rows of one joined file for one recording; `machine` describes that file alone, `sweeps` as in `Layout`."""

    rows: Rows
    machine: Machine
    where: str
    sweeps: Mapping[str, tuple[tuple[str, float], ...]]


def joined_machine(machine: Machine, key: str) -> Machine:
    """The machine file as it describes the joined files of that key: their clock, header and channels."""
    part = machine.recording.joined[key]
    form = {k: getattr(part, k) for k in Form.model_fields}
    form["timezone"] = part.timezone or machine.recording.timezone
    if machine.recording.time.step is not None and "time" not in part.model_fields_set:
        form["time"] = machine.recording.time
    recording = machine.recording.model_copy(update={**form, "joined": {}, "split": None, "schedule": None})
    channels = {
        n: c.model_copy(update={"source": "file"})
        for n, c in machine.channels.items()
        if c.source == key or c.role == "position"
    }
    positions = {c.position for c in channels.values() if c.position}
    channels = {n: c for n, c in channels.items() if machine.channels[n].source == key or n in positions}
    return machine.model_copy(update={"recording": recording, "channels": channels})


def run_name(path: Path, machine: Machine) -> str:
    """What distinguishes a recording's name: what the only * of its pattern stands for, else its stem."""
    for pattern in machine.recording.files:
        tail = pattern.rpartition("/")[2]
        if tail.count("*") == 1 and not set(tail) & set("?["):
            before, _, after = tail.partition("*")
            found = re.fullmatch(f"{re.escape(before)}(.+){re.escape(after)}", path.name, re.IGNORECASE)
            if found:
                return found[1].removesuffix(path.suffix)
    return path.stem


def read_joined(machine: Machine, key: str, place: Place, time_s: tuple[float, float]) -> JoinedRows:
    """The rows that belong to a recording whose clock goes from `time_s[0]` to `time_s[1]`.

    Where both have time stamps, only rows at the recording's times, `max_gap_s` more at both ends.

    Raises:
        InputError: no such file or sheet, several that may be meant, no row at the recording's times.
    """
    part = machine.recording.joined[key]
    described = joined_machine(machine, key)
    name = run_name(place.path, machine)
    found: list[tuple[str, str, Rows, Layout]] = []
    for path in _files(part, place, name):
        with sheets_of(path, hints(described), described.recording) as sheets:
            for where, sheet, layout in _tables(sheets, path, described, part.sheet):
                found.append((where, sheet.name, gather(stream(sheet, layout, described, where), sheet), layout))
    if not found:
        expected = f" sheet {part.sheet!r}" if part.sheet else ""
        raise InputError(
            f"{place.path.name}: {part.file or place.path.name}{expected} holds no column of source {key!r}; correct "
            f"recording.joined.{key} or column: of its channels"
        )
    if part.by == "name" and len(found) > 1:
        names = [place.sheet, name, place.path.stem, place.batch_id]
        wanted = next((n for n in names if n and n in {sheet for _, sheet, _, _ in found}), None)
        if wanted is None:
            raise InputError(
                f"{place.path.name}: {len(found)} sheets hold channels of source {key!r} "
                f"({', '.join(repr(s) for _, s, _, _ in found[:4])}), expected one called {place.sheet or name!r}; "
                f"rename it, or give recording.joined.{key}.sheet or by: time"
            )
        found = [f for f in found if f[1] == wanted]
    where, _, rows, layout = found[0]
    if len(found) > 1:
        where, rows = f"{part.file or place.path.name}", join([r for _, _, r, _ in found])
    if part.time.unit == machine.recording.time.unit == "timestamp":
        more_s = machine.recording.max_gap_s
        inside = np.flatnonzero((rows.time_s >= time_s[0] - more_s) & (rows.time_s <= time_s[1] + more_s))
        if not len(inside):
            raise InputError(
                f"{place.path.name}: {where} has no row at the recording's times; correct recording.joined.{key}, or "
                "add the missing recording"
            )
        rows = rows.part(int(inside[0]), int(inside[-1]) + 1)
    return JoinedRows(rows, described, where, layout.sweeps)


def _files(part: Joined, place: Place, name: str) -> Sequence[Path]:
    folder = place.path.parent
    if part.file is None:
        return [place.path]
    if part.by == "time":
        files = sorted(p for p in folder.glob(part.file) if p.is_file() and not p.name.startswith((".", "~$")))
        tried = part.file
    else:
        candidates = [folder / part.file.replace("*", n) for n in dict.fromkeys((name, place.path.stem))]
        files = [p for p in candidates if p.is_file()][:1]
        tried = part.file.replace("*", name)
    if not files:
        raise InputError(
            f"{place.path.name}: {tried!r} is missing, which holds further channels of this recording; put it there, "
            "or correct recording.joined"
        )
    return files


def _tables(
    sheets: Sequence[Sheet], path: Path, machine: Machine, pattern: str | None
) -> Iterator[tuple[str, Sheet, Layout]]:
    """The sheets that hold channels of the joined file."""
    for sheet in sheets:
        where = f"{path.name} sheet {sheet.name!r}" if len(sheets) > 1 else path.name
        if pattern is None or fnmatch.fnmatchcase(sheet.name.lower(), pattern.lower()):
            try:
                layout = locate(sheet, machine, where, need_error=False)
            except NotThisTable:
                continue  # other content, as in the recording itself
            yield where, sheet, layout
