"""A point at which a law is evaluated, away from anything special, and its equation once more with units."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from data.arrays import Numeric
from data.units import unit_registry
from twin.mechanisms.base import Mechanism, View
from twin.quantity import Spec

U = unit_registry()
ZERO = U.Quantity(273.15, "K")
TIME_S = np.arange(13) * 600.0
STARTS_AT_H = 8.5
SEEN_DEGC, SLOPE_K_PER_S = 21.3, 1.1e-3
DRIVER = {"rpm": 3700.0, "mm/min": 5200.0, "mm": 430.0, "1": 0.6, "W": 900.0, "A": 12.0, "V": 3.4}
PORTS_DEGC = (34.0, 22.0)


Formula = Callable[[SimpleNamespace], Any]


@dataclass(frozen=True)
class Case:
    """What the contract needs to know of a mechanism.

    Attributes:
        formula: its equation over quantities with units: `q.area`, `q.speed` in the unit of the Spec or driver,
            `q.T_port` (absolute, K), `q.rise_port`, `q.seen` = `q.s0` + `q.slope` `q.t`. None: structural, or no
            dimensional check.
        values: parameters at the point of the checks, where a value next to the usual one shows nothing.
        ports: temperature in °C over time in h, by port.
        more: the equations of further effects.
        unit: of a displacement, where it is not µm.
        either_way: heat of both signs within the prior.
        undriven: it goes on without its driver.
        open: it exchanges with a surrounding or starts elsewhere, so it has no balance of its own.
        stepped: parameters by which its derivative is that of its mean.
    """

    formula: Formula | None = None
    values: Mapping[str, float] = field(default_factory=dict)
    ports: Mapping[str, Callable[[Any], Any]] = field(default_factory=dict)
    more: Mapping[str, Formula] = field(default_factory=dict)
    unit: str = "um"
    either_way: bool = False
    undriven: bool = False
    open: bool = False
    stepped: tuple[str, ...] = ()


@dataclass(frozen=True)
class Point:
    """A law with all that it sees. `values` are its parameters as bare numbers, in the units of its Specs."""

    mechanism: Mechanism
    view: View
    seen: Numeric
    values: Mapping[str, Numeric]

    @classmethod
    def of(cls, mechanism: Mechanism, case: Case) -> Point:
        hours = TIME_S / 3600.0
        courses = {port: PORTS_DEGC[k] + (1.5 + k) * hours for k, port in enumerate(mechanism.ports)}
        courses |= {port: course(hours) for port, course in case.ports.items()}
        rise = {port: course - course[0] for port, course in courses.items()}
        driver = {role: np.full(TIME_S.shape, DRIVER[unit]) for role, unit in mechanism.drivers.items()}
        view = View(courses, rise, driver, TIME_S, STARTS_AT_H + hours, float(TIME_S[1]))
        values = {s.name: np.array(_near_usual(s)) for s in mechanism.parameters}
        values |= {name: np.array(v) for name, v in case.values.items()}
        return cls(mechanism, view, SEEN_DEGC + SLOPE_K_PER_S * TIME_S, values)

    def effect(self, name: str) -> Numeric:
        """An effect over time, broadcast to (13,) where the law leaves the axis out."""
        law = getattr(self.mechanism, name)
        out = law(self.seen, self.view, self.values) if name == "reading" else law(self.view, self.values)
        return np.asarray(out) + np.zeros(TIME_S.shape)

    def at(self, **values: Any) -> Point:
        """With other parameter values."""
        return replace(self, values={**self.values, **{k: np.asarray(v) for k, v in values.items()}})

    def seeing(self, **view: Any) -> Point:
        """With another view."""
        return replace(self, view=replace(self.view, **view))

    def at_rest(self) -> Point:
        return self.seeing(driver={role: 0.0 * d for role, d in self.view.driver.items()})

    def quantities(self, units: Mapping[str, str]) -> SimpleNamespace:
        """The same with units, by the names that the equations in `cases` use."""
        Q, t = U.Quantity, U.Quantity(TIME_S, "s")
        slope = U.Quantity(SLOPE_K_PER_S, "K/s")
        s0 = Q(SEEN_DEGC, "K") + ZERO
        q: dict[str, Any] = {
            "t": t,
            "of_day": Q(self.view.clock_h, "h"),
            "slope": slope,
            "s0": s0,
            "seen": s0 + slope * t,
        }
        q |= {f"T_{port}": Q(T, "K") + ZERO for port, T in self.view.degC.items()}
        q |= {f"rise_{port}": Q(rise, "K") for port, rise in self.view.rise_K.items()}
        numbers = {**self.view.driver, **self.values}
        return SimpleNamespace(**q | {name: _quantity(numbers[name], unit) for name, unit in units.items()})


def units_of(mechanism: Mechanism) -> dict[str, str]:
    """Units of parameters and drivers as declared."""
    return {**mechanism.drivers, **{s.name: s.unit for s in mechanism.parameters}}


def _quantity(number: Numeric, unit: str) -> Any:
    if unit == "degC":
        return U.Quantity(number, "K") + ZERO
    return U.Quantity(number, "dimensionless" if unit == "1" else unit)


def _near_usual(spec: Spec) -> float:
    """A value near the usual one, within the bounds."""
    assert spec.value is not None and spec.spread is not None
    if spec.scale == "linear":
        return min(spec.value + 0.4 * spec.spread, spec.high)
    return 0.8 * spec.value if spec.scale == "logit" else min(1.2 * spec.value, spec.high)
