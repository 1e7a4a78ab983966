"""What a sensor costs that fails at the machine: micrometres per kelvin, and simulated faults that the guard misses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compensation.substitutes import Guard, Substitutes
from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from features.rises import zeroed_error_um
from models.metrics import residual_std_um

BEGINS = 4  # a fault begins after this part of a run
LOOKS = 75  # of the guard in a run: every five minutes in one of six hours
COUNTS_SHARE = 0.1  # of the largest correction; a fault of less is within what a model leaves anyway
Predict = Callable[[Batch], Array]  # error (n,) of a batch, µm


def faults(batch: Batch, names: Sequence[str]) -> Iterator[tuple[str, set[str], dict[str, Array]]]:
    """Kind, the sensors at fault, and the values (n,) of these, of every sensor in turn.

    It freezes, steps by 5 K, drifts by 1 or 10 K/h, each from a quarter of the run on, and is exchanged with its
    neighbour in the list during the whole run.
    """
    first = batch.n_rows // BEGINS
    later = np.arange(batch.n_rows) >= first
    hours = np.maximum(batch.time_s - batch.time_s[first], 0.0) / 3600.0
    for name, other in zip(names, [*names[1:], names[0]], strict=True):
        v = batch.masked(name)
        yield "frozen", {name}, {name: np.where(later, v[first], v)}
        yield "a step of 5 K", {name}, {name: v + 5.0 * later}
        yield "a drift of 1 K/h", {name}, {name: v + hours}
        yield "a drift of 10 K/h", {name}, {name: v + 10.0 * hours}
        if other != name:
            yield "exchanged", {name, other}, {name: batch.masked(other), other: v}


@dataclass(frozen=True)
class Watched:
    """A run as the guard saw it: by row the sensors that it does not trust, the batch with what it lets pass, and how
    many rows pass until it gives up."""

    untrusted: tuple[frozenset[str], ...]
    passed: Batch
    until: int

    @property
    def first(self) -> int | None:
        """The first row with a sensor that is not trusted."""
        return next((k for k, names in enumerate(self.untrusted) if names), None)


def watched(guard: Guard, batch: Batch, names: Sequence[str], every: int = 1) -> Watched:
    """Lead a run through the guard, as at the machine.

    Args:
        every: rows from one look of the guard to the next; what it changes in one holds for the rows between.
    """
    watch, found, changed, until = guard.begin(), list[frozenset[str]](), list[list[float]](), batch.n_rows
    columns = {n: batch.masked(n) for n in names}
    for k in range(0, batch.n_rows, every):
        given = {n: float(columns[n][k]) for n in names}
        watch, checked = guard.step(watch, float(batch.time_s[k]), given)
        untrusted = frozenset(n for n, s in checked.status.items() if s not in ("ok", "lost"))
        held = min(every, batch.n_rows - k)
        found += [untrusted] * held
        changed += [[checked.values[n] - given[n] for n in names]] * held
        if checked.fault is not None:
            until = min(until, k)
    table = {n: columns[n] + change for n, change in zip(names, np.array(changed).T, strict=True)}
    return Watched(tuple(found), with_values(batch, table), until)


def with_values(batch: Batch, columns: Mapping[str, Array]) -> Batch:
    """The batch with other values (n,) of some channels, none of them masked."""
    return replace(batch, table=batch.table.assign(**columns), findings=())


@dataclass(frozen=True)
class FaultCost:
    """What sensors cost that fail, from simulated faults of one recorded run.

    Attributes:
        um_per_K: by sensor the largest change of the prediction where it reads 1 K more from a quarter of the run on.
        n: faults that change the prediction by more than `COUNTS_SHARE` of the largest correction.
        missed: of them those that the guard does not find.
        worst: the fault that is dearest in spite of the guard.
        worst_um: the largest wrong correction that is sent during it, µm.
    """

    um_per_K: Mapping[str, float]
    n: int
    missed: int
    worst: str
    worst_um: float

    @property
    def summary(self) -> str:
        """One sentence."""
        dearest = max(self.um_per_K, key=lambda name: self.um_per_K[name])
        said = f"a sensor that is wrong by 1 K costs up to {self.um_per_K[dearest]:.2g} µm ({dearest})"
        if not self.n:
            return f"{said}; no simulated fault of a sensor matters"
        return f"{said}; the guard misses {self.missed} of {self.n} simulated faults, the dearest costs " \
               f"{self.worst_um:.3g} µm ({self.worst})"  # fmt: skip

    def as_plain(self) -> dict[str, Any]:
        return {**self.__dict__, "um_per_K": dict(self.um_per_K), "summary": self.summary}


def fault_cost(predict: Predict, substitutes: Substitutes, batch: Batch, most_um: float) -> FaultCost | None:
    """Simulate every fault of every sensor of a model in a recorded run.

    Args:
        batch: a run of the training; the guard has learned from it too, so that it finds rather more than at the
            machine.
        most_um: the largest correction that is sent; predictions beyond it cost no more.

    Returns:
        None for a model without a sensor, or a run without a value of one.
    """
    names = [n for n in substitutes.names if batch.channels[n].unit == "degC" and np.isfinite(batch.masked(n)).all()]
    if not names or batch.n_rows < BEGINS:
        return None

    right_um, later = predict(batch), np.arange(batch.n_rows) >= batch.n_rows // BEGINS
    sent_um = np.clip(right_um, -most_um, most_um)

    def wrong_um(b: Batch, until: int) -> float:
        return float(np.nanmax(np.abs(np.clip(predict(b), -most_um, most_um) - sent_um)[:until], initial=0.0))

    um_per_K = {
        n: float(np.nanmax(np.abs(predict(with_values(batch, {n: batch.masked(n) + later})) - right_um))) for n in names
    }
    guard, n, missed, worst, worst_um = Guard(substitutes), 0, 0, "", 0.0
    every = max(1, batch.n_rows // LOOKS)
    for kind, at_fault, columns in faults(batch, names):
        wrong = with_values(batch, columns)
        if wrong_um(wrong, batch.n_rows) <= COUNTS_SHARE * most_um:
            continue
        seen = watched(guard, wrong, list(substitutes.names), every)
        cost_um = wrong_um(seen.passed, seen.until)
        n, missed = n + 1, missed + (seen.first is None)
        if cost_um > worst_um:
            worst, worst_um = f"{' and '.join(sorted(at_fault))}: {kind}", cost_um
    return FaultCost(um_per_K, n, missed, worst, worst_um)


_TRIED = 8  # runs, evenly spaced: the saving is far larger than its spread
_HALF = 2  # runs at least, from which the substitutes of the other half's are learned


def bridged(predict: Predict, target: str, batches: Sequence[Batch], names: Sequence[str]) -> tuple[str, ...]:
    """Sensors that may be replaced for a whole run: a model without one still leaves less error than no correction.

    Each in turn is taken out of training runs and replaced by what the runs of the other half show. It is one of them
    where the mean saving in S, against sending nothing, is above its standard error.

    Args:
        batches: runs of the training.
        names: the guarded sensors.
    """
    halves = [list(batches[k::2]) for k in (0, 1)]
    if min(map(len, halves)) < _HALF:
        return ()
    try:
        learned = [Substitutes.learn(half, names) for half in halves]
    except InputError:  # too few runs in which all are recorded
        return ()
    saved_um: dict[str, list[float]] = {n: [] for n in names}
    for k in np.unique(np.linspace(0, len(batches) - 1, _TRIED).round().astype(int)):
        batch, other = batches[k], learned[1 - k % 2]
        error_um = zeroed_error_um(batch, target)
        for n in names:
            left_um = error_um - predict(with_values(batch, {n: other.without(n, batch)}))
            saved = residual_std_um(error_um) - residual_std_um(left_um)
            saved_um[n] += [saved] if np.isfinite(saved) else []
    return tuple(n for n, um in saved_um.items() if len(um) > 1 and np.mean(um) > np.std(um, ddof=1) / np.sqrt(len(um)))
