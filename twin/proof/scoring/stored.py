"""What a run of the proof stored for one case, with what scoring needs of the case itself."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from twin.diagnosis.telling.findings import Findings, read_findings

AGAIN = "again.json"  # findings with the proposed run beside the others


@dataclass(frozen=True)
class Stored:
    """An answer. `findings` None: the diagnosis failed; `again` is the diagnosis once the proposed run was executed.

    `length_s` of every batch and `body_of` every sensor are the case's own.
    """

    findings: Findings | None
    run: Mapping[str, Any] = field(default_factory=dict)
    rivals: Mapping[str, Any] | None = None
    length_s: Mapping[str, float] = field(default_factory=dict)
    body_of: Mapping[str, str] = field(default_factory=dict)
    again: Findings | None = None

    @property
    def seconds(self) -> float | None:
        """Wall time of the diagnosis; of one that did not end, the time that it was given."""
        told = self.run.get("seconds")
        if told is None and self.failed and self.run.get("started") and self.run.get("ended"):
            return (pd.Timestamp(self.run["ended"]) - pd.Timestamp(self.run["started"])).total_seconds()
        return told

    @property
    def failed(self) -> bool:
        return self.findings is None or bool(self.run.get("error"))


def read_stored(folder: Path, machine: Machine, batches: Sequence[Batch]) -> Stored:
    """The folder of one case's answers: `run.json` and, where there are any, findings, rivals and `again.json`.

    Raises:
        InputError: a file that cannot be read.
    """
    findings, again = folder / "findings.json", folder / AGAIN
    return Stored(
        read_findings(findings) if findings.exists() else None,
        _read(folder / "run.json"),
        _read(folder / "rivals.json") if (folder / "rivals.json").exists() else None,
        lengths_s(batches),
        bodies_of_sensors(machine),
        read_findings(again) if again.exists() else None,
    )


def lengths_s(batches: Sequence[Batch]) -> dict[str, float]:
    """Seconds from each batch's first row to its last."""
    return {b.batch_id: float(b.time_s[-1] - b.time_s[0]) for b in batches}


def bodies_of_sensors(machine: Machine) -> dict[str, str]:
    """The body that each sensor of the machine file sits at; empty where the file has no twin part."""
    sensors = (machine.twin or {}).get("sensors", {})
    return {name: str(given["at"]).partition("@")[0] for name, given in sensors.items() if "at" in given}


def _read(path: Path) -> dict[str, Any]:
    try:
        out: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"answer {path}: cannot be read ({error}); run the case again") from None
    return out
