"""The cases of plant C by name: a real machine and the effects superposed on its recordings; none: the reference.

The real physics that the machine file lacks is unknown. Therefore a case has a reference, the same runs of the same
seed without a graft: a finding that occurs there too is not the graft.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from data.machine import Machine
from thermodrift_exam.plants.grafted.base import GRAFTS, Graft, Setting
from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.real import ORIGINS, RealCase, Term, answer, recorded, there, thinned

SIZES = (0.5, 5.0)  # log-uniform between
FINE_S = 60.0  # grafts use the finest rows of the recordings
DESCRIBED = "Real recordings on which a simulated response may be superposed."


@dataclass(frozen=True)
class Grafted:
    """Grafts by machine: heats first, faults of sensors last."""

    machine: str
    grafts: tuple[str, ...]
    reference: str

    @property
    def kind(self) -> str:
        if any(g.startswith("unlisted") for g in self.grafts):
            return "unlisted"
        return ("nothing", "one", "two", "three")[len(self.grafts)]


def _named(short: str, machine: str, *effects: str) -> dict[str, Grafted]:
    plain = f"{short}_plain"
    given = {f"{short}_{e}": tuple(e.split("+")) for e in effects}
    return {n: Grafted(machine, g, plain) for n, g in {plain: (), **given}.items()}


CASES: Mapping[str, Grafted] = MappingProxyType(
    _named(
        "lathe", "lathe_gv1203", "cabinet_heat", "hydraulic_unit", "floor_sink", "sun", "belt_loss", "draught",
        "unlisted_warm_speed", "time_skew", "sensor_drift", "sensor_lag", "sensor_bonding", "sensor_swap",
        "cabinet_heat+sensor_drift", "sun+sensor_lag",
    )
    | _named("spindle", "spindle_fl", "speed_shift", "time_skew", "sensor_drift", "sensor_lag", "sensor_swap")
)  # fmt: skip


def cases(data: Path) -> list[str]:
    """Names of all cases whose recordings lie in the folder `data`."""
    return [name for name, c in CASES.items() if there(c.machine, data)]


def build(name: str, data: Path, seed: int) -> RealCase:
    """A case; the seed draws runs, hours, the frame, the place and the size.

    The answer has two keys more than others: `reference`, the case of the same seed to subtract (None: this is one),
    and `graft`, the channels of the response and its largest value in each.

    Raises:
        InputError: an unknown name, no recordings in `data`; one line.
    """
    if name not in CASES:
        raise InputError(f"grafted: unknown case {name!r}; {closest(name, CASES)}")
    case = CASES[name]
    given, plain = recorded(case.machine, data, seed, FINE_S)
    machine = given.model_copy(update={"simulated": True, "description": DESCRIBED})
    batches = plain
    terms: list[Term] = []
    mapping: dict[str, str] = {}
    for key in case.grafts:
        size = float(np.exp(stream(seed, f"size {name} {key}").uniform(*np.log(SIZES))))
        graft: Graft = GRAFTS[key](Setting(machine, batches, seed), size, stream(seed, f"graft {name} {key}"))
        terms.append(graft.term())
        mapping |= graft.mapping()
        batches = [_with(b, graft.shown(k, b)) for k, b in enumerate(batches)]
    seen = [thinned(_rounded(replace(b, simulated=True)), ORIGINS[case.machine].rows_s) for b in batches]
    graft_key = {"channels": mapping, "largest": _largest(plain, batches, machine)} if terms else None
    whole = answer(
        {"plant": "grafted", "name": name, "seed": seed}, case.kind, machine, terms,
        f"{machine.machine}, real runs with {' and '.join(case.grafts) or 'nothing'} superposed",
        reference=None if name == case.reference else case.reference, graft=graft_key,
    )  # fmt: skip
    return RealCase(machine, seen, whole)


def _with(batch: Batch, channels: Mapping[str, Array]) -> Batch:
    return replace(batch, table=batch.table.assign(**channels))


def _rounded(batch: Batch) -> Batch:
    """As the instruments show it; + 0.0 turns a negative zero into zero."""
    steps = {n: c.resolution for n, c in batch.channels.items() if c.resolution}
    return _with(batch, {n: np.round(np.rint(batch.values(n) / r) * r + 0.0, 6) for n, r in steps.items()})


def _largest(plain: list[Batch], grafted: list[Batch], machine: Machine) -> dict[str, Any]:
    """By channel the largest change, in its unit; channels that keep their values are left out."""
    out = {}
    for channel in machine.names("temperature", "error"):
        changes = [np.abs(b.values(channel) - a.values(channel)) for a, b in zip(plain, grafted, strict=True)]
        largest = max(float(np.nanmax(c)) if np.isfinite(c).any() else 0.0 for c in changes)
        if largest > 0:
            out[channel] = round(largest, 4)
    return out
