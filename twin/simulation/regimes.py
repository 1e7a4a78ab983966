"""Regimes: stretches in which every conductance is constant, found from the drivers of the network's factor laws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.mechanisms.base import View
from twin.network import Law, Network
from twin.simulation.inputs import Inputs
from twin.simulation.law_calls import parameters_of, reads_time

Array = NDArray[np.float64]

MOST = 64  # distinct driver values; beyond it a driver is a noisy continuous one
_DIGITS = 9  # to which driver values are told apart, relative to the largest


@dataclass(frozen=True)
class Regimes:
    """`of` (B, M) numbers each interval's regime; `factor` (P, R, n_factors) are the factor laws' values there.

    Factors whose drivers take too many values, or that follow the clock, are `varying`: one constant stands for them
    (half way between their extremes) and the rest of them is heat that depends on temperature.
    """

    of: NDArray[np.int64]
    factor: Array
    varying: tuple[int, ...]

    @property
    def count(self) -> int:
        return self.factor.shape[1]


def regimes_of(network: Network, values: Array, inputs: Inputs) -> Regimes:
    """The regimes of B batches at parameter values (P, n)."""
    fixed: list[int] = []
    number, first = distinct(inputs, ())
    for k, law in enumerate(network.factors):
        if law.asleep or reads_time(law, "factor"):
            continue
        channels = [c for j in (*fixed, k) for c in network.factors[j].drivers.values()]
        finer, at = distinct(inputs, channels)
        if len(at) <= MOST:
            fixed, number, first = [*fixed, k], finer, at
    varying = tuple(k for k, law in enumerate(network.factors) if k not in fixed and not law.asleep)
    factor = np.ones((len(values), len(first), len(network.factors)))
    for k in fixed:
        factor[..., k] = at_tuples(network.factors[k], "factor", values, inputs, first)
    for k in varying:
        seen = factor_series(network.factors[k], values, inputs)
        valid = inputs.valid
        low = np.where(valid, seen, np.inf).min(axis=(1, 2))
        high = np.where(valid, seen, -np.inf).max(axis=(1, 2))
        factor[..., k] = ((low + high) / 2)[:, None]
    return Regimes(number, factor, varying)


def distinct(
    inputs: Inputs, channels: Sequence[str], also: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Distinct tuples of driver values: each interval's number (B, M), and each tuple's first interval, flattened.

    `also` (B, M) are regimes that tell tuples apart. Only valid intervals count; padding gets number 0.
    """
    names = tuple(dict.fromkeys(channels))
    key = ("distinct", names, id(also))
    if key not in inputs.kept:
        series = [inputs.drivers[n] for n in names] + ([] if also is None else [also.astype(float)])
        inputs.kept[key] = (*_distinct(inputs.valid, series), also)  # keeping `also` keeps its id its own
    number, first, _ = inputs.kept[key]
    return number, first


def _distinct(valid: NDArray[np.bool_], given: Sequence[Array]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    at = np.flatnonzero(valid)
    series = [v.ravel()[at] for v in given]
    changes = np.zeros(len(at), bool)
    changes[:1] = True
    for values in series:
        changes[1:] |= values[1:] != values[:-1]
    first = np.flatnonzero(changes)  # drivers hold for long: sorting what changes is enough
    tuples = np.zeros((len(first), len(series)))
    for k, values in enumerate(series):
        tuples[:, k] = np.round(values[first] / (np.abs(values).max(initial=0.0) or 1.0), _DIGITS)
    _, where, of_run = np.unique(tuples, axis=0, return_index=True, return_inverse=True)
    number = np.zeros(valid.size, np.int64)
    number[at] = np.repeat(of_run.ravel(), np.diff(np.append(first, len(at))))
    return number.reshape(valid.shape), at[first[where]]


def at_tuples(law: Law, effect: str, values: Array, inputs: Inputs, first: NDArray[np.int64]) -> Array:
    """A law's value (P, U) in the intervals numbered `first` (U,), of all batches' flattened."""
    view = View(driver={role: inputs.drivers[c].ravel()[first] for role, c in law.drivers.items()})
    out = getattr(law.mechanism, effect)(view, parameters_of(law, values, 1))
    return np.broadcast_to(out, (len(values), len(first)))


def factor_series(law: Law, values: Array, inputs: Inputs) -> Array:
    """A conductance factor (P, B, M) in every interval, by its start."""
    along = law.mechanism.along_time
    out = law.mechanism.factor(inputs.intervals.view(law, along), parameters_of(law, values, 2 if along else 3))
    if not along and np.ndim(out) > 1:
        out = out[..., 0, :]
    return np.broadcast_to(out, (len(values), *inputs.valid.shape))
