"""What a sensor costs that fails at the machine: micrometres per kelvin, and simulated faults that the guard misses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from compensation.substitutes import Guard, Substitutes, Watch
from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from features.rises import zeroed_error_um
from models.metrics import residual_std_um

BEGINS = 4  # a fault begins after this part of a run
LOOKS = 75  # of the guard in a run: every five minutes in one of six hours
COUNTS_SHARE = 0.1  # of the largest correction; a fault of less is within what a model leaves anyway
Predict = Callable[[Sequence[Batch]], list[Array]]  # error (n,) of every batch, µm


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


class Look(NamedTuple):
    """One look of the guard: its state after it, the sensors that it does not trust, what it adds to each value, and
    whether it gives up."""

    watch: Watch
    untrusted: frozenset[str]
    change_K: Array
    gave_up: bool


@dataclass(frozen=True)
class Watched:
    """A run as the guard saw it: its looks, so many rows apart, at the `given` values (looks, channels); by row the
    sensors that it does not trust, the batch with what it lets pass, and how many rows pass until it gives up. What
    comes after that is not watched where a sensor was found before."""

    looks: tuple[Look, ...]
    given: Array
    untrusted: tuple[frozenset[str], ...]
    passed: Batch
    until: int

    @property
    def first(self) -> int | None:
        """The first row with a sensor that is not trusted."""
        return next((k for k, names in enumerate(self.untrusted) if names), None)


def watched(guard: Guard, batch: Batch, names: Sequence[str], every: int = 1, like: Watched | None = None) -> Watched:
    """Lead a run through the guard, as at the machine.

    Args:
        every: rows from one look of the guard to the next; what it changes in one holds for the rows between.
        like: the same run with other values: as long as they are the same the looks are too.
    """
    columns = np.column_stack([batch.masked(n) for n in names])
    at = range(0, batch.n_rows, every)
    given = columns[at]
    looks = list[Look]() if like is None else list(like.looks[: _alike(given, like.given)])
    watch = looks[-1].watch if looks else guard.begin()
    for k in range(len(looks), len(at)):
        if looks and looks[-1].gave_up and any(look.untrusted for look in looks):
            break
        values = dict(zip(names, given[k].tolist(), strict=True))
        watch, checked = guard.step(watch, float(batch.time_s[at[k]]), values)
        untrusted = frozenset(n for n, s in checked.status.items() if s not in ("ok", "lost"))
        change_K = np.array([checked.values[n] for n in names]) - given[k]
        looks.append(Look(watch, untrusted, change_K, checked.fault is not None))
    of_row = np.minimum(np.arange(batch.n_rows) // every, len(looks) - 1)
    until = next((at[k] for k, look in enumerate(looks) if look.gave_up), batch.n_rows)
    passed = columns + np.array([look.change_K for look in looks])[of_row]
    table = dict(zip(names, passed.T, strict=True))
    return Watched(tuple(looks), given, tuple(looks[k].untrusted for k in of_row), with_values(batch, table), until)


def _alike(given: Array, other: Array) -> int:
    """How many rows are the same from the first on."""
    differ = ~((given == other) | (np.isnan(given) & np.isnan(other))).all(axis=1)
    return int(np.argmax(differ)) if differ.any() else len(given)


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
        return (
            f"{said}; {self.missed} of {self.n} simulated sensor faults are not detected, and the worst fault changes "
            f"the correction by {self.worst_um:.3g} µm ({self.worst})"
        )

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

    later = np.arange(batch.n_rows) >= batch.n_rows // BEGINS
    warmer = [with_values(batch, {n: batch.masked(n) + later}) for n in names]
    every = [(kind, at_fault, with_values(batch, columns)) for kind, at_fault, columns in faults(batch, names)]
    right_um, *given_um = predict([batch, *warmer, *(wrong for _, _, wrong in every)])
    sent_um = np.clip(right_um, -most_um, most_um)

    def wrong_um(predicted_um: Array, until: int) -> float:
        away_um = np.abs(np.clip(predicted_um, -most_um, most_um) - sent_um)
        return float(np.nanmax(away_um[:until], initial=0.0))

    um_per_K = {n: float(np.nanmax(np.abs(um - right_um))) for n, um in zip(names, given_um, strict=False)}
    matter = [
        fault
        for fault, um in zip(every, given_um[len(names) :], strict=True)
        if wrong_um(um, batch.n_rows) > COUNTS_SHARE * most_um
    ]
    guard, rows, guarded = Guard(substitutes), max(1, batch.n_rows // LOOKS), list(substitutes.names)
    usual = watched(guard, batch, guarded, rows)
    seen = [watched(guard, wrong, guarded, rows, usual) for _, _, wrong in matter]
    passed_um = predict([own.passed for own in seen]) if seen else []
    cost_um = [wrong_um(um, own.until) for um, own in zip(passed_um, seen, strict=True)]
    worst, worst_um = "", 0.0
    for (kind, at_fault, _), um in zip(matter, cost_um, strict=True):
        if um > worst_um:
            worst, worst_um = f"{' and '.join(sorted(at_fault))}: {kind}", um
    return FaultCost(um_per_K, len(matter), sum(own.first is None for own in seen), worst, worst_um)


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
    tried = np.unique(np.linspace(0, len(batches) - 1, _TRIED).round().astype(int))
    without = [with_values(batches[k], {n: learned[1 - k % 2].without(n, batches[k])}) for k in tried for n in names]
    left_um = iter(predict(without))
    saved_um: dict[str, list[float]] = {n: [] for n in names}
    for k in tried:
        error_um = zeroed_error_um(batches[k], target)
        for n in names:
            saved = residual_std_um(error_um) - residual_std_um(error_um - next(left_um))
            saved_um[n] += [saved] if np.isfinite(saved) else []
    return tuple(n for n, um in saved_um.items() if len(um) > 1 and np.mean(um) > np.std(um, ddof=1) / np.sqrt(len(um)))
