"""A chain of five bodies, a heat, displacement or reading that its machine file does not know, and its recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.machine import Machine
from tests.twin.machines import machine
from tests.twin.recordings import drawn, empty_batches, recorded
from twin.calibration.least_squares import Fit, FitOptions, fit
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.network import Network
from twin.simulation.inputs import inputs_of

BODIES = ("spindle", "head", "column", "saddle", "bed")
SENSED = ("spindle", "head", "column", "bed")  # the saddle has no sensor
LINKS = ("spindle-head", "head-column", "column-saddle", "saddle-bed")
CAPACITY = dict(zip(BODIES, ("6 kJ/K", "30 kJ/K", "60 kJ/K", "20 kJ/K", "90 kJ/K"), strict=True))
EXPOSED = dict(zip(BODIES, ("1 W/K", "4 W/K", "8 W/K", "3 W/K", "10 W/K"), strict=True))


def _free(value: str, spread: float) -> dict[str, Any]:
    return {"value": value, "spread": spread}


CHAIN: dict[str, Any] = {
    "machine": "chain",
    "simulated": True,
    "recording": {"step_s": 300},
    "channels": {
        **{f"t_{b}": {"role": "temperature", "unit": "degC", "resolution": 0.1} for b in SENSED},
        "room": {"role": "ambient", "unit": "degC", "resolution": 0.1},
        "rpm": {"role": "driver", "unit": "rpm"},
        "coolant": {"role": "driver", "unit": "1"},
        "z": {"role": "error", "unit": "um", "resolution": 1},
        "y": {"role": "error", "unit": "um", "resolution": 1},
    },
    "twin": {
        "surroundings": {"room": {"channel": "room"}},
        "bodies": {b: {"capacity": _free(CAPACITY[b], 0.15), "material": "cast_iron"} for b in BODIES},
        "links": {k: _free("15 W/K", 0.4) for k in LINKS},
        "exposures": {f"{b}-room": _free(EXPOSED[b], 0.4) for b in BODIES},
        "mechanisms": {
            "belt": {"law": "belt_loss", "drivers": "rpm", "into": "spindle",
                     "parameters": {"power": "150 W"}},  # known: else heats and capacities only scale
        },
        "sensors": {f"t_{b}": {"at": b} for b in SENSED},
        "errors": {
            "z": {"chain": [{"body": "spindle", "length": "0.3 m"}, {"body": "head", "length": "0.4 m"},
                            {"body": "column", "length": "0.7 m", "sign": -1}]},
            "y": {"chain": [{"body": "head", "length": "0.5 m"}, {"body": "saddle", "length": "0.3 m"},
                            {"body": "bed", "length": "0.8 m", "sign": -1}]},
        },
    },
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """What the recordings hold and the calibrated network that does not know of it."""

    machine: Machine
    batches: list[Batch]
    problem: CalibrationProblem
    fit: Fit

    @staticmethod
    def problem_of(network: Network, batches: list[Batch], substeps: int = 1) -> CalibrationProblem:
        """With so many substeps."""
        problem = CalibrationProblem.of(network, batches)
        return replace(problem, inputs=inputs_of(network, batches, substeps))


def chain(**changes: Any) -> Machine:
    return machine(CHAIN, **changes)


def flux(body: str, driver: str | None = "coolant", other: str | None = None, **values: str) -> dict[str, Any]:
    """Heat into a body, of no listed mechanism."""
    drivers = {role: name for role, name in (("level", driver), ("other", other)) if name}
    return {"flux": {"law": "free_flux", "into": body, "at": {"body": body}, "parameters": values,
                     **({"drivers": drivers} if drivers else {})}}  # fmt: skip


def shift(error: str, body: str = "head", driver: str | None = "coolant", **values: str) -> dict[str, Any]:
    """Displacement of an error, of no listed mechanism."""
    return {"shift": {"law": "free_shift", "acts_on": error, "at": {"body": body}, "parameters": values,
                      **({"drivers": {"level": driver}} if driver else {})}}  # fmt: skip


def coolant(batch: Batch, k: int) -> Array:
    """On for an hour and a half or two hours, each batch at another time, and never with the spindle's own steps."""
    start_s, end_s = 2400.0 + 1500.0 * (k % 4), 8400.0 + 1200.0 * (k % 5)
    return ((batch.time_s >= start_s) & (batch.time_s < end_s)).astype(float)


def empty(count: int = 6, hours: float = 4.0) -> list[Batch]:
    out = []
    for k, b in enumerate(empty_batches(chain(), count, hours=hours)):
        room = 20.0 + 0.5 * (b.table["room"] - b.table["room"].iloc[0]) + 0.8 * (k % 5 - 2)
        out.append(replace(b, table=b.table.assign(coolant=coolant(b, k), room=room)))
    return out


def case(mechanisms: dict[str, Any] | None = None, count: int = 6, seed: int = 1) -> Case:
    """Recordings with these mechanisms beside the chain's own, the chain calibrated on them without."""
    known = chain()
    truth = machine(CHAIN, **{f"mechanisms__{k}": v for k, v in (mechanisms or {}).items()})
    values = drawn(compile_network(truth), np.random.default_rng(seed))
    return calibrated(known, recorded(truth, empty(count), values, seed=seed))


def calibrated(known: Machine, batches: list[Batch]) -> Case:
    problem = CalibrationProblem.of(compile_network(known), batches)
    return Case(known, batches, problem, fit(problem, FitOptions(tolerance=1e-3, reweight=True)))
