"""First guesses of a network's values: heat balances of the bodies, integrated over time and solved by least squares.

Integrating the balance avoids differentiating noisy readings: T(t) - T(0) is linear in the rates with integrals of
temperature differences and of heat as regressors (Young 1981, Automatica 17, 23, integral-equation methods), solved
with no rate below 0 (Lawson and Hanson 1974, Solving Least Squares Problems, ch. 23).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from data.arrays import Array
from data.machine import Machine
from diagnosis.policy import POLICY


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
    """Estimates of the integrated balances, with values of 0 moved within what recordings can show."""
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
    low, high = 1.0 / (POLICY.draft_max_time_constant * duration_s), 1.0 / (POLICY.draft_min_time_constant * step_s)
    capacity = _capacities(rate, links)
    link = np.zeros(len(links))
    for n, (a, b) in enumerate(links):
        known = [r * c for r, c in ((rate[a, b], capacity[a]), (rate[b, a], capacity[b])) if r > 0]
        link[n] = np.exp(np.mean(np.log(known))) if known else 0.0
        link[n] = np.clip(link[n], low * min(capacity[a], capacity[b]), high * min(capacity[a], capacity[b]))
    heat = heating * capacity[:, None]
    return Guess(capacity, link, np.clip(to_room, low, high) * capacity, heat)


def _rates(balance: Balance, k: int, near: Sequence[int]) -> Array:
    """Rates of body k: to each neighbour and the room 1/s, then heating by each driver K/s; none below 0.

    Sensors' offsets make a ramp in either direction, which is fitted with them and discarded.
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
    rows, aims = [POLICY.draft_equal_capacity_weight * np.eye(count)[k] for k in range(count)], [0.0] * count
    for a, b in links:
        if rate[a, b] > 0 and rate[b, a] > 0:
            rows.append(np.eye(count)[a] - np.eye(count)[b])
            most = POLICY.draft_max_log_capacity_ratio
            aims.append(float(np.clip(np.log(rate[b, a] / rate[a, b]), -most, most)))
    log = np.linalg.lstsq(np.array(rows), np.array(aims), rcond=None)[0]
    return np.asarray(np.exp(log - log.mean()))


@dataclass(frozen=True)
class Driven:
    """A driver whose heat the draft can state: its law, how heat grows with it (`exponent`), its largest size."""

    name: str  # of the mechanism
    driver: str
    unit: str
    law: str
    exponent: float
    top: float

    def share(self, level: Array) -> Array:
        """The heat over that at the top, for levels of any shape."""
        size = np.maximum(level, 0.0) if self.law in ("electrical_heat", "cutting_heat") else np.abs(level)
        return np.asarray((size / self.top) ** self.exponent)

    @property
    def scalable(self) -> bool:
        """Whether its heat can be held at any round value."""
        return self.law != "cutting_heat"

    def parameters(self, heat_W: float, held: bool) -> dict[str, Any]:
        """The law's parameters with this heat at the driver's top, held or with a prior."""

        def free(value: float, unit: str) -> Any:
            text = f"{value:.4g} {unit}"
            return text if held else {"value": text, "spread": POLICY.draft_heat_log_sd}

        top = f"{self.top:.6g}"
        if self.law == "belt_loss":
            exponent = {"value": POLICY.draft_speed_exponent, "spread": POLICY.draft_speed_exponent_sd}
            return {"power": free(heat_W, "W"), "exponent": exponent, "rated": f"{top} rpm"}
        if self.law == "guide_friction":
            load_N = float(np.clip(heat_W / (POLICY.draft_guide_friction * self.top / 60e3), 2.0, 9e5))
            return {"friction": POLICY.draft_guide_friction, "load": free(load_N, "N")}
        if self.law == "ohmic_heat":
            return {"resistance": free(heat_W / self.top**2, "ohm")}
        if self.law == "cutting_heat":
            return {
                "share": {
                    "value": float(f"{np.clip(heat_W / self.top, 0.01, 0.9):.3g}"),
                    "spread": POLICY.draft_heat_log_sd,
                }
            }
        return {"gain": free(heat_W / self.top, "W")}


LAWS: Mapping[str, tuple[str, float]] = {
    "rpm": ("belt_loss", POLICY.draft_speed_exponent),
    "mm/min": ("guide_friction", 1.0),
    "A": ("ohmic_heat", 2.0),
    "W": ("cutting_heat", 1.0),
    "1": ("electrical_heat", 1.0),
    "%": ("electrical_heat", 1.0),
}


def driven(machine: Machine, tops: Mapping[str, float]) -> tuple[list[Driven], list[str]]:
    """The drivers that some law takes, and remarks on those that none does."""
    out, remarks = [], []
    for driver, name in zip(tops, valid_names([f"heat_of_{d}" for d in tops]), strict=True):
        unit = machine.channels[driver].unit
        if unit in LAWS:
            out.append(Driven(name, driver, unit, *LAWS[unit], tops[driver]))
        else:
            remarks.append(f"driver {driver} is in {unit}, which no drafted heat grows with: it warms nothing there")
    return out, remarks


def valid_names(channels: Sequence[str], taken: Sequence[str] = ()) -> tuple[str, ...]:
    """Names that a machine file allows, after channels: letters, digits, underscores, each its own and none taken."""
    out: list[str] = []
    for channel in channels:
        name = "".join(c if c.isalnum() and c.isascii() else "_" for c in channel)
        name = name if name[:1].isalpha() else f"at_{name}"
        while name in (*out, *taken):
            name += "_2"
        out.append(name)
    return tuple(out)
