"""Small trainings for the tests of tracking and registry: batches that follow a known law, scores by hand."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np
import pandas as pd

from data.batch import Batch
from data.machine import parse_machine
from models.families.mlr import MLR
from models.selection.result import SCORES, GridResult
from models.selection.trust import Region

GAIN_UM_PER_K = (3.0, -1.5)

MACHINE_YAML = """
machine: {machine}
simulated: {simulated}
recording: {{step_s: 60}}
channels:
  front: {{role: temperature, unit: degC, resolution: 0.1, range: [0, 80]}}
  bed: {{role: temperature, unit: degC, resolution: 0.1, range: [0, 80]}}
  speed: {{role: driver, unit: rpm, range: [0, 8000]}}
  z: {{role: error, unit: um, resolution: 1, range: [-300, 300]}}
"""


def machine_yaml(machine: str, simulated: bool = True) -> str:
    return MACHINE_YAML.format(machine=machine, simulated=str(simulated).lower())


def toy_batches(machine: str, n: int) -> list[Batch]:
    """z = 3 µm/K · front − 1.5 µm/K · bed, exactly."""
    channels = parse_machine(machine_yaml(machine), "test").batch_channels()
    out = []
    for k in range(n):
        t = np.arange(0.0, 3600.0, 60.0)
        front = 20 + k + (8 + k) * (1 - np.exp(-t / 1200))
        bed = 20 + k + 2 * t / 3600 + 0.3 * np.sin(t / (500 + 50 * k))
        z = GAIN_UM_PER_K[0] * (front - front[0]) + GAIN_UM_PER_K[1] * (bed - bed[0])
        table = pd.DataFrame({"time_s": t, "front": front, "bed": bed, "speed": 4000.0, "z": z})
        digest = hashlib.sha256(f"{machine} {k}".encode()).hexdigest()
        out.append(Batch(machine, f"b{k:02d}", table, channels, simulated=True, source=f"b{k:02d}.csv", digest=digest))
    return out


def toy_model(batches: Sequence[Batch]) -> tuple[MLR, Region]:
    """A regression on both points, and its region."""
    return MLR().fit(batches, ("front", "bed"), "z"), Region.of(batches, ("front", "bed"))


def toy_result(batches: Sequence[Batch], S_um: dict[str, Sequence[float]], **stability: float) -> GridResult:
    """A leave-batch-out training whose left-out S per batch is given for every cell ``selector|family|n_tsp``."""
    ids = [b.batch_id for b in batches]
    cells, scores = [], []
    for label, values in S_um.items():
        selector, family, n = label.split("|")
        s = np.asarray(values, float)
        keys = {"protocol": "leave-batch-out", "selector": selector, "family": family, "n_tsp": int(n)}
        others = {name: 0.5 for name in SCORES if name != "S_um"}
        cells.append({
            **keys, "S_mean_um": s.mean(), "S_std_um": s.std(ddof=1), **others, "fit_S_um": 1.0, "n_batches": len(s),
            "n_parameters": int(n) + 1, "rank": {"zero": 0, "mlr": 10}.get(family, 20),
            "tsp_stability": stability.get(selector, 1.0), "inputs": "|".join(["front", "bed"][: int(n)]),
            "n_inputs": int(n), "simulated": True,
        })  # fmt: skip
        scores += [{**keys, "fold": b, "batch_id": b, "S_um": v, **others, "fit_S_um": 1.0, "n_rows": 60}
                   for b, v in zip(ids, s, strict=True)]  # fmt: skip
    time_s = np.concatenate([b.time_s for b in batches])
    return GridResult(
        machine=batches[0].machine,
        target="z",
        simulated=True,
        batches=pd.DataFrame([{"batch_id": b.batch_id, "start": "", "digest": b.digest, "version": 1,
                               "source": b.source, "simulated": True, "n_rows": b.n_rows} for b in batches]),
        scores=pd.DataFrame(scores),
        cells=pd.DataFrame(cells),
        subsets=pd.DataFrame([("leave-batch-out", "none", 2, i, "front|bed") for i in ids],
                             columns=["protocol", "selector", "n_tsp", "fold", "inputs"]),
        predictions=pd.DataFrame({"batch_id": np.repeat(ids, 60), "time_s": time_s,
                                  "recorded_um": np.concatenate([b.values("z") for b in batches])}),
        findings=pd.DataFrame(columns=["batch_id", "check", "channel"]),
        excluded=pd.DataFrame(columns=["channel", "reason"]),
    )  # fmt: skip
