"""What a twin cannot do whatever its values: a part that warms or cools though nothing can bring or take the heat.

Without a heat of its own a part of a thermal network is never warmer than the warmest of its start and of the
surroundings that it is exposed to so far, nor colder than the coldest: the maximum principle (Protter and Weinberger
1967, Maximum Principles in Differential Equations, ch. 3). A recording that contradicts it needs a path that the
machine file lacks, and no statistics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from data.arrays import Array
from diagnosis.fitting.fit import Fitted
from diagnosis.policy import POLICY
from twin.calibration.fit_problem import x_of
from twin.simulation import Simulation, simulate


@dataclass(frozen=True)
class Impossible:
    """A sensor that left what its part can reach without heat.

    `bodies` are all that conduction connects with it, `to_s` the time in the batch until which no heat entered them,
    `excess_K` how far the channel was at most beyond what they can reach (negative: below), `watts` the mean heat that
    this takes by the machine file's own values: fitted ones imitate the heat that is missing.
    """

    channel: str
    bodies: tuple[str, ...]
    batch: str
    to_s: float
    excess_K: float
    watts: float

    @property
    def words(self) -> str:
        """As a sentence, without a full stop."""
        moves = "warms" if self.excess_K > 0 else "cools"
        return (
            f"{self.channel} {moves} by {abs(self.excess_K):.2g} K more than it can in run {self.batch} within the "
            f"first {self.to_s:.3g} s, while nothing of the machine file brings {' and '.join(self.bodies)} any heat; "
            f"it takes about {abs(self.watts):.2g} W"
        )


@lru_cache(maxsize=8)
def impossible(fitted: Fitted) -> tuple[Impossible, ...]:
    """Of every channel the clearest instance, the largest excess first."""
    problem = fitted.problem
    network, values = problem.network, fitted.values
    stated = problem.values_at(x_of(problem.unknowns, np.zeros(len(problem.unknowns))))
    first = [np.zeros(q) for q in problem.nuisance_sizes]  # as the first readings: a start may hide what cannot be
    run = simulate(network, values, *problem.inputs_at(first), keep_cells=True)
    seen = np.sum([r.cells for r in network.readings], axis=0) if network.readings else np.zeros(network.n_cells)
    unknown_K = np.where(seen > 0, 0.0, POLICY.unseen_start_sd * network.start_spread_K)
    found: dict[str, Impossible] = {}
    for cells in _parts(network.conductance_W_per_K(values)):
        exposed = network.surrounding_W_per_K(stated)
        reach = _Reach.of(run, cells, exposed, _driven(run, values, cells), unknown_K[cells])
        bodies = tuple(name for name, own in network.bodies.items() if set(own) <= set(cells.tolist()))
        capacity = float(network.capacity_J_per_K(stated)[cells].sum())
        for reading in network.readings:
            of_place = all(law.disabled or law.mechanism.along_time for law in reading.effects)  # and its past
            if of_place and np.isin(np.flatnonzero(reading.cells), cells).all():
                for k, to_s, excess_K in _excesses(fitted, run, reach, reading.channel):
                    watts = excess_K * (capacity / to_s + reach.loss_W_per_K / 2.0)
                    one = Impossible(reading.channel, bodies, run.batch_ids[k], to_s, excess_K, watts)
                    found[reading.channel] = max(found.get(reading.channel, one), one, key=lambda i: abs(i.excess_K))
    return tuple(sorted(found.values(), key=lambda i: -abs(i.excess_K)))


@dataclass(frozen=True)
class _Reach:
    """Of one part: lowest and highest temperature that it can have (B, K), rows (B, K) before any heat entered, and
    what it loses to its surroundings."""

    low_degC: Array
    high_degC: Array
    passive: NDArray[np.bool_]
    loss_W_per_K: float

    @classmethod
    def of(
        cls, run: Simulation, cells: NDArray[np.int64], exposed: Array, driven: NDArray[np.bool_], unknown_K: Array
    ) -> _Reach:
        assert run.cells_degC is not None and run.air_degC is not None
        around = np.flatnonzero(exposed[:, cells].any(axis=1))
        start = np.broadcast_to(run.cells_degC[0][:, :1][..., cells], (*driven.shape, len(cells)))
        air = run.air_degC[0][..., around]
        coldest = np.concatenate([start - unknown_K, air], axis=-1).min(axis=-1)
        warmest = np.concatenate([start + unknown_K, air], axis=-1).max(axis=-1)
        low, high = np.minimum.accumulate(coldest, axis=1), np.maximum.accumulate(warmest, axis=1)
        passive = ~np.logical_or.accumulate(driven, axis=1) & run.valid
        return cls(low, high, passive, float(exposed[:, cells].sum()))


def _parts(conductance: Array) -> Iterator[NDArray[np.int64]]:
    """Cells that conduction connects."""
    n, part = connected_components(conductance != 0.0, directed=False)
    for k in range(n):
        yield np.flatnonzero(part == k)


def _driven(run: Simulation, values: Array, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Rows (B, K) at which a heat enters or leaves these cells."""
    own = [run.heat_W[h.law.name][0] != 0.0 for h in run.network.heats if h.direction(values)[cells].any()]
    return np.logical_or.reduce(own, axis=0) if own else np.zeros(run.time_s.shape, bool)


def _excesses(fitted: Fitted, run: Simulation, reach: _Reach, channel: str) -> Iterator[tuple[int, float, float]]:
    """Batch, time of the last passive row, and excess of the batches in which there is one."""
    c = fitted.problem.channels.index(channel)
    least_K = POLICY.impossible_min_noises * fitted.problem.noise[c]
    for k, m in enumerate(fitted.problem.measured):
        own = m.channel == c
        time_s, value = fitted.batches[k].time_s[m.row[own]], m.value[own]
        ends = run.time_s[k][reach.passive[k]]
        if not len(ends) or ends[-1] <= 0.0:
            continue
        use = time_s <= ends[-1]
        low, high = (np.interp(time_s[use], run.time_s[k], side[k]) for side in (reach.low_degC, reach.high_degC))
        beyond = np.maximum(value[use] - high, 0.0) - np.maximum(low - value[use], 0.0)
        for sign in (1.0, -1.0):
            if (sign * beyond > least_K).sum() >= POLICY.impossible_min_rows:
                yield k, float(ends[-1]), float(sign * (sign * beyond).max())
