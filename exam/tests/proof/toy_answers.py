"""Diagnoses in no time, for the confined process of a demonstration; this folder alone is imported from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas as pd

from data.batch import Batch
from data.machine import Machine
from diagnosis.contracts import COLUMNS
from diagnosis.findings.schema import Finding, Findings, FitSummary, FittedParameter, LeftOutRms, Place
from diagnosis.result import Diagnosis
from twin.schema import twin_part

FLOOR = Finding(
    mechanism="floor_sink",
    where=Place(kind="node", name="bed"),
    parameters={"conductance": FittedParameter(value=22.0, unit="W/K", interval90=(18.0, 27.0))},
    probability=0.97,
    statement="Missing: heat to the floor at the bed.",
)
SUN = FLOOR.model_copy(update={"mechanism": "sun", "where": Place(kind="node", name="motor"), "parameters": {}})


def answer(machine: Machine, batches: Sequence[Batch], found: Sequence[Finding], *remarks: str) -> Diagnosis:
    """A diagnosis with these findings; z falls from 6 to 1 um where there are any."""
    after = 1.0 if found else 6.0
    rms = LeftOutRms(before={"z_um": 6.0}, after={"z_um": after}, noise_floor={"z_um": 0.8})
    findings = Findings(
        machine=machine.machine, batches=tuple(b.batch_id for b in batches), findings=tuple(found), seconds=0.1,
        verdict="explained" if found else "consistent", remarks=remarks, simulated=True,
        fit=FitSummary(left_out_rms=rms, batches_improved=len(batches) if found else 0, batches=len(batches)),
    )  # fmt: skip
    tables = {name: pd.DataFrame(columns=list(columns)) for name, columns in COLUMNS.items()}
    rows = [(b.batch_id, "z", "um", 70, 6.0, after, 0.8) for b in batches]
    tables["rms"] = pd.DataFrame(rows, columns=list(COLUMNS["rms"]))
    part = twin_part(machine)
    return Diagnosis(machine, findings, part, part, True, False, remarks, tables)


def floor(machine: Machine, batches: Sequence[Batch], **given: Any) -> Diagnosis:
    given["progress"]("refit", 3, 9)
    print("what a library prints is no progress")
    return answer(machine, batches, [FLOOR])


def silent(machine: Machine, batches: Sequence[Batch], **given: Any) -> Diagnosis:
    return answer(machine, batches, [])
