"""The setting of a case before its concealed effects are drawn: recorder, shop, engineer; the same for every kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from thermodrift_exam.plants.options import stream
from thermodrift_exam.plants.structure import FEATURES

STATED: Mapping[str, float] = MappingProxyType({
    "feed": 0.6, "coolant": 0.6, "walls": 0.5, "layers": 0.5,
    "motor_loss": 0.6, "bending": 0.6, "growth": 0.6, "mandrel": 0.4,
})  # fmt: skip
"""Chance that the machine file states a feature."""
SWITCHES = ("mist", "conveyor", "lamp")
ALWAYS_STEP_S = 30.0  # the solver's


@dataclass(frozen=True)
class Ranges:
    """Limits of uniform draws, or the values to choose from."""

    batches: tuple[int, int]
    hours: tuple[float, ...]
    step_s: tuple[float, ...]
    noise_K: tuple[float, float]  # and noise_um by logarithm
    noise_um: tuple[float, float]
    quantisation_K: tuple[float, ...]
    missing: tuple[float, ...]
    early_s: tuple[float, ...]
    gaps: tuple[float, ...]
    absent: tuple[float, ...]
    file_error: tuple[float, float]
    mass_error: tuple[float, float]
    coldest_degC: tuple[float, float]
    season_K: tuple[float, float]
    earliest_h: tuple[float, float]
    day_h: tuple[float, float]
    spread: float


RANGES: Mapping[str, Ranges] = MappingProxyType({
    "development": Ranges(
        batches=(11, 13), hours=(5.0, 6.0), step_s=(240.0, 300.0, 300.0),
        noise_K=(0.02, 0.05), noise_um=(0.5, 1.2), quantisation_K=(0.05, 0.1, 0.1),
        missing=(0.0, 0.01), early_s=(0.0, 5.0, 15.0), gaps=(0.0, 0.3), absent=(0.0, 0.0, 0.05),
        file_error=(0.1, 0.3), mass_error=(0.05, 0.1),
        coldest_degC=(9.0, 15.0), season_K=(10.0, 18.0), earliest_h=(6.0, 8.0), day_h=(5.0, 8.0), spread=1.0,
    ),
    "sealed": Ranges(
        batches=(10, 13), hours=(4.5, 5.0, 6.0, 6.5), step_s=(240.0, 300.0, 300.0, 360.0),
        noise_K=(0.015, 0.06), noise_um=(0.4, 1.5), quantisation_K=(0.02, 0.05, 0.1, 0.1, 0.2),
        missing=(0.0, 0.01, 0.03), early_s=(0.0, 3.0, 10.0, 25.0), gaps=(0.0, 0.3, 0.7), absent=(0.0, 0.0, 0.08),
        file_error=(0.1, 0.4), mass_error=(0.03, 0.12),
        coldest_degC=(6.0, 17.0), season_K=(8.0, 20.0), earliest_h=(5.0, 9.0), day_h=(3.0, 10.0), spread=1.4,
    ),
})  # fmt: skip


def setting(seed: int, suite: str) -> dict[str, Any]:
    """Fields of `Options` for the case of a seed; `has` and `lacks` are what the machine file states and does not."""
    rng, r = stream(seed, "setting"), RANGES[suite]
    stated = [name for name, dice in zip(FEATURES, rng.random(len(FEATURES)), strict=True) if dice < STATED[name]]
    coldest_degC, earliest_h = rng.uniform(*r.coldest_degC), rng.uniform(*r.earliest_h)
    idle = [name for name in SWITCHES if rng.random() < 0.2]
    return {
        "name": f"m{rng.integers(16**8):08x}",
        "batches": int(rng.integers(r.batches[0], r.batches[1] + 1)),
        "hours": _one_of(rng, r.hours),
        "step_s": _one_of(rng, r.step_s),
        "noise_K": _by_logarithm(rng, r.noise_K),
        "noise_um": _by_logarithm(rng, r.noise_um),
        "quantisation_K": _one_of(rng, r.quantisation_K),
        "missing": _one_of(rng, r.missing),
        "early_s": _one_of(rng, r.early_s),
        "gaps": _one_of(rng, r.gaps),
        "absent": _one_of(rng, r.absent),
        "file_error": round(float(rng.uniform(*r.file_error)), 3),
        "mass_error": round(float(rng.uniform(*r.mass_error)), 3),
        "coldest_degC": round(float(coldest_degC), 1),
        "warmest_degC": round(float(coldest_degC + rng.uniform(*r.season_K)), 1),
        "earliest_h": round(float(earliest_h), 2),
        "latest_h": round(float(earliest_h + rng.uniform(*r.day_h)), 2),
        "idle": idle,
        "has": stated,
        "lacks": [name for name in FEATURES if name not in stated],
        "habit": "ordinary",
        "everyday": True,
        "spread": r.spread,
        "solver_s": ALWAYS_STEP_S,
    }


def _one_of(rng: np.random.Generator, values: tuple[float, ...]) -> float:
    return float(values[int(rng.integers(len(values)))])


def _by_logarithm(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    low, high = np.log(limits)
    return round(float(np.exp(rng.uniform(low, high))), 4)
