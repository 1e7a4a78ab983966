"""Standard streams and CSV files: samples as lines of JSON or CSV, corrections as lines of JSON or CSV."""

from __future__ import annotations

import csv
import io
import json
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import asdict
from pathlib import Path
from typing import BinaryIO, TextIO

from compensation.connectors.messages import (
    BLOCK_S,
    IDLE_S,
    TIME_KEYS,
    Decoder,
    Reports,
    Target,
    check_deliverable,
    excerpt,
    unix_time_s,
    warn,
)
from compensation.contracts import Correction, Sample
from data.errors import InputError, WorkError
from data.machine import Machine
from data.readers.csv import find_decimal, find_separator, normalise, split
from data.units import TIME_UNITS_S

POLL_S = 0.2  # between two looks at a growing file
_CHUNK_BYTES = 1 << 16
_MAX_LINE_BYTES = 1_000_000  # a longer line is none: memory must not grow with a stream without line ends
_REPORTED_LINES = 10  # of an unbroken row of unreadable ones


# ----- lines to samples


class _Lines:
    """Cuts bytes into lines; the last one waits for its end."""

    def __init__(self) -> None:
        self.number = 0  # of the line last given, counted from 1
        self._rest = b""

    def feed(self, data: bytes) -> Iterator[bytes]:
        *whole, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > _MAX_LINE_BYTES:
            whole, self._rest = [*whole, self._rest], b""
        for line in whole:
            self.number += 1
            yield line

    def unfinished(self) -> Iterator[bytes]:
        """The last line, if something of it has come."""
        rest, self._rest = self._rest, b""
        if rest.strip():
            self.number += 1
            yield rest


class _Columns:
    """The header of a CSV table: which cell is the time and where the others go."""

    def __init__(self, header: Sequence[str] | None, separator: str, machine: Machine, decoder: Decoder) -> None:
        """`header` None: the machine's recordings have no header, and columns are positions."""
        clock = machine.recording.time
        titles: list[str | int] = [*(header or ())]
        if header is None:
            columns = [clock.column, *(part.column for part in machine.channels.values())]
            titles = [*range(1 + max((c for c in columns if isinstance(c, int)), default=0))]
        folded = [t if isinstance(t, int) else normalise(t) for t in titles]
        wanted = [c if isinstance(c, int) else normalise(c) for c in (clock.column, *TIME_KEYS)]
        self.width = None if header is None else len(header)
        self.separator = separator
        self.decimal = machine.recording.decimal or "."
        self.time = next((folded.index(w) for w in wanted if w in folded), None)
        # unit and format of the machine file describe its own time column, not one under a standard name
        own = self.time is not None and folded[self.time] == wanted[0]
        self.pattern = clock.format if own else None
        self.unit_s = TIME_UNITS_S.get(clock.unit, 1.0) if own else 1.0
        date = clock.date if isinstance(clock.date, int) or clock.date is None else normalise(clock.date)
        self.date = folded.index(date) if own and date in folded else None
        self.targets: dict[int, Target] = {}
        self.unknown: list[str] = []
        ignored = {normalise(name) for name in machine.ignore}
        taken: set[str] = set()
        for i, title in enumerate(titles):
            if i in (self.time, self.date):
                continue
            target = decoder.target(title, column=True)
            if target is not None and target.channel not in taken:
                self.targets[i] = target
                taken.add(target.channel)
            elif str(title).strip() and folded[i] not in ignored and header is not None:
                self.unknown.append(str(title).strip())


class LineParser:
    """Samples from lines, each a JSON object (`Decoder.sample`) or a row of one CSV table.

    The first line that is no JSON object is the table's header, unless the machine file says ``header: false``. Its
    columns are channels (by `column` or name, see `Decoder`) and one time: the machine file's time column, or `time_s`,
    `time` or `timestamp` (Unix seconds or ISO). The separator is found from the header; with one other than the comma,
    a comma may be the decimal mark. Lines that begin with ``# `` are comments. An unreadable line is skipped with one
    line on standard error.

    Raises:
        InputError: the first header has no time or no known channel.
    """

    def __init__(self, machine: Machine, where: str) -> None:
        self._machine = machine
        self._where = where
        self._decoder = Decoder(machine)
        self._columns: _Columns | None = None
        self._before: _Columns | None = None  # of the file that this one replaces
        self._broken_header = False
        self._lines = Reports(_REPORTED_LINES)

    def restart(self) -> None:
        """Expect a header again: another file takes the place of the one before."""
        self._before = self._columns or self._before
        self._columns, self._broken_header = None, False

    def sample(self, line: bytes, row: int) -> Sample | None:
        """The sample of a line; None for a header, a comment, an empty or an unreadable line. `row` is its number."""
        try:
            text = line.decode("utf-8")
        except UnicodeDecodeError:
            text = line.decode("cp1252", "replace")  # loggers on Windows write ° and µ like this
        text = text.strip("\r\n\ufeff\0 ")
        if not text or text.startswith("# "):
            return None
        where = f"{self._where} line {row}"
        try:
            if text.startswith("{"):
                sample: Sample | None = self._decoder.sample(text, where, None)
            else:
                sample = self._row(text, where)
        except ValueError as error:
            self.skip(where, str(error))
            return None
        if sample is not None:
            self._lines.read("")
        return sample

    def skip(self, where: str, why: str) -> None:
        self._lines.skipped("", f"{where}: {why}")

    def _row(self, text: str, where: str) -> Sample | None:
        columns = self._columns
        if columns is None and not self._machine.recording.header:
            columns = self._columns = _Columns(None, find_separator([text], []), self._machine, self._decoder)
        if columns is None:
            if self._header(text, where):
                return None
            columns = self._columns
        if columns is None:
            raise ValueError(f"got {excerpt(text)} below a header without a time or a known channel")
        return self._cells_to_sample(split(text, columns.separator), columns, where)

    def _header(self, text: str, where: str) -> bool:
        """Take a line as the header; False: it is a row of the table before, whose file was emptied under its writer.

        Raises:
            InputError: the first header is unusable; a later one is reported, and its rows are skipped.
        """
        if self._broken_header:
            return False
        clock = self._machine.recording.time.column
        named = [c for c in (clock, *(part.column for part in self._machine.channels.values())) if isinstance(c, str)]
        separator = find_separator([text], [*self._decoder.channels, *named, *TIME_KEYS])
        columns = _Columns(split(text, separator), separator, self._machine, self._decoder)
        if columns.time is not None and columns.targets:
            self._columns = columns
            if columns.unknown:
                unknown = ", ".join(columns.unknown[:10])
                warn(f"{where}: columns that are no channel are left out: {unknown}; list them under ignore")
            return True
        if self._before is not None and len(split(text, self._before.separator)) == self._before.width:
            self._columns = self._before
            return False
        missing = "time column" if columns.time is None else "column of a channel"
        expected = f"{clock!r}, {', '.join(TIME_KEYS)}" if columns.time is None else ", ".join(self._decoder.channels)
        message = f"{where}: the header has no {missing}: got {excerpt(text)}, expected one of {expected}"
        if self._before is None:
            raise InputError(f"{message}; correct the header or the machine file")
        self._broken_header = True
        warn(f"{message}; all its rows are skipped")
        return True

    def _cells_to_sample(self, cells: list[str], columns: _Columns, where: str) -> Sample:
        width, time = columns.width, columns.time
        needed = max(columns.targets, default=0) + 1
        if (width is not None and len(cells) != width) or len(cells) < needed or time is None or time >= len(cells):
            raise ValueError(f"got {len(cells)} cells, expected {width or needed}")
        stamp = cells[time] if columns.date is None else f"{cells[columns.date].strip()} {cells[time].strip()}"
        time_s = unix_time_s(stamp, columns.pattern, columns.unit_s)
        given = {i: cells[i] for i in columns.targets}
        if columns.separator != "," and find_decimal([list(given.values())]) == ",":
            columns.decimal = ","  # of the whole table: a cell such as "n.a." has no say
        taken = ((columns.targets[i].channel, columns.targets[i], cell) for i, cell in given.items())
        return Sample(time_s, *self._decoder.numbers(taken, where, columns.decimal))


# ----- sources


class _LineSource:
    """A source of lines."""

    def __init__(self, machine: Machine, where: str) -> None:
        self._parser, self._lines, self._stop = LineParser(machine, where), _Lines(), threading.Event()

    def _chunks(self) -> Iterator[bytes | None]:
        """What has arrived, None in silence; empty at the end."""
        raise NotImplementedError

    def samples(self) -> Iterator[Sample | None]:
        """Samples as their lines are written, None in silence.

        Raises:
            InputError: the first header of a CSV table has no time or no known channel.
        """
        for data in self._chunks():
            some = False
            for line in () if data is None else self._lines.feed(data) if data else self._lines.unfinished():
                sample = self._parser.sample(line, self._lines.number)
                if sample is not None and not self._stop.is_set():
                    some = True
                    yield sample
            if not some and data != b"":
                yield None

    def close(self) -> None:
        """Stop."""
        self._stop.set()


class StandardInput(_LineSource):
    """Samples from standard input, one JSON object or CSV row a line (`LineParser`); ends with the stream, which stays
    open after `close`."""

    def __init__(self, address: str, machine: Machine, stream: BinaryIO | None = None) -> None:
        super().__init__(machine, "standard input")
        stream = sys.stdin.buffer if stream is None else stream
        self._stream = getattr(stream, "raw", stream)  # Python cannot end while a thread waits in a buffered one
        self._read_ahead: queue.Queue[bytes] = queue.Queue(maxsize=16)  # a full one holds the writer back
        # a thread, since no wait for a stream ends after a given time on all systems
        threading.Thread(target=self._read, name="standard input", daemon=True).start()

    def _read(self) -> None:
        read1: Callable[[int], bytes] = getattr(self._stream, "read1", self._stream.read)
        while not self._stop.is_set():
            try:
                data = read1(_CHUNK_BYTES) or b""
            except (OSError, ValueError) as error:  # ValueError: closed by somebody else
                warn(f"standard input: cannot be read ({error}); taken as its end")
                data = b""
            self._read_ahead.put(data)
            if not data:
                return

    def _chunks(self) -> Iterator[bytes | None]:
        while not self._stop.is_set():
            try:
                data = self._read_ahead.get(timeout=IDLE_S)
            except queue.Empty:
                yield None
                continue
            yield data
            if not data:
                return


class CsvSource(_LineSource):
    """Samples from a CSV file, read from its beginning (see `LineParser` for its columns).

    With `follow` the source then waits for further rows. It follows a file that is truncated, or replaced by another
    one under the same name, and waits for one that does not exist yet. A last line without an end waits for its end.
    Without `follow` the source ends at the end of the file.

    Raises:
        InputError: no such folder; without `follow` no such file; not readable.
    """

    def __init__(self, address: str, machine: Machine, *, follow: bool = True) -> None:
        super().__init__(machine, address)
        self._path = Path(address)
        self._follow = follow
        self._file: BinaryIO | None = None
        if not self._open():
            if not follow or not self._path.parent.is_dir():
                missing = "file" if self._path.parent.is_dir() else "folder"
                raise InputError(f"source {address}: no such {missing}; give the path of a CSV file")
            warn(f"{self._path}: does not exist yet; waiting for it")

    def _open(self) -> bool:
        """Open the file, if it exists."""
        try:
            self._file = self._path.open("rb")
        except FileNotFoundError:
            return False
        except OSError as error:
            # a writer on Windows may lock a file for a moment while it replaces it
            if self._lines.number and self._follow:
                return False
            raise InputError(f"source {self._path}: cannot be read ({error.strerror}); give a CSV file") from None
        return True

    def _chunks(self) -> Iterator[bytes | None]:
        while not self._stop.is_set():
            data = self._next_bytes()
            if not data and not self._follow:
                yield data
                break
            yield data or None
            if not data:
                self._stop.wait(POLL_S)
        self._release()

    def _next_bytes(self) -> bytes:
        """What was written since the last call; empty when nothing was."""
        if self._file is None:
            self._open()
        file = self._file
        if file is None:
            return b""
        try:
            data = file.read(_CHUNK_BYTES)
            if data or not self._follow:
                return data
            if self._is_replaced(file):
                data = file.read(_CHUNK_BYTES)  # written before the other file took its place
                if not data:
                    self._begin_again()
                    self._release()
            elif os.fstat(file.fileno()).st_size < file.tell():
                self._begin_again()
                file.seek(0)
        except (OSError, ValueError) as error:  # ValueError: closed by another thread
            if not self._stop.is_set():
                self._parser.skip(str(self._path), f"cannot be read ({error})")
            self._release()
            return b""
        return data

    def _is_replaced(self, file: BinaryIO) -> bool:
        """Whether the path now names another file than the open one; a renamed one may still be written to."""
        here = os.fstat(file.fileno())
        try:
            there = self._path.stat()
        except FileNotFoundError:
            return False
        return (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino)

    def _begin_again(self) -> None:
        """Expect another table from its first line."""
        for line in self._lines.unfinished():
            self._parser.skip(f"{self._path} line {self._lines.number}", f"got {excerpt(line)}, expected a whole line")
        self._parser.restart()
        self._lines = _Lines()

    def _release(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def close(self) -> None:
        """Stop and close the file."""
        super().close()
        self._release()


# ----- sinks


class _Writer:
    """Writes lines in a thread, so that a reader who does not read holds `write` up for a bounded time only."""

    def __init__(self, stream: TextIO, where: str) -> None:
        self._stream = stream
        self._where = where
        self._work: queue.SimpleQueue[tuple[str, Future[None]] | None] = queue.SimpleQueue()
        self._last: Future[None] | None = None
        self._thread = threading.Thread(target=self._run, name=where, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while (item := self._work.get()) is not None:
            text, done = item
            try:
                self._stream.write(text)
                self._stream.flush()
                done.set_result(None)
            except Exception as error:  # handed to the caller of `write`
                done.set_exception(error)

    def write(self, text: str) -> None:
        """Write and flush.

        Raises:
            WorkError: the stream is closed, blocked or full.
        """
        if self._last is not None and not self._last.done():
            raise WorkError(f"{self._where}: an earlier line still waits for its reader; this one is dropped; read it")
        self._last = done = Future[None]()
        self._work.put((text, done))
        try:
            done.result(BLOCK_S)
        except TimeoutError:
            raise WorkError(f"{self._where}: blocked for {BLOCK_S} s; read its output or check its disk") from None
        except (OSError, ValueError) as error:
            raise WorkError(f"{self._where}: cannot be written ({error}); check its reader or its disk") from None

    def close(self) -> None:
        self._work.put(None)
        self._thread.join(BLOCK_S)


class StandardOutput:
    """Corrections to standard output, one JSON object a line.

    ``{"time_s": …, "offset_um": {axis: µm}, "slope_um_per_m": {axis: µm/m}, "state": {axis: …}, "reasons": {axis: …}}``
    """

    def __init__(self, address: str, machine: Machine, stream: TextIO | None = None) -> None:
        self._writer = _Writer(sys.stdout if stream is None else stream, "standard output")

    def write(self, correction: Correction) -> None:
        """Write one line.

        Raises:
            WorkError: nobody reads it, or a number is not finite.
        """
        check_deliverable(correction, "standard output")
        self._writer.write(json.dumps(asdict(correction), ensure_ascii=False) + "\n")

    def close(self) -> None:
        """Stop; the stream itself stays open."""
        self._writer.close()


class CsvSink:
    """Corrections to a CSV file, one row each, flushed; appends to a file that exists.

    Columns: `time_s` (Unix, s), then for every error channel AXIS of the machine file `AXIS_offset_um`,
    `AXIS_slope_um_per_m` (only where its error depends on a position), `AXIS_state` and `AXIS_reason`.

    Raises:
        InputError: the file cannot be written, or begins with another header.
    """

    def __init__(self, address: str, machine: Machine) -> None:
        self._where = address
        self._axes = machine.names("error")
        self._sloped = tuple(a for a in self._axes if machine.channels[a].position is not None)
        header = ["time_s"]
        for axis in self._axes:
            slope = [f"{axis}_slope_um_per_m"] * (axis in self._sloped)
            header += [f"{axis}_offset_um", *slope, f"{axis}_state", f"{axis}_reason"]
        begin = self._beginning(Path(address), _csv_row(header))
        try:
            self._file = Path(address).open("a", encoding="utf-8", newline="")  # noqa: SIM115 (open until `close`)
        except OSError as error:
            raise InputError(f"sink {address}: cannot be written ({error.strerror}); give another path") from None
        self._writer = _Writer(self._file, f"sink {address}")
        if begin:
            self._writer.write(begin)

    def _beginning(self, path: Path, header: str) -> str:
        """What comes before the first row: the header, or the end of a line that was cut, or nothing."""
        try:
            with path.open("rb") as file:
                first = file.readline()
                if not first.strip():
                    return header
                file.seek(-1, os.SEEK_END)
                last = file.read(1)
        except FileNotFoundError:
            return header
        except OSError as error:
            raise InputError(f"sink {path}: cannot be read ({error.strerror}); give another path") from None
        if first.decode("utf-8", "replace").strip() != header.strip():
            raise InputError(
                f"sink {path}: holds another table, got the header {excerpt(first.strip())}, expected "
                f"{excerpt(header.strip())}; give a new file"
            )
        return "" if last == b"\n" else "\n"

    def write(self, correction: Correction) -> None:
        """Append one row.

        Raises:
            WorkError: the file cannot be written, or a number is not finite.
        """
        check_deliverable(correction, self._where)
        row = [repr(float(correction.time_s))]
        for axis in self._axes:
            row.append(_micrometres(correction.offset_um.get(axis)))
            if axis in self._sloped:
                row.append(_micrometres(correction.slope_um_per_m.get(axis)))
            row += [correction.state.get(axis, ""), correction.reasons.get(axis, "").replace("\n", " ")]
        self._writer.write(_csv_row(row))

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
        self._file.close()


def _micrometres(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


def _csv_row(cells: Sequence[str]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(cells)
    return text.getvalue()
