"""Source rows of one table as arrays, before they become a batch; cutting a long recording where the spindle starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Index
from data.errors import InputError
from data.machine import Machine, Split
from data.readers.base import Sheet
from data.readers.cells import cell_texts, stamp_format, to_float, to_seconds, with_date
from data.readers.header import Layout
from data.units import seconds

Texts = dict[str, tuple[Index, NDArray[Any]]]


@dataclass
class Rows:
    """Consecutive source rows: time_s (n,) as the file gives it, columns name -> (n,) in the file's units.

    `texts`: column -> rows whose cells are no number, and their texts. `ragged` rows could not be split into columns
    and `before_run` rows stand before the first run: both are in no array, but belong to this stretch.
    """

    time_s: Array
    columns: dict[str, Array]
    texts: Texts = field(default_factory=dict)
    ragged: int = 0
    before_run: int = 0

    def __len__(self) -> int:
        return len(self.time_s)

    def part(self, begin: int, end: int) -> Rows:
        """Rows begin..end; ragged rows stay with the stretch that holds the first row."""
        cut = slice(begin, end)
        values = {n: v[cut] for n, v in self.columns.items()}
        texts = {}
        for name, (rows, text) in self.texts.items():
            inside = (rows >= begin) & (rows < end)
            if inside.any():
                texts[name] = rows[inside] - begin, text[inside]
        return Rows(self.time_s[cut], values, texts, self.ragged if begin == 0 else 0)


def _joined(parts: Sequence[tuple[int, Texts]]) -> Texts:
    """Texts of consecutive rows as one; each part with the number of rows."""
    out: Texts = {}
    before = 0
    for n, texts in parts:
        for name, (rows, text) in texts.items():
            first = out.get(name, (np.zeros(0, np.int64), np.zeros(0, object)))
            out[name] = np.concatenate([first[0], rows + before]), np.concatenate([first[1], text])
        before += n
    return out


def stream(sheet: Sheet, layout: Layout, machine: Machine, where: str) -> Iterator[Rows]:
    """The sheet's data rows, block by block."""
    time = machine.recording.time
    pattern = time.format
    clock = () if layout.time is None else (layout.time,) if layout.date is None else (layout.date, layout.time)
    if time.unit == "timestamp" and pattern is None:
        head = [row for row in sheet.head[layout.first_row :][:200] if max(clock, default=0) < len(row)]
        texts_of_time = [[row[i] for i in clock if isinstance(row[i], str) and not _is_number(row[i])] for row in head]
        pattern = stamp_format([" ".join(t) for t in texts_of_time if len(t) == len(clock)], where)
    positions = sorted({*clock, *layout.positions.values()})
    text = clock if time.unit == "timestamp" or _colons(sheet, layout) else ()
    units = {n: c.unit_in_file or c.unit for n, c in machine.channels.items()}
    no_date = pattern is not None and not any(d in pattern for d in ("%d", "%j", "8601"))
    late = np.nan
    done, above = 0, layout.above
    for block in sheet.blocks(layout.first_row, positions, text):
        if layout.time is None:  # a row that could not be split is somewhere in its block
            n = len(block.columns[positions[0]])
            time_s: Array = (done + np.arange(n, dtype=np.float64)) * (time.row_step_s or np.nan)
            done += n + block.ragged_rows
        else:
            stamps = block.columns[layout.time]
            stamps = stamps if layout.date is None else with_date(block.columns[layout.date], stamps)
            time_s = to_seconds(stamps, time.unit, pattern, sheet.decimal, machine.recording.timezone)
        if no_date and len(time_s):
            time_s = _past_midnight(time_s, late)
            late = float(_filled(time_s, late)[-1])
        values: dict[str, Array] = {}
        texts: Texts = {}
        for name, position in layout.positions.items():
            values[name], bad = to_float(
                block.columns[position], sheet.decimal, units.get(name.rpartition("@")[0] or name, "")
            )
            if bad is not None:
                texts[name] = np.flatnonzero(bad), cell_texts(block.columns[position], bad)
        yield Rows(time_s, values, texts, block.ragged_rows + above)
        above = 0


def _colons(sheet: Sheet, layout: Layout) -> bool:
    """Whether an elapsed clock shows h:mm:ss."""
    rows = [row for row in sheet.head[layout.first_row :][:20] if len(row) > (layout.time or 0)]
    return layout.time is not None and any(":" in str(row[layout.time]) for row in rows)


def _past_midnight(time_s: Array, before: float) -> Array:
    """A clock without a date goes on after 24 h; `before` is the last time of the block before."""
    day_s = 86400.0
    first_day = 0.0 if np.isnan(before) else before // day_s
    clock = time_s % day_s
    known = _filled(clock, before % day_s)
    steps = np.diff(known, prepend=known[0] if np.isnan(before) else before % day_s)
    return clock + day_s * (first_day + np.cumsum(steps < -day_s / 2))


def _is_number(text: str) -> bool:
    return text.strip().replace(".", "", 1).replace(",", "", 1).isdigit()


def gather(blocks: Iterator[Rows], sheet: Sheet) -> Rows:
    """All blocks of a sheet, written into place as they come: a long recording is held once, not twice."""
    room, n, ragged = 0, 0, 0
    names: tuple[str, ...] = ()
    whole: list[NDArray[Any]] = []
    texts: list[tuple[int, Texts]] = []
    for rows in blocks:
        names = tuple(rows.columns)
        arrays: list[NDArray[Any]] = [rows.time_s, *rows.columns.values()]
        if not whole or n + len(rows) > room:
            room = max(n + len(rows), int(1.02 * (n + len(rows)) / max(sheet.share_read, 1e-4)))
            for i, array in enumerate(arrays):
                grown = np.empty(room, array.dtype)
                if len(whole) > i:
                    grown[:n] = whole[i][:n]
                    whole[i] = grown
                else:
                    whole.append(grown)
        for to, array in zip(whole, arrays, strict=True):
            to[n : n + len(rows)] = array
        n += len(rows)
        ragged += rows.ragged
        texts.append((len(rows), rows.texts))
    if not whole:
        return Rows(np.zeros(0), {}, ragged=ragged)
    time_s, *columns = (array[:n] for array in whole)
    return Rows(time_s, dict(zip(names, columns, strict=True)), _joined(texts), ragged)


def join(parts: Sequence[Rows]) -> Rows:
    """One after the other. The parts are emptied on the way, so that no channel is held twice."""
    if len(parts) == 1:
        return parts[0]
    values = {}
    for name in list(parts[0].columns) if parts else []:
        values[name] = np.concatenate([p.columns.pop(name) for p in parts])
    return Rows(
        np.concatenate([p.time_s for p in parts]) if parts else np.zeros(0),
        values,
        _joined([(len(p), p.texts) for p in parts]),
        sum(p.ragged for p in parts),
        sum(p.before_run for p in parts),
    )


def cut_runs(blocks: Iterator[Rows], split: Split, still: float, where: str) -> Iterator[Rows]:
    """Batches of a long recording: from where a run begins to the next such begin.

    With `split.driver` a run is where its values (in the file's unit) are above `still`, in size where no `above` is
    given. Runs shorter than `min_run_s` start no batch; they belong to the stop in which they lie. A recording that
    begins running begins with a batch; rows before the first run are counted (`before_run` of the first batch) and
    dropped. A batch is given out as soon as the next one has begun: only one is held in memory.

    Raises:
        InputError: the driver is not in the file, or no run lasts for min_run_s.
    """
    pending: list[Rows] = []
    runs = _Runs(split)
    before_run, started, first, last_on, last_time = 0, False, 0, False, np.nan
    for rows in blocks:
        time = _filled(rows.time_s, last_time)
        last_time = float(time[-1]) if len(rows) else last_time
        on = None
        if split.driver is not None:
            if split.driver not in rows.columns:
                raise InputError(
                    f"{where}: recording.split needs the driver {split.driver!r}, which is not in the file; correct its"
                    " column"
                )
            values = rows.columns[split.driver]
            size = np.abs(values) if split.above is None else values
            on = _filled(np.where(np.isnan(values), np.nan, size > still), last_on) > 0
            last_on = bool(on[-1]) if len(rows) else last_on
        pending.append(rows)
        for cut in runs.starts(on, time):
            done, pending = _split(pending, cut - first)
            first = cut
            if started:
                whole = join(done)
                whole.before_run, before_run = before_run, 0
                yield whole
            else:
                before_run = sum(len(p) + p.ragged for p in done)
            started = True
    if not started:
        what = f"{split.driver} never runs" if split.driver else "no stretch lasts"
        raise InputError(
            f"{where}: {what} for {split.min_run_s:g} s (longest run {runs.longest_s:g} s); nothing to cut;"
            " correct recording.split"
        )
    whole = join(pending)
    whole.before_run = before_run
    yield whole


def _filled(values: Array, before: float) -> Array:
    """NaN replaced by the last value before it."""
    there = ~np.isnan(values)
    last = np.maximum.accumulate(np.where(there, np.arange(len(values)), -1)) if len(values) else np.zeros(0, int)
    return np.where(last >= 0, values[np.maximum(last, 0)], before)


class _Runs:
    """Where runs of at least min_run_s begin, block by block; only the run under way is remembered."""

    def __init__(self, split: Split) -> None:
        self.longest_s = 0.0
        self._min_run_s = split.min_run_s
        self._pause_s = seconds(split.pause) if split.pause else np.inf
        self._every_s = seconds(split.every) if split.every else np.inf
        self._rows = 0  # of the blocks before
        self._begun: tuple[int, float] | None = None  # row and time of the run under way
        self._reported = False  # the run under way is already among the results
        self._first_s = self._last_s = np.nan  # time of the first row, and of the last one so far

    def starts(self, on: NDArray[np.bool_] | None, time: Array) -> list[int]:
        """Rows, counted from the first block on, of the runs that are seen to be long enough within this block.

        `on` (n,) is where the machine runs; None: runs end where a pause or a stretch does.
        """
        if not len(time):
            return []
        begin, end = self._stretches(time) if on is None else self._edges(on)
        self._last_s = float(time[-1])
        begun = [(self._rows + int(b), float(time[b])) for b in begin]
        if self._begun is not None:
            begun.insert(0, self._begun)
        found = []
        for k, ((row, began_s), e) in enumerate(zip(begun, end, strict=True)):
            run_s = float(time[min(int(e), len(time) - 1)]) - began_s
            self.longest_s = max(self.longest_s, 0.0 if np.isnan(run_s) else run_s)
            self._reported = self._reported and k == 0 and self._begun is not None
            if run_s >= self._min_run_s and not self._reported:
                found.append(row)
                self._reported = True
        self._rows += len(time)
        self._begun = begun[-1] if on is None or on[-1] else None
        return found

    def _edges(self, on: NDArray[np.bool_]) -> tuple[Index, Index]:
        edges = np.diff(on.astype(np.int8), prepend=np.int8(self._begun is not None), append=np.int8(0))
        return np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)

    def _stretches(self, time: Array) -> tuple[Index, Index]:
        known = time[np.isfinite(time)]
        self._first_s = self._first_s if np.isfinite(self._first_s) or not len(known) else float(known[0])
        before = np.concatenate([[self._last_s], time[:-1]])
        turns = np.floor((time - self._first_s) / self._every_s) > np.floor((before - self._first_s) / self._every_s)
        new = (time - before > self._pause_s) | turns
        new[0] |= self._begun is None
        begin = np.flatnonzero(new)
        ends = np.append(begin - 1, len(time) - 1)  # the last row of each stretch, that under way first
        return begin, ends if self._begun is not None else ends[1:]


def _split(parts: list[Rows], n: int) -> tuple[list[Rows], list[Rows]]:
    done: list[Rows] = []
    for i, part in enumerate(parts):
        if n >= len(part) and (n > 0 or part.ragged):
            done.append(part)
            n -= len(part)
            continue
        if n > 0:
            done.append(part.part(0, n))
        return done, [part.part(n, len(part)) if n else part, *parts[i + 1 :]]
    return done, []
