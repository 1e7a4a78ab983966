"""What a machine file keeps back: parts taken out or replaced, and the term that a diagnosis should give back."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import pandas as pd

from data.batch import Batch
from data.machine import Machine
from plants.real import parts_at

Term = dict[str, Any]


@dataclass(frozen=True)
class KeptBack:
    """One case. `without` and `instead` are dotted paths below the machine file's `twin`; `channels` are hidden.

    `terms` gives the answer for the full file's twin part (plain data) and the runs. `twin` False: no twin part at all.
    """

    name: str
    machine: str
    words: str
    terms: Callable[[Mapping[str, Any], list[Batch]], list[Term]]
    without: tuple[str, ...] = ()
    instead: Mapping[str, Any] = field(default_factory=dict)
    channels: tuple[str, ...] = ()
    twin: bool = True
    kind: str = "one"

    def hidden_from(self, machine: Machine, batches: list[Batch]) -> tuple[Machine, list[Batch]]:
        """Machine file and runs without what is kept back."""
        part = copy.deepcopy(machine.twin) if self.twin else None
        for path in self.without:
            *keys, last = path.split(".")
            for at in parts_at(part, keys):
                del at[last]
        for path, new in self.instead.items():
            *keys, last = path.split(".")
            for at in parts_at(part, keys):
                at[last] = copy.deepcopy(new)
        channels = {n: c for n, c in machine.channels.items() if n not in self.channels}
        bare = machine.model_copy(update={"twin": part, "channels": channels})
        return bare, [_without(b, self.channels) for b in batches]


def _without(batch: Batch, channels: tuple[str, ...]) -> Batch:
    kept = {n: c for n, c in batch.channels.items() if n not in channels}
    table: pd.DataFrame = batch.table.drop(columns=list(channels))
    return replace(batch, channels=kept, table=table)
