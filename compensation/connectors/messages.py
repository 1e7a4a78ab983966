"""What all connectors share: addresses, channel names and units, samples and corrections as text, reports of skips."""

from __future__ import annotations

import datetime as dt
import math
import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import NamedTuple

from compensation.contracts import Correction, Sample
from data.errors import WorkError, closest
from data.files import from_json
from data.machine import Machine
from data.readers.cells import parse_number
from data.readers.csv import normalise
from data.units import conversion

BLOCK_S = 0.9  # the longest time that a sink's `write` may wait: the contract allows 1 s
IDLE_S = 0.5  # a source yields None after this silence: the contract asks for one at least every second
TIME_KEYS = ("time_s", "time", "timestamp")
STATES = ("off", "fade-out", "hold", "warm-up", "active")  # from no authority to full authority

_MILLISECONDS_FROM = 1e11  # a Unix time in s reaches this in the year 5138
_MAX_KEYS = 1000  # of `Reports`: names come from outside, memory must not grow with them
_MISSING = ("", "nan", "null", "none")


# ----- reports on standard error


def shown(address: str) -> str:
    """An address as error lines may show it: without user, password and query."""
    return re.sub(r"//.*@", "//", address, flags=re.DOTALL).partition("?")[0]


def warn(text: str) -> None:
    """One line on standard error."""
    print(f"thermodrift: {text}", file=sys.stderr, flush=True)


class Reports:
    """Reports what is skipped: the first `first` items of an unbroken row of skips under one key, each in one line."""

    def __init__(self, first: int = 1) -> None:
        self._first = first
        self._skips: dict[str, int] = {}

    def skipped(self, key: str, text: str) -> None:
        """Report a skip, unless `first` reports stand under this key since the last success."""
        if key not in self._skips and len(self._skips) >= _MAX_KEYS:
            return
        n = self._skips[key] = self._skips.get(key, 0) + 1
        if n <= self._first:
            silent = n == self._first
            warn(f"{text}; skipped" + " (further ones are not reported until one is read)" * silent)

    def read(self, key: str) -> None:
        """Note a success: the next skip under this key is reported again."""
        self._skips.pop(key, None)


def excerpt(given: object) -> str:
    """What was given, short enough for an error line."""
    text = given.decode("utf-8", "replace") if isinstance(given, bytes | bytearray) else given
    quoted = repr(text)
    return quoted if len(quoted) <= 60 else f"{quoted[:57]}…"


# ----- numbers and times


def number(given: object, decimal: str = ".") -> float | None:
    """A finite number from a JSON value or a cell, or None."""
    if isinstance(given, str):
        return parse_number(given, decimal)
    if isinstance(given, bool) or not isinstance(given, int | float):
        return None
    try:
        value = float(given)
    except OverflowError:
        return None
    return value if math.isfinite(value) else None


def is_missing(given: object) -> bool:
    """Whether a value says that there is none: null, NaN or an empty cell."""
    if isinstance(given, str):
        return given.strip().lower() in _MISSING
    return given is None or (isinstance(given, float) and math.isnan(given))


def unix_time_s(given: object, pattern: str | None = None, unit_s: float = 1.0) -> float:
    """Unix time in s from a number or a time stamp.

    A number counts in `unit_s`; in s it may also be Unix milliseconds (from 1e11). Text is read by the strptime
    `pattern`, if one is given, or as ISO 8601. Without an offset from UTC it is in this computer's local time.

    Raises:
        ValueError: neither, or a time of day without a date; the message says what was got and expected.
    """
    value = number(given)
    if value is not None:
        return value / 1e3 if unit_s == 1.0 and value >= _MILLISECONDS_FROM else value * unit_s
    text = given.strip() if isinstance(given, str) else ""
    readers = [dt.datetime.fromisoformat]
    if pattern:
        readers.insert(0, lambda text: dt.datetime.strptime(text, pattern))
    for read in readers:
        with suppress(ValueError, OverflowError, OSError):
            if (unix_s := read(text).timestamp()) >= 0.0:
                return unix_s
    form = f" or {pattern!r}" if pattern else ""
    raise ValueError(f"got time {excerpt(given)}, expected Unix seconds or an ISO time stamp{form}")


# ----- channels


class Target(NamedTuple):
    """Where a value goes: value in the channel's unit = factor · value + offset."""

    channel: str
    is_reading: bool
    factor: float = 1.0
    offset: float = 0.0


class Decoder:
    """Samples from the names, numbers and texts that arrive, in the units of the machine file.

    A channel goes by its own name or by the `column` of the machine file. A value under the name is in `unit`, one
    under the column in `unit_in_file`. Where both are the same text, a CSV file means the column, all others the name.
    A value that is no number, or whose channel is unknown, is left out and reported, `first` times in a row.

    Raises:
        InputError: a unit that cannot be converted.
    """

    def __init__(self, machine: Machine, first: int = 1) -> None:
        self.channels = tuple(machine.channels)
        self._reports = Reports(first)
        self._by_name: dict[str | int, Target] = {}
        self._by_column: dict[str | int, Target] = {}
        for name, part in machine.channels.items():
            where = f"machine file {machine.machine}: channel {name!r}"
            scale = conversion(part.unit_in_file or part.unit, part.unit, where)
            is_error = part.role == "error"
            self._by_name[name] = Target(name, is_error)
            self._by_column[name if part.column is None else part.column] = Target(name, is_error, *scale)
        for known in (self._by_name, self._by_column):  # other spellings, where they are no other channel's
            for exact, target in list(known.items()):
                known.setdefault(exact if isinstance(exact, int) else normalise(exact), target)

    def target(self, key: str | int, column: bool = False) -> Target | None:
        """The channel of a key of a message, or of a `column` of a CSV file; None where there is none."""
        tables = (self._by_column, self._by_name) if column else (self._by_name, self._by_column)
        spellings = [key] if isinstance(key, int) else [key, key.strip(), normalise(key)]
        return next((table[s] for table in tables for s in spellings if s in table), None)

    def numbers(
        self, cells: Iterable[tuple[str, Target | None, object]], where: str, decimal: str = "."
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Values and readings by channel, from key, channel and number of each cell."""
        values: dict[str, float] = {}
        readings: dict[str, float] = {}
        for key, target, given in cells:
            if target is None:
                unknown = f"{where}: unknown channel {excerpt(key)}: {closest(key[:60], self.channels)}"
                self._reports.skipped(key, unknown)
            elif not is_missing(given):
                value = number(given, decimal)
                if value is None:
                    self._reports.skipped(key, f"{where}: {key}: got {excerpt(given)}, expected a number")
                    continue
                self._reports.read(key)
                (readings if target.is_reading else values)[target.channel] = value * target.factor + target.offset
        return values, readings

    def sample(self, text: str | bytes | bytearray, where: str, arrival_s: float | None) -> Sample:
        """A sample from one JSON object.

        Either ``{"time_s": …, "values": {channel: number}, "readings_um": {error channel: number}}`` or flat, with the
        channels next to the time; a number under an error channel is a reading in both. The time stands under `time_s`,
        `time` or `timestamp`, as Unix time in s or as an ISO time stamp; without one the sample has `arrival_s`.

        Raises:
            ValueError: not a JSON object, or no time and no `arrival_s`; the message says what was got and expected.
        """
        try:
            given = from_json(text)
        except ValueError:
            given = None
        if not isinstance(given, dict):
            raise ValueError(f"got {excerpt(text)}, expected one JSON object")
        stamps = [given.pop(key) for key in TIME_KEYS if key in given]
        time_s = unix_time_s(stamps[0]) if stamps else arrival_s
        if time_s is None:
            raise ValueError(f"got {excerpt(text)}, expected the key 'time_s'")
        nested = [given[key] for key in ("values", "readings_um") if key in given]
        for part in nested:
            if not isinstance(part, dict):
                raise ValueError(f"got {excerpt(part)} under 'values' or 'readings_um', expected an object")
        cells = ((key, self.target(key), cell) for part in nested or [given] for key, cell in part.items())
        return Sample(time_s, *self.numbers(cells, where))


# ----- corrections


def check_deliverable(correction: Correction, where: str) -> None:
    """Refuse a correction that no control must get.

    Raises:
        WorkError: an offset or slope that is not finite.
    """
    for what, parts in (("offset_um", correction.offset_um), ("slope_um_per_m", correction.slope_um_per_m)):
        for axis, value in parts.items():
            if not math.isfinite(value):
                raise WorkError(f"{where}: axis {axis!r}: {what} is {value}, expected a finite number; nothing is sent")


def overall_state(correction: Correction) -> str:
    """The state with most authority among the axes: `off` only where every axis is off."""
    return max(correction.state.values(), key=lambda s: STATES.index(s) if s in STATES else -1, default="off")
