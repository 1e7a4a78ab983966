"""Regressions over one or two drivers and a temperature, for effects that no listed mechanism explains.

A diagnosis uses them when no mechanism of the registry fits. They are valid in the fitted range only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import REFERENCE_DEGC, Mechanism, PortRole, View
from twin.quantity import Spec

SECOND_ORDER = "Box and Wilson 1951, J. R. Stat. Soc. B 13, 1: second-order regression over what is known"
ANY = {"level": "1", "other": "1"}


def _coefficients(effect: str, unit: str, spread: float, bound: float, kelvin: str) -> tuple[Spec, ...]:
    """Coefficients of a second-order regression: of the drivers within ± bound, per kelvin within a tenth of it."""
    of_drivers = {
        "linear": "unit of the level",
        "square": "unit of the level squared",
        "cross": "unit of both drivers",
        "square_cross": "unit of the other and the level squared",
    }
    of_body = {"per_K": kelvin, "product": "kelvin and unit of the level"}
    return (
        *(Spec(n, unit, f"{effect} per {of}", 0.0, spread, -bound, bound, "linear") for n, of in of_drivers.items()),
        *(Spec(n, f"{unit}/K", f"{effect} per {of}", 0.0, 2.0, -bound / 10, bound / 10, "linear")
          for n, of in of_body.items()),
    )  # fmt: skip


class FreeFlux(Mechanism):
    """Heat into a body; each coefficient is per unit of its driver in the unit that the channel has."""

    key = "free_flux"
    summary = "heat of no listed mechanism"
    equation = (
        "P = constant + linear u + square u^2 + (cross u + square_cross u^2) v + (per_K + product u) (T - 20 degC); "
        "u level, v other or 0"
    )
    source = SECOND_ORDER
    signature = "whatever the body's temperature lacks, as far as a driver and the temperature itself show it"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = ANY
    optional_drivers: ClassVar[frozenset[str]] = frozenset(ANY)
    any_unit: ClassVar[frozenset[str]] = frozenset(ANY)
    ports = ("body",)
    parameters = (
        Spec("constant", "W", "heat at rest at 20 degC", 0.0, 50.0, -1e6, 1e6, "linear"),
        *_coefficients("heat", "W", 50.0, 1e6, "kelvin of the body above 20 degC"),
    )
    off: ClassVar[Mapping[str, float]] = {s.name: 0.0 for s in parameters}
    proposable = False  # it would explain anything

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["constant"] + _second_order(view, p, view.degC["body"] - REFERENCE_DEGC))


class FreeShift(Mechanism):
    """A displacement; it has no constant, since errors count from their first value."""

    key = "free_shift"
    summary = "displacement of no listed mechanism"
    equation = (
        "error = linear u + square u^2 + (cross u + square_cross u^2) v + (per_K + product u) θ_body; "
        "u level, v other or 0"
    )
    source = SECOND_ORDER
    signature = "what the temperatures do not explain of the error, as far as a driver and the rise of one body show it"
    acts_at = ("error",)
    drivers: ClassVar[Mapping[str, str]] = ANY
    optional_drivers: ClassVar[frozenset[str]] = frozenset(ANY)
    any_unit: ClassVar[frozenset[str]] = frozenset(ANY)
    ports = ("body",)
    parameters = _coefficients("displacement", "um", 5.0, 1e5, "kelvin of the body's rise")
    off: ClassVar[Mapping[str, float]] = {s.name: 0.0 for s in parameters}
    proposable = False  # it would explain anything
    port_roles: ClassVar[Mapping[str, PortRole]] = {"body": "body"}

    def displacement(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(_second_order(view, p, view.rise_K["body"]))


def _second_order(view: View, p: Mapping[str, Numeric], over_K: Numeric) -> Numeric:
    u, v = view.driver.get("level", 0.0), view.driver.get("other", 0.0)
    driven = p["linear"] * u + p["square"] * u**2 + (p["cross"] * u + p["square_cross"] * u**2) * v
    return driven + (p["per_K"] + p["product"] * u) * over_K
