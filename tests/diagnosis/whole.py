"""Whole diagnoses, once for all tests of a process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from data.batch import Batch
from data.machine import Machine
from diagnosis.diagnose import diagnose
from diagnosis.result import Diagnosis
from tests.diagnosis.small_cases import DRIFT, runs, two_bodies
from tests.twin.machines import TWO_BODIES, machine
from tests.twin.recordings import drawn, empty_batches, recorded
from twin.compile import compile_network

LAMP = {"law": "cabinet_heat", "into": "shaft", "parameters": {"heat": "100 W"}}
PUMP = {"law": "cabinet_heat", "into": "head", "drivers": "vacuum", "parameters": {"heat": "14 W"}}
PER_LEVEL_AND_KELVIN = {
    "law": "free_flux", "into": "head", "at": {"body": "head"}, "drivers": {"level": "vacuum"},
    "parameters": {"product": "6 W/K"},
}  # fmt: skip


def clamped(unit: str = "kPa", **changes: Any) -> Machine:
    """Two bodies with a vacuum chuck, of which no listed law knows anything; in unit 1 some switched ones do."""
    channels = {**TWO_BODIES["channels"], "vacuum": {"role": "driver", "unit": unit}}
    return machine({**TWO_BODIES, "channels": channels}, **changes)


def clamped_runs(hidden: dict[str, Any], count: int = 8, unit: str = "kPa", hours: float = 4.0) -> list[Batch]:
    truth = clamped(unit, **{f"mechanisms__{k}": v for k, v in hidden.items()})
    known, network = compile_network(clamped(unit)), compile_network(truth)
    values = dict(zip((p.name for p in known.parameters), drawn(known, np.random.default_rng(1)), strict=True))
    batches = []
    for k, b in enumerate(empty_batches(clamped(unit), count, hours)):
        first_s = 1200.0 + 1800.0 * (k % 4)
        on = (b.time_s >= first_s) & ((b.time_s - first_s) % 14400.0 < 4800.0)  # once in 4 h
        batches.append(replace(b, table=b.table.assign(vacuum=on.astype(float))))
    return recorded(truth, batches, np.array([values.get(p.name, p.value) for p in network.parameters]), seed=1)


CASES: dict[str, Callable[[], tuple[Machine, list[Batch]]]] = {
    "consistent": lambda: (two_bodies(), runs(two_bodies())),
    "explained": lambda: (two_bodies(), runs(two_bodies(), {"own": DRIFT}, count=8)),
    "undecidable": lambda: (clamped("1"), clamped_runs({"own": PUMP}, 1, "1", hours=10.0)),
    "unlisted": lambda: (clamped(), clamped_runs({"own": PER_LEVEL_AND_KELVIN})),
    "partly_explained": lambda: (clamped(), clamped_runs({"own": PER_LEVEL_AND_KELVIN, "lamp": LAMP})),
}


@cache
def diagnosed(verdict: str) -> Diagnosis:
    return diagnose(*CASES[verdict]())
