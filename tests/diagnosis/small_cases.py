"""Small machines that a diagnosis works on in a second: recordings with something that the machine file conceals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from data.batch import Batch
from data.machine import Machine
from diagnosis.fitting.fit import Fitted
from diagnosis.fitting.fitted import baseline
from tests.twin.machines import TWO_BODIES, machine
from tests.twin.recordings import drawn, empty_batches, recorded
from twin.compile import compile_network
from twin.schema import twin_part

FLOOR = {"law": "floor_sink", "at": {"body": "head", "room": "room"}, "into": "head"}
DRIFT = {"law": "sensor_drift", "acts_on": "t_head", "parameters": {"rate": "0.3 K/h"}}
SHIFT = {"law": "speed_shift", "acts_on": "z", "drivers": "rpm", "parameters": {"shift": "6 um"}}

FOUR_BODIES: dict[str, Any] = {
    "machine": "four_bodies",
    "simulated": True,
    "recording": {"step_s": 300},
    "channels": {
        **{f"t_{b}": {"role": "temperature", "unit": "degC", "resolution": 0.1} for b in ("spindle", "head", "bed")},
        "room": {"role": "ambient", "unit": "degC", "resolution": 0.1},
        "rpm": {"role": "driver", "unit": "rpm"},
        "feed": {"role": "driver", "unit": "mm/min"},
        "z": {"role": "error", "unit": "um", "resolution": 1},
    },
    "twin": {
        "surroundings": {"room": {"channel": "room"}},
        "bodies": {
            "spindle": {"capacity": {"value": "6 kJ/K", "spread": 0.2}, "material": "steel"},
            "head": {"capacity": {"value": "30 kJ/K", "spread": 0.2}, "material": "cast_iron"},
            "column": {"capacity": "60 kJ/K", "material": "cast_iron"},
            "bed": {"capacity": {"value": "90 kJ/K", "spread": 0.2}, "material": "cast_iron"},
        },
        "links": {
            "spindle-head": {"value": "15 W/K", "spread": 0.4},
            "head-column": {"value": "15 W/K", "spread": 0.4},
            "column-bed": {"value": "20 W/K", "spread": 0.4},
        },
        "exposures": {
            "spindle-room": "1 W/K",
            "head-room": {"value": "4 W/K", "spread": 0.4},
            "bed-room": {"value": "10 W/K", "spread": 0.4},
        },
        "mechanisms": {
            "friction": {"law": "bearing_viscous", "drivers": "rpm", "into": {"spindle": 0.5, "head": "rest"},
                         "parameters": {"lubrication": {"value": 1.5, "spread": 0.3}}},
            "load": {"law": "bearing_load", "drivers": "rpm", "into": {"spindle": 0.5, "head": "rest"}},
            "guides": {"law": "guide_friction", "drivers": "feed", "into": "column"},
        },
        "sensors": {
            "t_spindle": {"at": "spindle"},
            "t_head": {"at": "head", "air": "room", "lag": "60 s", "bonding": 0.9},
            "t_bed": {"at": "bed"},
        },
        "errors": {
            "z": {"chain": [{"body": "head", "length": "0.5 m"}, {"body": "column", "length": "0.5 m", "sign": -1}]},
        },
    },
}  # fmt: skip


def two_bodies(**changes: Any) -> Machine:
    return machine(TWO_BODIES, **changes)


def four_bodies(**changes: Any) -> Machine:
    return machine(FOUR_BODIES, **changes)


def equipped() -> Machine:
    """Four bodies with a channel of every kind that a law may be driven by."""
    more = {"travel": "mm", "power": "W", "coolant": "1", "current": "A", "voltage": "V"}
    own = {name: {"role": "position" if unit == "mm" else "driver", "unit": unit} for name, unit in more.items()}
    return machine({**FOUR_BODIES, "channels": {**FOUR_BODIES["channels"], **own}})


def driven(given: Machine, count: int = 3, hours: float = 3.0) -> list[Batch]:
    """Nothing measured yet; every driver steps at a time of its own."""
    out = []
    for k, b in enumerate(empty_batches(given, count, hours)):
        part = b.time_s / b.time_s[-1]
        table = b.table.copy()
        for n, (name, channel) in enumerate(c for c in given.channels.items() if c[1].role in ("driver", "position")):
            full = {"rpm": 4000.0, "mm/min": 6000.0, "mm": 300.0, "W": 2000.0}.get(channel.unit, 1.0)
            table[name] = full * (0.5 + 0.25 * k) * ((part > 0.05 + 0.05 * n) & (part < 0.5 + 0.05 * n))
        out.append(replace(b, table=table))
    return out


def runs(
    known: Machine, hidden: Mapping[str, Any] | None = None, count: int = 6, seed: int = 1, **changes: Any
) -> list[Batch]:
    """Recordings of the machine with these mechanisms beside its own and other values drawn from its priors."""
    own = {f"mechanisms__{k}": v for k, v in (hidden or {}).items()}
    truth = (two_bodies if known.machine == "two_bodies" else four_bodies)(**own, **changes)
    values = drawn(compile_network(known), np.random.default_rng(seed))
    network = compile_network(truth)
    by_name = dict(zip((p.name for p in compile_network(known).parameters), values, strict=True))
    every = np.array([by_name.get(p.name, p.value) for p in network.parameters])
    return recorded(truth, empty_batches(known, count), every, seed=seed)


def fitted(known: Machine, batches: list[Batch]) -> Fitted:
    """The machine file recalibrated, as a diagnosis begins."""
    return baseline(known, twin_part(known), batches)


@cache
def consistent() -> Fitted:
    """Two bodies, nothing concealed."""
    known = two_bodies()
    return fitted(known, runs(known))


@cache
def cold_floor() -> Fitted:
    """Two bodies; the head stands on a floor of which the file knows nothing: 8 W/K."""
    known = two_bodies()
    return fitted(known, runs(known, {"floor": {**FLOOR, "parameters": {"conductance": "8 W/K"}}}))
