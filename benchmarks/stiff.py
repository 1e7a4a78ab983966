"""The sample machine's network for scipy's stiff solvers: what `benchmarks/twin.py` is compared with."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from scipy.integrate import solve_ivp

from data.arrays import Array
from plants.sample import sample_machine as sample
from plants.sample import thermal_machine as laws
from twin.simulation.inputs import Inputs

Method = Literal["LSODA", "BDF"]
METHODS: tuple[Method, ...] = ("LSODA", "BDF")


class Plain:
    """One batch of the sample machine as a right-hand side with its Jacobian: no array of batches, no lookup by name.

    `spinning` keeps the rotating convection, `feedback` the grease that thins; start_degC (14,) in sample.NODES' order.
    """

    def __init__(self, inputs: Inputs, batch: int, start_degC: Array, spinning: bool, feedback: bool) -> None:
        self.spinning, self.feedback, self.start = spinning, feedback, start_degC
        self.rpm, self.room = inputs.drivers["spindle_rpm"][batch], inputs.recorded["room"][batch]
        self.time_s, self.floor = inputs.time_s[batch], 17.65 + 0.5 * (self.room[0] - 17.65)
        self.capacity = np.array([sample.CAPACITY_J_PER_K[n] for n in sample.NODES])
        edges = np.flatnonzero(np.diff(self.rpm)) + 1
        self.segments = list(zip([0, *edges.tolist()], [*edges.tolist(), len(self.rpm)], strict=True))

    def solve(self, method: Method, rtol: float, max_step: float = np.inf) -> Array:
        """Temperatures (M + 1, 14) at every border, the solver restarted where the speed jumps."""
        out = np.empty((len(self.time_s), 14))
        out[0] = self.start
        for lo, hi in self.segments:
            slope, jacobian = self._functions(float(self.rpm[lo]))
            done = solve_ivp(
                slope, (self.time_s[lo], self.time_s[hi]), out[lo], method, self.time_s[lo : hi + 1], rtol=rtol,
                atol=rtol * 10.0, jac=jacobian, max_step=max_step,
            )  # fmt: skip
            out[lo + 1 : hi + 1] = done.y.T[1:]
        return out

    def _functions(self, rpm: float) -> tuple[Callable[[float, Array], Array], Any]:
        rates, room_rate, floor_rate = sample.network(rpm if self.spinning else 0.0)
        speed, hot = np.array([rpm]), np.full((1, 14), 40.0)
        fixed = floor_rate * self.floor + sample.heat_W(hot, speed, np.ones(1))[0] / self.capacity
        room, last, step_s = self.room, len(self.room) - 2, float(self.time_s[1] - self.time_s[0])
        if not self.feedback:

            def slope(t: float, y: Array) -> Array:
                k = min(int(t / step_s), last)
                w = t / step_s - k
                return rates @ y + fixed + room_rate * (room[k] * (1 - w) + room[k + 1] * w)

            return slope, lambda t, y: rates
        shaft, parts = sample.NODE["shaft"], []
        for bearing in sample.BEARINGS:
            j = sample.NODE[bearing.housing]
            viscous = 1.047e-4 * rpm * bearing.count * laws.LUBRICATION_F0 * 1e-7 * bearing.mean_diameter_mm**3 / 2
            at_40 = viscous * max(laws.VISCOSITY_40_MM2_PER_S * rpm, 2000.0) ** (2 / 3)
            fixed[[j, shaft]] -= at_40 / self.capacity[[j, shaft]]
            parts.append((j, viscous, laws.VISCOSITY_40_MM2_PER_S * rpm))
        shaft_C, b = self.capacity[shaft], laws.VISCOSITY_SLOPE_PER_K

        def dependent(t: float, y: Array) -> Array:
            k = min(int(t / step_s), last)
            w = t / step_s - k
            out = rates @ y + fixed + room_rate * (room[k] * (1 - w) + room[k + 1] * w)
            for j, viscous, product in parts:
                watts = viscous * max(product * math.exp(-b * ((y[j] + y[shaft]) / 2 - 40.0)), 2000.0) ** (2 / 3)
                out[j] += watts / self.capacity[j]
                out[shaft] += watts / shaft_C
            return out

        def jacobian(_: float, y: Array) -> Array:
            out = rates.copy()
            for j, viscous, product in parts:
                thin = product * math.exp(-b * ((y[j] + y[shaft]) / 2 - 40.0))
                by = -viscous * thin ** (2 / 3) * b / 3 if thin > 2000.0 else 0.0
                for row in (j, shaft):
                    out[row, [j, shaft]] += by / self.capacity[row]
            return out

        return dependent, jacobian
