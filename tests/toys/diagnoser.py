"""A diagnosis that is made up in no time, for a machine like the sample one: what the command does with it is real."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from data.batch import Batch
from data.machine import Machine
from diagnosis.result import Diagnosis
from tests.toys.diagnosis import SAMPLE, toy_diagnosis
from twin.calibration.identifiability import Interval
from twin.quantity import Value
from twin.schema import MechanismPart

SINK = MechanismPart(
    law="floor_sink",
    at="bed",
    parameters={"conductance": Value(value=8.0, spread=0.7), "temperature": Value(value=18.0, spread=4.0)},
)
VALUES = {"mechanisms.floor_sink_bed.conductance": 10.2, "mechanisms.floor_sink_bed.temperature": 17.6}
PLAN = "# the next run\nname: night stop\nstages:\n  - {hours: 3, drivers: {spindle_rpm: 4000}}\n"
NOTE = "Found by a diagnosis: probability 0.97"


@dataclass
class Toy:
    """Called as `diagnosis.diagnose.diagnose` is; `calls` keeps what it was given."""

    verdict: str = "explained"
    change: Callable[[Diagnosis], Diagnosis] = lambda d: d
    calls: list[dict[str, Any]] = field(default_factory=list)

    def __call__(self, machine: Machine, batches: Sequence[Batch], **given: Any) -> Diagnosis:
        self.calls.append({"machine": machine.machine, "batches": [b.batch_id for b in batches], **given})
        given["progress"]("baseline", 0, 0)
        given["progress"]("baseline", 0, 0)
        given["progress"]("refit", 3, 8)
        d = toy_diagnosis(self.verdict)
        named = {"machine": machine.machine, "batches": tuple(b.batch_id for b in batches)}
        d = replace(d, machine=machine, findings=d.findings.model_copy(update=named), drafted=machine.twin is None)
        if self.verdict == "explained":
            intervals = tuple(Interval(n, "", v, 0.9 * v, 1.1 * v, 0.3) for n, v in VALUES.items())
            added = {"floor_sink_bed": SINK}
            d = replace(d, values=VALUES, intervals=intervals, added=added, notes={"floor_sink_bed": NOTE})
        if self.verdict == "undecidable":
            d = replace(d, plan_text=PLAN)
        return self.change(d)


def write_machine(path: Path, name: str, twin: bool = True) -> Path:
    """The sample machine's file under another name."""
    text = SAMPLE.read_text(encoding="utf-8").replace("machine: sample_vmc", f"machine: {name}")
    path.write_text(text if twin else text[: text.index("# The physics.")], encoding="utf-8")
    return path


def write_recordings(folder: Path, count: int = 3) -> Path:
    """An hour each, in which every temperature and displacement moves."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for k in range(count):
        time = pd.Timestamp(f"2025-0{k + 1}-14 08:00:00") + pd.to_timedelta(np.arange(0, 3601, 300), "s")
        table = pd.DataFrame({"timestamp": time.strftime("%Y-%m-%d %H:%M:%S")})
        for name in ("front", "rear", "motor", "head_front", "head_rear", "screw", "column_front", "column_back",
                     "bed", "room"):  # fmt: skip
            table[name] = (20 + 0.1 * np.arange(13) + 0.3 * rng.standard_normal(13)).round(1)
        table["spindle_rpm"] = 4000
        for name in ("x", "y", "z"):
            table[name] = np.round(np.arange(13) + rng.standard_normal(13))
        table.to_csv(folder / f"b{k}.csv", index=False)
    return folder
