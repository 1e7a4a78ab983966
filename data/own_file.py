"""Parquet files that thermodrift wrote itself: they say what they are, whatever a machine file expects of recordings.

Their columns are `time_s` and the machine file's channels in its units; that they are simulated, from which machine
and since when stands in the file's metadata (see `data.lakefile`), and goes with them wherever they are read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from data.batch import Batch
from data.errors import InputError
from data.lakefile import META_KEY, SCHEMA
from data.machine import Machine, Recording, TimeColumn


@dataclass(frozen=True)
class OwnFile:
    """The note inside a file: which machine, whether simulated, when it began, labels."""

    name: str
    note: Mapping[str, Any]

    def layout(self, machine: Machine) -> Machine:
        """The machine file as it describes this file: columns by channel name, time in s, no schedule, no cutting.

        Raises:
            InputError: the file is of another machine.
        """
        if self.note["machine"] != machine.machine:
            raise InputError(
                f"{self.name}: written for machine {self.note['machine']!r}, the machine file is of "
                f"{machine.machine!r}; take the machine file of this recording"
            )
        own = Recording(time=TimeColumn(), step_s=machine.recording.step_s, max_gap_s=machine.recording.max_gap_s)
        channels = {
            n: c.model_copy(update={"column": n, "columns": None, "unit_in_file": c.unit, "source": "file"})
            for n, c in machine.channels.items()
        }
        simulated = machine.simulated or bool(self.note["simulated"])
        ignore = ["batch", "simulated"]
        return machine.model_copy(
            update={"recording": own, "channels": channels, "simulated": simulated, "ignore": ignore}
        )

    def marked(self, batch: Batch) -> Batch:
        """The batch with the start and the labels that the file notes."""
        start = self.note["start"]
        return replace(batch, start=None if start is None else pd.Timestamp(start), labels=self.note["labels"])


def own_file(path: Path) -> OwnFile | None:
    """The note of a file that thermodrift wrote; None for every other file, damaged ones included."""
    if path.suffix.lower() not in (".parquet", ".pq"):
        return None
    try:
        note = json.loads((pq.read_schema(path).metadata or {})[META_KEY])
        if note["schema"] != SCHEMA:
            return None
        return OwnFile(path.name, {k: note[k] for k in ("machine", "simulated", "start", "labels")})
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError):
        return None
