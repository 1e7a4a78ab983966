"""A batch: one run of one machine on a regular time grid, with what was found wrong in it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from data.errors import InputError, closest

Role = Literal["temperature", "error", "driver", "ambient", "position"]


@dataclass(frozen=True)
class Channel:
    """What one column of a batch means.

    `unit` is the canonical unit in the lake (degC, um, rpm, mm/min, mm, …); `resolution` the
    smallest step the instrument shows, in that unit; `low` and `high` the plausible range. An error channel measured
    along an axis names the `position` channel: a row's error is that at the row's position, NaN where none was read.
    """

    name: str
    role: Role
    unit: str
    resolution: float | None = None
    low: float | None = None
    high: float | None = None
    position: str = ""

    @property
    def plausible(self) -> tuple[float, float]:
        """Least and greatest plausible value, ±inf where an end is not known."""
        return (-np.inf if self.low is None else self.low), (np.inf if self.high is None else self.high)


@dataclass(frozen=True)
class Finding:
    """One thing found in the recordings: which check, where, when, and a message with numbers.

    `start_s`/`end_s` are times from the batch's start, both included; None means the batch's end
    on that side. `channel` None means every channel. `masks`: the interval is kept out
    of training; `overruled` gives the user's reason when the machine file lifts that.
    """

    check: str
    channel: str | None
    message: str
    start_s: float | None = None
    end_s: float | None = None
    masks: bool = True
    overruled: str = ""

    def as_dict(self) -> dict[str, Any]:
        """The fields under the keys that are stored; `from_dict` reads them back."""
        return {"words" if k == "message" else k: v for k, v in self.__dict__.items()}

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> Finding:
        return cls(**{"message" if k == "words" else k: v for k, v in stored.items()})


@dataclass(frozen=True)
class Batch:
    """One run. `table` has `time_s` (regular, from 0) and one float64 column per channel.

    `table` holds what was recorded, NaN where nothing was; `masked()` blanks what the findings
    put under a mask. Rows are never cut for a finding, so the lake keeps everything.
    """

    machine: str
    batch_id: str
    table: pd.DataFrame
    channels: Mapping[str, Channel]
    start: pd.Timestamp | None = None
    simulated: bool = False
    source: str = ""
    digest: str = ""  # sha256 of the stored content: what a model was trained on
    version: int = 1
    repairs: Mapping[str, int] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    labels: Mapping[str, Any] = field(default_factory=dict)
    place: int | None = None  # in the order that the machine file states, for batches without a start
    held: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """By driver what holds from each row to the next (n,), where that is known to differ from what the row shows."""

    @property
    def n_rows(self) -> int:
        return len(self.table)

    @cached_property
    def time_s(self) -> NDArray[np.float64]:
        """Time from the batch's start, s, shape (n,)."""
        return self.table["time_s"].to_numpy(float)

    @cached_property
    def step_s(self) -> float:
        """The grid's step, s."""
        return float(self.time_s[1] - self.time_s[0]) if self.n_rows > 1 else 0.0

    def names(self, *roles: str) -> tuple[str, ...]:
        """Channel names of the given roles, in the machine file's order."""
        return tuple(n for n, c in self.channels.items() if c.role in roles)

    def values(self, name: str) -> NDArray[np.float64]:
        """As recorded, in the canonical unit, shape (n,), read-only; NaN where nothing was recorded."""
        if name in self._values:
            return self._values[name]
        if name not in self.table.columns or name == "time_s":
            raise InputError(
                f"batch {self.batch_id} of {self.machine}: no channel {name!r}; {closest(name, self.channels)}"
            )
        values = self._values[name] = self.table[name].to_numpy(float)
        values.flags.writeable = False
        return values

    @cached_property
    def _values(self) -> dict[str, NDArray[np.float64]]:
        """Columns that were read: a pandas table takes longer to give one than most of what is done with it."""
        return {}

    def masked(self, name: str) -> NDArray[np.float64]:
        """As recorded, NaN inside every stretch that a finding masks, shape (n,)."""
        values = self.values(name)
        hits = [f for f in self.findings if f.masks and not f.overruled and f.channel in (name, None)]
        if not hits:
            return values
        values = values.copy()
        for f in hits:
            lo = -np.inf if f.start_s is None else f.start_s
            hi = np.inf if f.end_s is None else f.end_s
            values[(self.time_s >= lo - 1e-6) & (self.time_s <= hi + 1e-6)] = np.nan
        return values

    def with_findings(self, findings: tuple[Finding, ...]) -> Batch:
        return replace(self, findings=findings)


def finding_table(found: Iterable[tuple[str, Sequence[Finding]]]) -> pd.DataFrame:
    """One row a finding from (batch id, findings) pairs: batch_id and the fields of `Finding`, times in s."""
    columns = ["batch_id", "check", "channel", "start_s", "end_s", "words", "masks", "overruled"]
    rows = [{"batch_id": batch_id, **f.as_dict()} for batch_id, findings in found for f in findings]
    return pd.DataFrame(rows, columns=columns).astype({"start_s": float, "end_s": float, "masks": bool})
