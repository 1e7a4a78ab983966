"""A diagnosis: what was found, the network before and after, and the tables that a report shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pandas as pd
from pydantic import BaseModel

from data.machine import Machine
from diagnosis.findings.schema import Findings
from twin.calibration.identifiability import Interval
from twin.network import Network
from twin.schema import TwinPart

if TYPE_CHECKING:
    from diagnosis.search.search import Search


@dataclass(frozen=True)
class Diagnosis:
    """Everything that a report of a diagnosis consumes, and what its machine file and next run are written from.

    `part_before` is the refined and recalibrated baseline, `part_after` the same with what was found. `simulated`:
    the recordings come from a simulation. `drafted`: the machine file had no twin part. `remarks` say what was
    refined, what caps the confidence. `tables` holds every key of `COLUMNS`; any of them may be empty.

    For the machine file, as `diagnosed_text` takes them: `network` of `part_after`, fitted `values` and `intervals` of
    its free parameters, parts `added` by name or path, `notes` on them. `plan_text` is the next run as a run plan,
    None where there is none. `search` is how it came to that: all rounds and fits.
    """

    machine: Machine
    findings: Findings
    part_before: TwinPart
    part_after: TwinPart
    simulated: bool
    drafted: bool
    remarks: tuple[str, ...]
    tables: Mapping[str, pd.DataFrame]
    network: Network | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    intervals: tuple[Interval, ...] = ()
    added: Mapping[str, BaseModel] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    plan_text: str | None = None
    search: Search | None = field(default=None, repr=False, compare=False)
