"""Swapped labels of two sensors: how much better one linear step from the machine file fits with the labels exchanged.

A fit adapts to wrong labels; before it they are plainly wrong. A machine file whose values are far off is wrong
everywhere, so each pair is judged after one linear step with its labels exchanged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from data.arrays import Array
from diagnosis.contracts import Candidate, CandidateKind
from diagnosis.fitting.fit import Fitted
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import x_of
from twin.calibration.problem import Measured


def suspected_swaps(fitted: Fitted, proposed: Sequence[Candidate]) -> list[Candidate]:
    """Candidates that exchange the labels of two sensors and fit better so, the best first.

    Labels are judged before physics: none are returned where the fit holds an effect that the machine file lacks.
    """
    stated = (fitted.machine.twin or {"mechanisms": fitted.part.mechanisms}).get("mechanisms") or {}
    if set(fitted.part.mechanisms) - set(stated):
        return []
    line = _Line.at(fitted)
    out = []
    for c in proposed:
        if c.kind is CandidateKind.SENSOR_SWAP:
            assert c.part is not None and c.part.acts_on is not None
            one, other = (fitted.problem.channels.index(name) for name in c.part.acts_on)
            out.append((line.gain(one, other), c))
    return [c for gain, c in sorted(out, key=lambda q: -q[0]) if gain > POLICY.label_swap_min_gain_nats][
        : POLICY.label_swaps
    ]


@dataclass(frozen=True)
class _Channel:
    """A batch's rows of one channel: `squares` of the residual, `slope` (u,) and `gram` (u, u) of the unknowns."""

    rows: int
    squares: float
    slope: Array
    gram: Array

    @classmethod
    def of(cls, columns: Array, residual: Array) -> _Channel:
        return cls(len(residual), float(residual @ residual), columns.T @ residual, columns.T @ columns)


@dataclass(frozen=True)
class _Line:
    """The problem linearised at the machine file's values: of every batch columns (n_b, u) and residuals (n_b,), and
    the `numbers` (u,) that its unknowns, the fit's own and the batch's, have among all `size`."""

    measured: tuple[Measured, ...]
    noise: Array
    size: int
    columns: list[Array]
    residuals: list[Array]
    numbers: list[NDArray[np.int64]]
    as_named: list[list[_Channel]]  # by batch and channel

    @classmethod
    def at(cls, fitted: Fitted) -> _Line:
        problem = fitted.problem
        x = x_of(problem.unknowns, np.zeros(len(problem.unknowns)))
        spread = np.array([u.spread for u in problem.unknowns])
        columns, residuals, numbers = [], [], []
        size = len(spread)
        for block in problem.linearise(x, [np.zeros(q) for q in problem.nuisance_sizes]):
            q = block.nuisance.shape[1]
            columns.append(np.hstack([block.jacobian * spread, block.nuisance]))
            residuals.append(block.residual)
            numbers.append(np.concatenate([np.arange(len(spread)), size + np.arange(q)]))
            size += q
        as_named = [
            [_Channel.of(j[m.channel == k], r[m.channel == k]) for k in range(len(problem.channels))]
            for m, j, r in zip(problem.measured, columns, residuals, strict=True)
        ]
        return cls(problem.measured, problem.noise, size, columns, residuals, numbers, as_named)

    def gain(self, one: int, other: int) -> float:
        """Nats by which two channels named the other way round fit better; both are compared at their common rows,
        unless all rows as they are fit better anyway."""
        named, exchanged = [list(b) for b in self.as_named], [list(b) for b in self.as_named]
        for b, pieces in enumerate(self._common(one, other)):
            for k, columns, right, wrong in pieces:
                named[b][k] = _Channel.of(columns, right)
                exchanged[b][k] = _Channel.of(columns, wrong)
        cost = self._cost(exchanged)
        gain = self.cost_as_named - cost
        return gain if gain < 0 else self._cost(named) - cost

    @cached_property
    def cost_as_named(self) -> float:
        return self._cost(self.as_named)

    def _common(self, one: int, other: int) -> Iterator[list[tuple[int, Array, Array, Array]]]:
        """Of every batch, for both channels: number, columns, and residuals as named and exchanged."""
        for m, r, j in zip(self.measured, self.residuals, self.columns, strict=True):
            a, c = np.flatnonzero(m.channel == one), np.flatnonzero(m.channel == other)
            _, first, second = np.intersect1d(m.row[a], m.row[c], assume_unique=True, return_indices=True)
            a, c = a[first], c[second]
            difference = m.value[c] - m.value[a]
            yield [
                (one, j[a], r[a], r[a] + difference / self.noise[one]),
                (other, j[c], r[c], r[c] - difference / self.noise[other]),
            ]

    def _cost(self, batches: Sequence[Sequence[_Channel]]) -> float:
        """Half of what is left of rows and priors after a linear step, in nats, each channel in units of its rest."""
        rows = np.array([[c.rows for c in b] for b in batches]).sum(axis=0)
        grams = [np.stack([c.gram for c in b]) for b in batches]
        slopes = [np.stack([c.slope for c in b]) for b in batches]
        squares = np.array([[c.squares for c in b] for b in batches]).sum(axis=0)
        weight = np.full(len(rows), 1.0 / (POLICY.initial_noise_factor**2 * POLICY.initial_rows_per_value))
        for _ in range(POLICY.label_swap_reweighting_rounds):
            gram, slope = np.eye(self.size), np.zeros(self.size)
            for at, g, s in zip(self.numbers, grams, slopes, strict=True):
                gram[np.ix_(at, at)] += np.tensordot(weight, g, 1)
                slope[at] += weight @ s
            step = cho_solve(cho_factor(gram), slope)
            left = squares.copy()
            for at, g, s in zip(self.numbers, grams, slopes, strict=True):
                left += (g @ step[at] - 2 * s) @ step[at]
            rest = np.maximum(left / np.maximum(rows, 1), 1.0)
            weight = 1.0 / (rest * POLICY.initial_rows_per_value)
        return 0.5 * float((rows / POLICY.initial_rows_per_value) @ np.log(rest) + step @ step)
