"""First guesses of a network's values: heat balances of the bodies, integrated over time and solved by least squares.

Integrating the balance avoids differentiating noisy readings: T(t) - T(0) is linear in the rates with integrals of
temperature differences and of heat as regressors (Young 1981, Automatica 17, 23, integral-equation methods), solved
with no rate below 0 (Lawson and Hanson 1974, Solving Least Squares Problems, ch. 23).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

Array = NDArray[np.float64]

LONGEST, SHORTEST = 20.0, 3.0  # time constants: in durations of a part, and in rows
SOFT = 0.3  # weight of "all capacities alike" against what a link says of two


@dataclass(frozen=True)
class Balance:
    """K bodies' temperatures (n, K), the room's (n,), D drivers' heat at one watt each at the top (n, D).

    `parts` are the rows of each batch or block, `time_s` (n,) within it.
    """

    body_degC: Array
    room_degC: Array
    heat: Array
    parts: Sequence[NDArray[np.int64]]
    time_s: Array


@dataclass(frozen=True)
class Guess:
    """Values on an arbitrary common scale: capacities (K,) J/K, links by pair and exposures (K,) W/K, heats (K, D) W.

    `heat_W` is at each driver's top, by body that it goes into.
    """

    capacity_J_per_K: Array
    link_W_per_K: Array
    exposure_W_per_K: Array
    heat_W: Array

    def scaled(self, factor: float) -> Guess:
        """All on another scale: temperatures do not change."""
        return Guess(
            factor * self.capacity_J_per_K, factor * self.link_W_per_K, factor * self.exposure_W_per_K,
            factor * self.heat_W,
        )  # fmt: skip


def guess(balance: Balance, links: Sequence[tuple[int, int]]) -> Guess:
    """What the integrated balances say, values that they leave at 0 put within what recordings can show."""
    count = balance.body_degC.shape[1]
    rate = np.zeros((count, count))  # 1/s: how fast body k follows body j
    to_room = np.zeros(count)
    heating = np.zeros((count, balance.heat.shape[1]))  # K/s
    for k in range(count):
        near = [b if a == k else a for a, b in links if k in (a, b)]
        solved = _rates(balance, k, near)
        rate[k, near] = solved[: len(near)]
        to_room[k] = solved[len(near)]
        heating[k] = solved[len(near) + 1 :]
    duration_s = float(np.median([balance.time_s[at[-1]] for at in balance.parts]))
    step_s = duration_s / max(1.0, float(np.median([len(at) for at in balance.parts])) - 1.0)
    low, high = 1.0 / (LONGEST * duration_s), 1.0 / (SHORTEST * step_s)
    capacity = _capacities(rate, links)
    link = np.zeros(len(links))
    for n, (a, b) in enumerate(links):
        told = [r * c for r, c in ((rate[a, b], capacity[a]), (rate[b, a], capacity[b])) if r > 0]
        link[n] = np.exp(np.mean(np.log(told))) if told else 0.0
        link[n] = np.clip(link[n], low * min(capacity[a], capacity[b]), high * min(capacity[a], capacity[b]))
    heat = heating * capacity[:, None]
    return Guess(capacity, link, np.clip(to_room, low, high) * capacity, heat)


def _rates(balance: Balance, k: int, near: Sequence[int]) -> Array:
    """Rates of body k: to each neighbour and the room 1/s, then heating by each driver K/s; none below 0.

    Sensors' offsets make a ramp in either direction, which is fitted beside them and forgotten.
    """
    blocks, aims = [], []
    for at in balance.parts:
        own, time_s = balance.body_degC[at, k], balance.time_s[at]
        others = [balance.body_degC[at, j] for j in near] + [balance.room_degC[at]]
        flows = [o - own for o in others] + [balance.heat[at, d] for d in range(balance.heat.shape[1])]
        held = np.column_stack([_integral(f, time_s) for f in flows[: len(others)]])
        driven = np.column_stack([_held(f, time_s) for f in flows[len(others) :]] or [np.zeros((len(at), 0))])
        rows = np.column_stack([held, driven, time_s, -time_s])
        aim = own - own[0]
        good = np.isfinite(rows).all(axis=1) & np.isfinite(aim)
        blocks.append(rows[good])
        aims.append(aim[good])
    rows, aim = np.concatenate(blocks), np.concatenate(aims)
    size = np.linalg.norm(rows, axis=0)
    size[size == 0] = 1.0
    if not len(rows):
        return np.zeros(len(near) + 1 + balance.heat.shape[1])
    return np.asarray((nnls(rows / size, aim)[0] / size)[:-2])


def _integral(values: Array, time_s: Array) -> Array:
    """∫ dt from the first row, trapezoids."""
    steps = np.diff(time_s) * (values[1:] + values[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


def _held(values: Array, time_s: Array) -> Array:
    """The same of what holds from a row to the next."""
    return np.concatenate([[0.0], np.cumsum(np.diff(time_s) * values[:-1])])


def _capacities(rate: Array, links: Sequence[tuple[int, int]]) -> Array:
    """Capacities (K,), geometric mean 1: a conductance is the same from both ends, so C_a rate_ab = C_b rate_ba."""
    count = len(rate)
    rows, aims = [SOFT * np.eye(count)[k] for k in range(count)], [0.0] * count
    for a, b in links:
        if rate[a, b] > 0 and rate[b, a] > 0:
            rows.append(np.eye(count)[a] - np.eye(count)[b])
            aims.append(float(np.clip(np.log(rate[b, a] / rate[a, b]), -4.0, 4.0)))
    log = np.linalg.lstsq(np.array(rows), np.array(aims), rcond=None)[0]
    return np.asarray(np.exp(log - log.mean()))
