"""Protocols that divide batches into training and test sets, and the promotion rule. Rows are never split."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Annotated, Literal, Self

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, field_validator

from data.batch import Batch
from data.errors import InputError, closest
from features.rises import first_finite

_SEASON_BOUNDS_DEGC = (10.0, 18.0, 25.0)
FORWARD_BLOCKS = 4  # fewer blocks of later runs say little about the next season
GAP_DAYS = 28.0  # `forward-gap`: a model that was trained a month ago, as between two retrainings
_LEAST_PAST = 2  # runs before the first block: one run has no other to choose hyper-parameters by


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
    """One fold per season, defined by the start ambient: below 10, 10–18, 18–25, above 25 °C; empty without dates."""
    return [] if any(b.start is None for b in batches) else _leave_group_out([season(b) for b in batches])


def leave_speed_out(batches: Sequence[Batch]) -> list[Fold]:
    """One fold per spindle speed (batches of several speeds are a group of their own)."""
    return _leave_group_out([speed(b) for b in batches])


def forward(batches: Sequence[Batch]) -> list[Fold]:
    """Blocks of later runs, each predicted by a model of all runs before it (an expanding window).

    The first half of the runs in order of time trains the first model; the others are cut into at least four blocks
    of equal length (the last may be shorter). Empty where the order in time is not known, see `forward_obstacle`.
    """
    return [] if forward_obstacle(batches) else _forward(batches, gap_days=0.0)


def forward_gap(batches: Sequence[Batch]) -> list[Fold]:
    """As `forward`, by a model of the runs that are at least four weeks older than the block; empty without dates."""
    known = all(b.start is not None for b in batches) and not forward_obstacle(batches)
    return _forward(batches, GAP_DAYS) if known else []


def _forward(batches: Sequence[Batch], gap_days: float) -> list[Fold]:
    order = in_time(batches)
    first = _first(len(order))
    length = (len(order) - first) // FORWARD_BLOCKS
    cuts = range(first, len(order), length)
    names = _block_names([[batches[k] for k in order[at : at + length]] for at in cuts])
    folds = []
    for at, name in zip(cuts, names, strict=True):
        block, past = order[at : at + length], order[:at]
        start = batches[block[0]].start
        if gap_days and start is not None:
            latest = start - pd.Timedelta(days=gap_days)
            past = [k for k in past if (then := batches[k].start) is not None and then <= latest]
        if len(past) >= _LEAST_PAST:
            folds.append(Fold(name, tuple(past), tuple(block)))
    return folds


def _first(runs: int) -> int:
    """How many of the runs train the first model."""
    return max(_LEAST_PAST, min(runs // 2, runs - FORWARD_BLOCKS))


def forward_obstacle(batches: Sequence[Batch]) -> str:
    """Why no later run can be predicted from earlier ones; empty where it can."""
    undated = [b.batch_id for b in batches if b.start is None and b.place is None]
    least = _LEAST_PAST + FORWARD_BLOCKS
    if undated and len({b.source for b in batches}) > 1:
        return (
            f"{len(undated)} of {len(batches)} batches have no start time (first: {undated[0]}); give their order in "
            "the machine file, as recording: {order: name} or a list of batches"
        )
    if len(batches) < least:
        return f"only {len(batches)} batches, need at least {least}"
    return ""


def in_time(batches: Sequence[Batch]) -> list[int]:
    """Indices in order of time: as stated, else by start; parts of one undated recording are in order as they come."""
    order = list(range(len(batches)))
    if all(b.place is not None for b in batches):
        return sorted(order, key=lambda k: batches[k].place or 0)
    if any(b.start is None for b in batches):
        return order
    return sorted(order, key=lambda k: (batches[k].start, batches[k].batch_id))


def placed(batches: Sequence[Batch], order: Literal["name"] | Sequence[str | int] | None) -> list[Batch]:
    """The batches with their places in the stated order; by name, numbers in an id count as numbers.

    Raises:
        InputError: a batch is not in the list, or is there twice.
    """
    if order is None:
        return list(batches)
    if order == "name":
        parts = {b.batch_id: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", b.batch_id)] for b in batches}
        ids = sorted(parts, key=lambda batch_id: parts[batch_id])
    else:
        ids = [str(i) for i in order]
    for b in batches:
        if ids.count(b.batch_id) != 1:
            what = "repeats" if b.batch_id in ids else "lacks"
            raise InputError(f"recording.order {what} {b.batch_id}; name each of the {len(batches)} batches once")
    return [replace(b, place=ids.index(b.batch_id)) for b in batches]


def _block_names(blocks: Sequence[Sequence[Batch]]) -> list[str]:
    """First and last day of every block; its batches where they are undated or two blocks share these days."""
    days = [" to ".join(dict.fromkeys(f"{b.start:%Y-%m-%d}" for b in (block[0], block[-1]) if b.start is not None))
            for block in blocks]  # fmt: skip
    if all(days) and len(set(days)) == len(days):
        return days
    return [" to ".join(dict.fromkeys(b.batch_id for b in (block[0], block[-1]))) for block in blocks]


PROTOCOLS: dict[str, Callable[[Sequence[Batch]], list[Fold]]] = {
    "forward": forward,
    "forward-gap": forward_gap,
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
    """Which cell becomes the champion, and when a newcomer may replace one.

    protocols: the protocols that judge, with what a run left out under them counts; those that the recordings do not
        allow are left out.
    group_runs: a left-out season or speed of so many runs counts half as it is and half as the mean of all runs
        (partial pooling), so that a group of two runs does not decide.
    record_runs: what the families reached on other machines (`models.RECORDS`) counts like so many runs of this one.
    ties_se: a simpler cell wins where it is behind by so many standard errors of the difference, or less.
    significance: one-sided level of the paired comparison with the champion and with no model.
    min_batches: fewer batches in common: the champion stays.
    fault_budget_um: the most that a simulated fault of a sensor may cost in spite of the guard, µm; a newcomer above it
        becomes neither champion nor provisional. None: it is stated alone.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    protocols: dict[str, Annotated[float, Field(gt=0)]] = Field(
        default={"forward": 1.0, "leave-season-out": 0.25, "leave-batch-out": 0.25}, min_length=1
    )
    group_runs: Annotated[float, Field(ge=0)] = 4.0
    record_runs: Annotated[float, Field(ge=0)] = 8.0
    ties_se: Annotated[float, Field(ge=0)] = 1.0
    significance: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    min_batches: Annotated[int, Field(ge=2)] = 5
    fault_budget_um: Annotated[float, Field(gt=0)] | None = None

    @field_validator("protocols")
    @classmethod
    def _known(cls, value: dict[str, float]) -> dict[str, float]:
        for name in value:
            if name not in PROTOCOLS:
                raise ValueError(f"unknown protocol; {closest(name, PROTOCOLS)}")
        return value

    def only(self, protocol: str) -> Self:
        """The same rule, judging by one protocol."""
        return self.model_copy(update={"protocols": {protocol: 1.0}})

    @property
    def least_tested(self) -> int:
        """Fewest left-out runs with which the paired comparison reaches `significance`, should all be better."""
        return max(self.min_batches, math.ceil(-math.log2(self.significance)))

    def few(self, runs: int, ordered: bool) -> str:
        """How many runs a champion needs and how many there are; empty where there are enough.

        Args:
            ordered: their order in time is known, so that only later runs are left out.
        """
        later = ordered and next(iter(self.protocols)) == "forward"
        needed = next(n for n in count(_LEAST_PAST) if n - later * _first(n) >= self.least_tested)
        there = f"there {'is' if runs == 1 else 'are'} {runs}"
        return f"a champion needs at least {needed} runs, {there}" if runs < needed else ""

    def offered(self, run: Collection[str]) -> list[str]:
        """The rule's protocols among those that were run."""
        return [p for p in self.protocols if p in run]
