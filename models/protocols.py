"""Protocols that divide batches into training and test sets, and the promotion rule. Rows are never split."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from data.batch import Batch
from data.errors import InputError, closest
from features.rises import first_finite

_SEASON_BOUNDS_DEGC = (10.0, 18.0, 25.0)


@dataclass(frozen=True)
class Fold:
    """Indices of training and tested batches; `name` is what is left out (or, for train-on-one, trained on)."""

    name: str
    train: tuple[int, ...]
    test: tuple[int, ...]


def leave_batch_out(batches: Sequence[Batch]) -> list[Fold]:
    """K folds: fit on K − 1 batches, predict the one left out."""
    k = range(len(batches))
    return [Fold(batches[i].batch_id, tuple(j for j in k if j != i), (i,)) for i in k]


def train_on_one(batches: Sequence[Batch]) -> list[Fold]:
    """K folds: fit on one batch, predict every other (the year-round PCR study)."""
    return [Fold(f.name, f.test, f.train) for f in leave_batch_out(batches)]


def leave_season_out(batches: Sequence[Batch]) -> list[Fold]:
    """One fold per season, defined by the start ambient: below 10, 10–18, 18–25, above 25 °C."""
    return _leave_group_out([season(b) for b in batches])


def leave_speed_out(batches: Sequence[Batch]) -> list[Fold]:
    """One fold per spindle speed (batches of several speeds are a group of their own)."""
    return _leave_group_out([speed(b) for b in batches])


PROTOCOLS: dict[str, Callable[[Sequence[Batch]], list[Fold]]] = {
    "leave-batch-out": leave_batch_out,
    "train-on-one": train_on_one,
    "leave-season-out": leave_season_out,
    "leave-speed-out": leave_speed_out,
}


def folds_of(protocol: str, batches: Sequence[Batch]) -> list[Fold]:
    """The folds of a protocol; empty when there is only one group to leave out.

    Raises:
        InputError: fewer than 2 batches.
    """
    if len(batches) < 2:
        raise InputError(f"{protocol}: got {len(batches)} batch(es), need at least 2; ingest more recordings")
    folds = PROTOCOLS[protocol](batches)
    return folds if len(folds) > 1 else []


def start_ambient_degC(batch: Batch) -> float:
    """Ambient at the start; without an ambient channel the median of the temperatures' first samples."""
    names = batch.names("ambient") or batch.names("temperature")
    firsts = [first for name in names if np.isfinite(first := first_finite(batch.masked(name)))]
    return float(np.median(firsts)) if firsts else float("nan")


def season(batch: Batch) -> str:
    """The band of start ambient a batch belongs to."""
    ambient = start_ambient_degC(batch)
    low, mid, high = _SEASON_BOUNDS_DEGC
    if not np.isfinite(ambient):
        return "unknown"
    if ambient < low:
        return f"below {low:g} °C"
    if ambient < mid:
        return f"{low:g}–{mid:g} °C"
    return f"{mid:g}–{high:g} °C" if ambient < high else f"above {high:g} °C"


def speed(batch: Batch) -> str:
    """The spindle speed that holds for 80 % of the running time, else "several speeds"; "unknown" without a driver."""
    drivers = [n for n in batch.names("driver") if batch.channels[n].unit == "rpm"]
    if not drivers:
        return "unknown"
    rpm = batch.values(drivers[0])
    running = rpm[np.isfinite(rpm) & (rpm > 0)]
    if not len(running):
        return "0 rpm"
    values, counts = np.unique(running, return_counts=True)
    top = int(np.argmax(counts))
    return f"{values[top]:g} rpm" if counts[top] >= 0.8 * len(running) else "several speeds"


def _leave_group_out(labels: Sequence[str]) -> list[Fold]:
    """Groups in order of first appearance."""
    folds = []
    for label in dict.fromkeys(labels):
        test = tuple(i for i, got in enumerate(labels) if got == label)
        folds.append(Fold(label, tuple(i for i in range(len(labels)) if i not in test), test))
    return [f for f in folds if f.train]


class PromotionRule(BaseModel):
    """Which cell becomes the champion, and when a newcomer may replace one."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    protocol: str = "leave-batch-out"
    score: Literal["S_mean + S_std", "S_mean", "max_abs"] = "S_mean + S_std"
    min_tsp_stability: Annotated[float, Field(ge=0, le=1)] = 0.7
    tie_percent: Annotated[float, Field(ge=0, lt=100)] = 2.0
    significance: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    min_batches: Annotated[int, Field(ge=2)] = 5

    @field_validator("protocol")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in PROTOCOLS:
            raise ValueError(f"unknown protocol; {closest(value, PROTOCOLS)}")
        return value
