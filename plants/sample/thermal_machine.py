"""A simulated machine tool: bodies that store heat, links that carry it, heat that follows the spindle, errors.

Heat balance of body i, with T in degC:
``C_i dT_i/dt = sum_j G_ij (T_j - T_i) + G_room,i (T_room - T_i) + G_floor,i (T_floor - T_i) + q_i(n, T)``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy.linalg import expm

from data.arrays import Array

Key = TypeVar("Key")

# Rotating convection, Nu ~ Re^(2/3): rotating links to the air are multiplied by 1 + 3.5 x^(2/3), x = n / rated speed.
ROTATING_GAIN = 3.5
LUBRICATION_F0 = 1.0  # grease
VISCOSITY_40_MM2_PER_S, VISCOSITY_SLOPE_PER_K = 22.0, 0.035
LOAD_Z, LOAD_Y = 0.001, 0.33


@dataclass(frozen=True)
class BearingSet:
    """`count` equal angular-contact bearings in one housing; half of their heat goes into the body `shaft`.

    `gain` multiplies their friction: the ratio to the catalogue value.
    """

    housing: str
    count: int
    mean_diameter_mm: float
    preload_N: float
    static_capacity_N: float
    gain: float = 1.0


@dataclass(frozen=True)
class SpeedHeat:
    """Heat into one body while the spindle runs: ``sum of watts · x^exponent``, x = n / rated speed."""

    body: str
    terms: tuple[tuple[float, float], ...]  # (watts at rated speed, exponent)


@dataclass(frozen=True)
class ThermalMachine:
    """One machine. Conductances in W/K, capacities in J/K; `always_W` is heat that never stops.

    `um_per_K` is the displacement of each error channel per kelvin of each body, `speed_shift_um` that of the speed
    alone, at rated speed and proportional to n². The body named `shaft` takes half the bearings' heat.
    """

    capacity_J_per_K: Mapping[str, float]
    link_W_per_K: Mapping[tuple[str, str], float]
    room_W_per_K: Mapping[str, float]
    floor_W_per_K: Mapping[str, float]
    bearings: tuple[BearingSet, ...]
    heats: tuple[SpeedHeat, ...]
    always_W: Mapping[str, float]
    um_per_K: Mapping[str, Mapping[str, float]]
    rotating: tuple[tuple[str, str], ...] = ()
    speed_shift_um: Mapping[str, float] = field(default_factory=dict)
    rated_rpm: float = 6000.0

    @cached_property
    def bodies(self) -> tuple[str, ...]:
        return tuple(self.capacity_J_per_K)

    @cached_property
    def place(self) -> Mapping[str, int]:
        """Column of every body."""
        return {name: i for i, name in enumerate(self.bodies)}

    @cached_property
    def capacity(self) -> Array:
        """Heat capacities (N,), J/K."""
        return np.array(list(self.capacity_J_per_K.values()), float)

    def scattered(self, rng: np.random.Generator, share: float) -> ThermalMachine:
        """Another machine of the type: every capacity, conductance, heat and speed shift times 1 ± `share` (uniform).

        Lengths stay: they are the type's drawing.
        """

        def factor() -> float:
            return float(rng.uniform(1 - share, 1 + share))

        def drawn(values: Mapping[Key, float]) -> dict[Key, float]:
            return {k: v * factor() for k, v in values.items()}

        return replace(
            self,
            capacity_J_per_K=drawn(self.capacity_J_per_K),
            link_W_per_K=drawn(self.link_W_per_K),
            room_W_per_K=drawn(self.room_W_per_K),
            floor_W_per_K=drawn(self.floor_W_per_K),
            bearings=tuple(replace(b, gain=b.gain * factor()) for b in self.bearings),
            heats=tuple(SpeedHeat(h.body, tuple((w * factor(), e) for w, e in h.terms)) for h in self.heats),
            always_W=drawn(self.always_W),
            speed_shift_um=drawn(self.speed_shift_um),
        )

    def rates(self, speed_rpm: float) -> tuple[Array, Array, Array]:
        """Rates of the network at one speed: A (N, N) in 1/s, and room and floor gains (N,) in 1/s."""
        x = speed_rpm / self.rated_rpm
        n = len(self.bodies)
        conductance = np.zeros((n, n))
        for (a, b), value in self.link_W_per_K.items():
            g = value * (1.0 + ROTATING_GAIN * x ** (2 / 3)) if (a, b) in self.rotating else value
            i, j = self.place[a], self.place[b]
            conductance[i, i] += g
            conductance[j, j] += g
            conductance[i, j] -= g
            conductance[j, i] -= g
        room = np.array([self.room_W_per_K.get(b, 0.0) for b in self.bodies])
        floor = np.array([self.floor_W_per_K.get(b, 0.0) for b in self.bodies])
        capacity = self.capacity
        return -(conductance + np.diag(room + floor)) / capacity[:, None], room / capacity, floor / capacity

    def heat_W(self, body_degC: Array, speed_rpm: Array, friction: Array) -> Array:
        """Heat into every body (B, N), W, from temperatures (B, N), speed (B,) and the friction factor (B,)."""
        heat = self.driven_heat_W(speed_rpm)
        self._add_friction(heat, body_degC, speed_rpm, friction)
        return heat

    def driven_heat_W(self, speed_rpm: Array) -> Array:
        """The part of the heat that is independent of temperature, (..., N), W, at speeds (...,)."""
        x = speed_rpm / self.rated_rpm
        heat = np.zeros((*speed_rpm.shape, len(self.bodies)))
        for body, watts in self.always_W.items():
            heat[..., self.place[body]] += watts
        for law in self.heats:
            total = np.zeros_like(x)
            for watts, exponent in law.terms:
                total += watts * x**exponent
            heat[..., self.place[law.body]] += np.where(x > 0, total, 0.0)
        return heat

    def _add_friction(self, heat: Array, body_degC: Array, speed_rpm: Array, friction: Array) -> None:
        """Add the bearings' heat (B, N)."""
        shaft = self.place["shaft"]
        for bearing in self.bearings:
            housing = self.place[bearing.housing]
            oil = (body_degC[:, housing] + body_degC[:, shaft]) / 2
            half = friction * bearing_heat_W(bearing, speed_rpm, oil) / 2
            heat[:, housing] += half
            heat[:, shaft] += half

    def simulate(
        self,
        speed_rpm: Array,
        room_degC: Array,
        floor_degC: Array,
        start_degC: Array,
        friction: Array,
        step_s: float = 10.0,
        feed_heat_W: Array | None = None,
    ) -> Array:
        """Temperatures (S + 1, B, N) of B runs at once.

        speed and room (S, B) hold during each step, floor (B,), start (B, N), friction (B,). Conduction and convection
        are exact (matrix exponential per speed); heat that depends on temperature holds for one step, at most 10 s.
        `feed_heat_W` (S, B, N) is what the axes' drives bring in besides, as given.
        """
        speeds, which = np.unique(speed_rpm, return_inverse=True)
        which = which.reshape(speed_rpm.shape)
        n = len(self.bodies)
        free, forced = np.empty((len(speeds), n, n)), np.empty((len(speeds), n, n))
        for k, speed in enumerate(speeds):
            rates, room_rate, floor_rate = self.rates(float(speed))
            free[k] = expm(rates * step_s)
            forced[k] = np.linalg.solve(rates, free[k] - np.eye(n))
        out = np.empty((len(speed_rpm) + 1, *start_degC.shape))
        out[0] = start_degC
        floor_gain = floor_degC[:, None] * floor_rate
        heat = self.driven_heat_W(speed_rpm)
        for s in range(len(speed_rpm)):
            gain = room_degC[s][:, None] * room_rate + floor_gain
            self._add_friction(heat[s], out[s], speed_rpm[s], friction)
            gain += heat[s] / self.capacity
            if feed_heat_W is not None:
                gain += feed_heat_W[s] / self.capacity
            # einsum, not matmul: no BLAS, so the sum does not depend on its threads
            out[s + 1] = np.einsum("bij,bj->bi", free[which[s]], out[s])
            out[s + 1] += np.einsum("bij,bj->bi", forced[which[s]], gain)
        return out

    def error_um(self, rise_K: Array, speed_rpm: Array) -> dict[str, Array]:
        """Errors in µm by channel, each (...,), from the bodies' rises (..., N) and the speed (...,)."""
        x = speed_rpm / self.rated_rpm
        out = {}
        for channel, moves in self.um_per_K.items():
            total = self.speed_shift_um.get(channel, 0.0) * x**2
            for body, um_per_K in moves.items():
                total = total + um_per_K * rise_K[..., self.place[body]]
            out[channel] = np.asarray(total, float)
        return out


def bearing_heat_W(bearing: BearingSet, speed_rpm: Array, oil_degC: Array) -> Array:
    """Friction heat of a bearing set, W.

    Palmgren (1959): ``M0 = f0 1e-7 (nu n)^(2/3) dm³``, with ``nu n`` not below 2000, ``M1 = z (F/C0)^y F dm`` in
    N mm, ``P = 1.047e-4 n (M0 + M1)``; the grease thins as ``nu = nu40 exp(-0.035 (T - 40))``.
    """
    viscosity = VISCOSITY_40_MM2_PER_S * np.exp(-VISCOSITY_SLOPE_PER_K * (oil_degC - 40.0))
    viscous = LUBRICATION_F0 * 1e-7 * np.maximum(viscosity * speed_rpm, 2000.0) ** (2 / 3) * bearing.mean_diameter_mm**3
    load = LOAD_Z * (bearing.preload_N / bearing.static_capacity_N) ** LOAD_Y * bearing.preload_N
    moment_Nmm = viscous + load * bearing.mean_diameter_mm
    return np.asarray(1.047e-4 * speed_rpm * bearing.count * bearing.gain * moment_Nmm)
