"""Calling laws on intervals: what a mechanism sees at both ends of every interval, or along the starts of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twin.mechanisms.base import View
from twin.network import Heat, Law

if TYPE_CHECKING:
    from twin.simulation.inputs import Inputs

Array = NDArray[Any]  # float64, or complex128 while a derivative is taken
STEP = 1e-30  # of a complex step: its square vanishes, so that derivatives have no truncation error
EVERY = slice(None)


@dataclass(frozen=True)
class Intervals:
    """Builds views of some intervals of B batches.

    A law that works point by point sees (…, B, 2, m): start and end of each interval, with the interval's drivers. A
    law along time sees (…, B, m): the starts, so that what it does in an interval depends on nothing later.
    """

    inputs: Inputs

    def view(
        self,
        law: Law,
        along: bool = False,
        part: slice = EVERY,
        degC: Mapping[str, Array] | None = None,
        rise_K: Mapping[str, Array] | None = None,
    ) -> View:
        """What a law sees in the intervals `part`; `along` time or at both ends. Temperatures by the law's ports."""
        driver = {role: self.inputs.drivers[c][:, part] for role, c in law.drivers.items()}
        if along:
            return View(
                degC or {}, rise_K or {}, driver, self._time_s[:, 0, part], self._clock_h[:, 0, part], self._step_s
            )
        driver = {role: d[:, None] for role, d in driver.items()}
        return View(degC or {}, rise_K or {}, driver, self._time_s[..., part], self._clock_h[..., part], self._step_s)

    @cached_property
    def _time_s(self) -> Array:
        start_s, end_s = self.inputs.time_s[:, :-1], self.inputs.time_s[:, 1:]
        # an end is just before the border: what switches there does so in the next interval
        return np.stack([start_s, end_s - 1e-7 * self.inputs.dt_s], axis=1)

    @cached_property
    def _clock_h(self) -> Array:
        if np.isnan(self.inputs.clock_h).all():
            return np.full(self._time_s.shape, np.nan)
        return np.asarray((self.inputs.clock_h[:, None, None] + self._time_s / 3600.0) % 24.0)

    @cached_property
    def _step_s(self) -> float:
        """The intervals' length, nan where it varies."""
        dt_s = self.inputs.dt_s
        return float(dt_s[0, 0]) if dt_s.size and np.ptp(dt_s) < 1e-6 * dt_s.max() else np.nan


def parameters_of(law: Law, values: Array, axes: int) -> dict[str, Array]:
    """A law's parameters (P, 1, …) with `axes` further axes, from values (P, n)."""
    return {name: values[:, j].reshape(-1, *(1,) * axes) for name, j in law.parameters.items()}


def stepped(values: Array, j: int) -> Array:
    """Values (P, n) with parameter j a complex step ahead."""
    out = values.astype(complex)
    out[:, j] += 1j * STEP
    return out


def along_time(heat: Heat) -> bool:
    return any(law.mechanism.along_time for law in (heat.law, *heat.factors))


def heat_W(heat: Heat, call: Callable[[Law, str], Array]) -> Array:
    """A heat's law times the laws that multiply it; `call` evaluates a law's effect."""
    out = call(heat.law, "heat_W")
    for factor in heat.factors:
        out = out * call(factor, "factor")
    return out


def reads_time(law: Law, effect: str) -> bool:
    """Whether a law without ports looks at the time or the clock; if not, its value follows from drivers alone."""
    watched = _Watched({role: np.ones(1) for role in law.drivers})
    with np.errstate(all="ignore"):
        getattr(law.mechanism, effect)(watched, {name: np.ones(1) for name in law.parameters})
    return law.mechanism.along_time or bool(watched.read & {"time_s", "clock_h"})


@dataclass(frozen=True)
class _Watched(View):
    """A view that notes which of its fields are read."""

    read: set[str] = field(default_factory=set)

    def __init__(self, driver: Mapping[str, Array]) -> None:
        object.__setattr__(self, "read", set())
        super().__init__(driver=driver, clock_h=np.zeros(1), step_s=1.0)

    def __getattribute__(self, name: str) -> Any:
        if name in ("time_s", "clock_h"):
            object.__getattribute__(self, "read").add(name)
        return object.__getattribute__(self, name)
