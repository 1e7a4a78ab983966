"""Machine file: schema of the YAML file that describes a machine's recordings, and its loading."""

from __future__ import annotations

import contextlib
import unicodedata
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from data.batch import Channel, Role
from data.errors import InputError, closest
from data.units import seconds
from data.yaml_file import TimeZone, load_yaml, parse_yaml

RESERVED = ("batch", "simulated", "machine", "year")  # columns that the lake adds, and its partition keys
TAKEN = (*RESERVED, "time_s", "batch_id")  # names of columns that stand next to the channels somewhere
MAX_NAME = 80  # characters: the name becomes part of longer file names
_MAX_NAME_BYTES = 160
_MARKS = " _-.+%°()"


def _channel_name(name: str) -> str:
    """The name of a channel, which also becomes that of a column, a file, an experiment and a registered model.

    The separators of this project (``|`` between the inputs of a cell, ``@`` before the form of an input), those of
    paths and addresses (``/ \\ : ? #``), quotes, wildcards and control characters would break one of these.

    Raises:
        ValueError: another name.
    """
    allowed = "letters and digits of any script, blanks and _ - . + % ° ( )"
    bad = next((c for c in name if c not in _MARKS and unicodedata.category(c)[0] not in "LMN"), None)
    if bad is not None:
        raise ValueError(f"a channel's name has the character {bad!r}, allowed are {allowed}; rename the channel")
    if not name.strip() or name[0] in " .-+" or name[-1] in " .":
        raise ValueError(
            "a channel's name must begin with a letter, a digit, _ % ° or ( and not end with a blank or a dot, "
            f"allowed inside are {allowed}; rename the channel"
        )
    if len(name) > MAX_NAME or len(name.encode()) > _MAX_NAME_BYTES:
        raise ValueError(
            f"a channel's name has {len(name)} characters, allowed are {MAX_NAME} (and {_MAX_NAME_BYTES} bytes); "
            "shorten it"
        )
    if name in TAKEN:
        raise ValueError(f"thermodrift adds a column of this name ({', '.join(TAKEN)}); rename the channel")
    return name


ChannelName = Annotated[str, AfterValidator(_channel_name)]


class Section(BaseModel):
    """A part of the machine file: unknown keys are errors, values do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TimeColumn(Section):
    """Which column is time. `unit` is s, min, h, …, or timestamp (then `format` may name a strptime pattern).

    `clock` overrides how a column of time is taken: `stamp` is the unit timestamp, `elapsed` counts from the start
    (numbers in `unit`, or h:mm:ss, also beyond 24 h), `step` needs the key `step`.

    `date` names the column of the dates where `column` holds times of day; `format` is then of both with a blank
    between them. `step` instead of all these: the recordings have no clock, and their rows follow each other by that
    much ("60 s").
    """

    column: str | int = "time_s"  # a header, or a 0-based position where the file has none
    unit: Literal["s", "min", "h", "d", "ms", "us", "ns", "timestamp"] = "s"  # of elapsed time, or timestamp
    clock: Literal["elapsed", "stamp", "step"] | None = None  # default: what the other keys say
    format: str | None = None  # strptime pattern of time stamps; default: found by itself
    date: str | int | None = None  # column of the dates where `column` holds times of day
    step: str | None = None  # between two rows of a recording without a clock, such as "60 s"

    @model_validator(mode="before")
    @classmethod
    def _stamps(cls, given: Any) -> Any:
        stamp = isinstance(given, dict) and given.get("clock") == "stamp"
        return {"unit": "timestamp", **given} if stamp else given

    @model_validator(mode="after")
    def _one_clock(self) -> TimeColumn:
        means = "step" if self.step is not None else "stamp" if self.unit == "timestamp" else "elapsed"
        if self.clock not in (None, means):
            raise ValueError(f"clock: {self.clock} contradicts the other keys, which mean {means}; give unit or step")
        if self.step is not None:
            try:
                seconds(self.step)
            except ValueError as error:
                raise ValueError(f"step, the time between two rows of a recording without a clock: {error}") from None
            if (self.column, self.unit, self.format, self.date) != ("time_s", "s", None, None):
                raise ValueError("step means that no column is a clock; give either step or column, unit and format")
        if self.date is not None and self.unit != "timestamp":
            raise ValueError("date goes with time stamps; give unit: timestamp")
        return self

    @property
    def row_step_s(self) -> float | None:
        """The time between two rows where they are the clock."""
        return None if self.step is None else seconds(self.step)


class Stage(Section):
    """One stage of a schedule row: how long (column name, h) and the driver columns that hold during it."""

    hours: str
    drivers: dict[str, str]  # driver channel -> column of the schedule file


class Schedule(Section):
    """Drivers from a table next to the recordings: one row per batch, one or more stages."""

    file: str  # name of the table, next to the recordings
    batch_column: str  # which column holds the batch's name
    stages: list[Stage]
    labels: dict[str, str] = {}  # batch label -> column


class Split(Section):
    """Cut one long recording into batches. Exactly one of three keys says where a batch begins; shorter ones make none.

    `driver`: where a channel rises above `above`, by default 0; the stop that follows belongs to the batch. It may be a
    temperature, with its idle value as `above`. `pause`: after so long without a row. `every`: after each such stretch.
    """

    driver: str | None = None  # channel
    above: float | None = None  # in the channel's unit; default: its size above half a resolution
    pause: str | None = None  # such as "30 min"
    every: str | None = None  # such as "24 h"
    min_run_s: Annotated[float, Field(gt=0)] = 600.0  # a shorter run makes no batch

    @model_validator(mode="after")
    def _one_way(self) -> Split:
        if sum(key is not None for key in (self.driver, self.pause, self.every)) != 1:
            raise ValueError("expected exactly one of driver, pause and every")
        for text in filter(None, (self.pause, self.every)):
            seconds(text)
        return self


class Pivot(Section):
    """Rows of one reading each: `name` are the columns that say of what, `value` the column of the readings.

    A channel's `column` is then what `name` holds, with a blank between several columns.
    """

    name: str | list[str]
    value: str | list[str]  # of several, the value's column follows the name


class Form(Section):
    """Layout of a file's table. Each key overrides what reading finds by itself."""

    format: str | None = None  # of the file, whatever its suffix: csv, lvm, xlsx, parquet
    encoding: str | None = None  # of text, such as cp1252
    separator: Annotated[str, Field(min_length=1, max_length=2)] | None = None  # " " for blanks, "  " for two at least
    decimal: Literal[".", ","] | None = None
    header: bool = True  # the file has a row of names
    header_rows: Annotated[int, Field(ge=0)] | None = None  # lines above the first data row
    units_row: Annotated[int, Field(ge=1)] | None = None  # the line of the units, counted from 1; for `describe`
    timezone: TimeZone | None = None  # of time stamps without one, such as Europe/Berlin
    pivot: Pivot | None = None  # of a long table
    time: TimeColumn = TimeColumn()


class Joined(Form):
    """Other files, or other sheets, that hold further channels of the same runs (channels with this `source`).

    `file` is a name or pattern next to the recording; its * stands for what the * of `recording.files` stands for in
    the recording's name, or else for that name without suffix. Without `file` it is the recording's own workbook.
    Of several sheets that one is taken which `sheet` (a name or pattern) names, or which is called as the recording's
    sheet or run. `by: time` takes the rows of all matching files and sheets that have the recording's times.
    """

    file: str | None = None
    sheet: str | None = None
    by: Literal["name", "time"] = "name"

    @model_validator(mode="after")
    def _time_stamps(self) -> Joined:
        if self.by == "time" and self.time.unit != "timestamp":
            raise ValueError("by: time compares time stamps; give time: {column: …, unit: timestamp}")
        return self


Drivers = Literal["held", "instant", "mean"]
LEAD_ROWS: Mapping[Drivers, float] = {"held": 0.0, "instant": 0.5, "mean": 1.0}
"""By how many rows a driver's change comes before the row that first shows it."""


class Recording(Form):
    """How a recording file becomes batches.

    `drivers` says what a row shows of a driver: the value that holds from the row on (`held`), the value at that
    instant, so that a change happened half a row earlier on average (`instant`), or the mean over the interval that
    ends with the row (`mean`). Where it is not stated, a calibration or a diagnosis learns it from the recordings.
    """

    files: list[str] = ["*.csv", "*.xlsx", "*.parquet", "*.txt"]  # patterns inside a directory
    step_s: Annotated[float, Field(gt=0)] = 60.0  # of the regular grid in the lake
    max_gap_s: Annotated[float, Field(gt=0)] = 300.0  # a longer hole stays one; slower channels: 2.5 intervals
    start_from_name: str | None = None  # strptime pattern of the file's stem or its sheet, e.g. "%Y%m%d"
    order: Literal["name"] | list[str | int] | None = None  # of runs without a start: by id, or the ids, earliest first
    split: Split | None = None  # one long recording into runs
    schedule: Schedule | None = None  # drivers from a table
    joined: dict[str, Joined] = {}  # further files or sheets of the same runs, by a name of your choice
    drivers: Drivers | None = None  # what a row shows of a driver; default: learned

    @model_validator(mode="before")
    @classmethod
    def _grid_of_rows(cls, given: Any) -> Any:
        """Without a clock and a grid of their own, the rows are the grid."""
        with contextlib.suppress(ValueError, KeyError, TypeError):  # the keys' own checks report it
            step_s = seconds(given["time"]["step"])
            return {"step_s": step_s, "max_gap_s": 5 * step_s, **given}
        return given


class ChannelPart(Section):
    """One channel: role, canonical unit, where it stands in the file, resolution and plausible range in that unit.

    `column` defaults to the channel's name; `unit_in_file` to `unit`. A driver that only the schedule gives has
    `column: null` and `source: schedule`; a channel from another file has that file's name in `recording.joined` as its
    source. An error channel that is measured at positions along an axis names the position channel in `position`.
    Where the file has one column for each position, `columns` gives them, and the position channel needs no column: a
    pattern whose * is the position (``"x=*"``), or column -> position.
    """

    role: Role
    unit: str  # in the lake and in models
    column: str | int | None = None  # a header, or a 0-based position; default: the channel's name
    unit_in_file: str | None = None  # default: `unit`
    source: str = "file"  # or "schedule", or a key of recording.joined
    resolution: Annotated[float, Field(gt=0)] | None = None  # smallest step of the instrument, in `unit`
    range: tuple[float, float] | None = None  # plausible values in `unit`; others are masked
    position: str | None = None  # of an error along an axis: the position channel
    columns: str | dict[str | int, float] | None = None  # positions in the position channel's unit in the file
    fixed_end: float | None = None  # of a position channel: where the axis' screw is held, in `unit`
    guessed: list[str] = []  # keys that `describe` guessed and nobody has confirmed

    @model_validator(mode="after")
    def _range_rises(self) -> ChannelPart:
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"range {list(self.range)}: the first must be below the second")
        return self


class Overrule(Section):
    """An overruled check: matching findings lose their mask.

    `mask: true` adds one instead: with `check` over the matching findings, which it confirms; else over the interval
    """

    batch: str = "*"  # id or pattern
    channel: str = "*"  # name or pattern
    check: str = "*"  # key or pattern
    mask: bool = False  # true: mask instead of lifting masks
    start_s: float | None = None  # from the batch's start; default: the whole batch
    end_s: float | None = None
    reason: str  # reports repeat it


class Machine(Section):
    """A whole machine file."""

    machine: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_\-]*$", max_length=MAX_NAME)]
    description: str = ""
    simulated: bool = False  # true: every result is labelled
    recording: Recording = Recording()
    channels: dict[ChannelName, ChannelPart]  # by name
    ignore: list[str] = []  # columns known and not wanted
    overrule: list[Overrule] = []  # masks of checks lifted or added
    twin: dict[str, Any] | None = None  # see the twin part; read by the twin

    def channel(self, name: str) -> Channel:
        c = self.channels[name]
        low, high = c.range if c.range else (None, None)
        return Channel(name, c.role, c.unit, c.resolution, low, high, c.position or "")

    def batch_channels(self) -> dict[str, Channel]:
        """Name -> Channel for every channel, in the file's order."""
        return {name: self.channel(name) for name in self.channels}

    def names(self, *roles: str) -> tuple[str, ...]:
        return tuple(n for n, c in self.channels.items() if c.role in roles)

    def axes(self) -> dict[str, tuple[str, ...]]:
        """Position channel -> error channels that are measured at its positions."""
        out: dict[str, tuple[str, ...]] = {}
        for name, part in self.channels.items():
            if part.position is not None:
                out[part.position] = (*out.get(part.position, ()), name)
        return out


def load_machine(path: Path | str) -> Machine:
    """Read and check a machine file.

    Raises:
        InputError: file missing, not YAML, a misspelt key (with the closest), a wrong value; one line each.
    """
    return _axes_checked(load_yaml(Path(path), Machine, "machine file"), f"machine file {path}")


def parse_machine(text: str, where: str) -> Machine:
    """The same from text; `where` names the origin in error lines."""
    return _axes_checked(parse_yaml(text, Machine, f"machine file {where}"), f"machine file {where}")


def _axes_checked(machine: Machine, where: str) -> Machine:
    """The machine, if its channels' sources are known and errors along axes and position channels fit together."""
    for name, part in machine.channels.items():
        here = f"{where}: channel {name!r}"
        sources = ("file", "schedule", *machine.recording.joined)
        if part.source not in sources:
            raise InputError(f"{here}: unknown source {part.source!r}; {closest(part.source, sources)}")
        if part.fixed_end is not None and part.role != "position":
            raise InputError(f"{here} is a {part.role} and has a fixed_end; give that to the axis' position channel")
        if part.position is None and part.columns is not None:
            raise InputError(f"{here} has columns but no position; add position: with the name of a position channel")
        if part.position is None:
            continue
        if part.role != "error":
            raise InputError(f"{here} is a {part.role} and has a position; only error channels are measured at one")
        along = machine.channels.get(part.position)
        if along is None or along.role != "position":
            got = "no channel" if along is None else f"a {along.role}"
            names = machine.names("position")
            raise InputError(
                f"{here}: position {part.position!r} is {got}, expected a channel with role: position; "
                f"{closest(part.position, names) if names else 'add one with unit: mm'}"
            )
        if along.unit != "mm":
            raise InputError(
                f"{here}: its position channel {part.position!r} has unit {along.unit!r}, expected 'mm'; "
                f"write unit: mm and unit_in_file: {along.unit!r}"
            )
        _columns_checked(machine, name, part, here)
    return machine


def _columns_checked(machine: Machine, name: str, part: ChannelPart, here: str) -> None:
    if part.columns is None:
        return
    if isinstance(part.columns, str) and (part.columns.count("*") != 1 or not machine.recording.header):
        raise InputError(
            f"{here}: columns {part.columns!r}, expected a header's pattern with one * where the position stands, "
            'such as "x=*"; without a header give column: position for each'
        )
    if part.column is not None:
        raise InputError(f"{here} has both column and columns; leave column: out, each position has a column")
    others = [n for n in machine.axes()[part.position or ""] if n != name]
    if others:
        raise InputError(
            f"{here} has one column for each position, but position channel {part.position!r} also serves "
            f"{others[0]!r}; give it a position channel alone"
        )
