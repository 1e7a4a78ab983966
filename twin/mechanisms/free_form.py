"""What no listed mechanism explains, as a regression over one or two drivers and a temperature.

A diagnosis writes these when nothing of the registry fits. They hold where they were fitted, and say nothing beyond.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import Mechanism, PortRole, View
from twin.quantity import Spec

REFERENCE_DEGC = 20.0  # ISO 1
SECOND_ORDER = "Box and Wilson 1951, J. R. Stat. Soc. B 13, 1: second-order regression over what is known"
ANY = {"level": "1", "other": "1"}


class FreeFlux(Mechanism):
    """Heat into a body; each coefficient is per unit of its driver in the unit that the channel has."""

    key = "free_flux"
    words = "heat of no listed mechanism"
    equation = (
        "P = constant + linear u + square u^2 + (cross u + square_cross u^2) v + (per_K + product u) (T - 20 degC); "
        "u level, v other or 0"
    )
    source = SECOND_ORDER
    signature = "whatever the body's temperature lacks, as far as a driver and the temperature itself tell it"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = ANY
    optional_drivers: ClassVar[frozenset[str]] = frozenset(ANY)
    any_unit: ClassVar[frozenset[str]] = frozenset(ANY)
    ports = ("body",)
    parameters = (
        Spec("constant", "W", "heat at rest at 20 degC", 0.0, 50.0, -1e6, 1e6, "linear"),
        Spec("linear", "W", "heat per unit of the level", 0.0, 50.0, -1e6, 1e6, "linear"),
        Spec("square", "W", "heat per unit of the level squared", 0.0, 50.0, -1e6, 1e6, "linear"),
        Spec("cross", "W", "heat per unit of both drivers", 0.0, 50.0, -1e6, 1e6, "linear"),
        Spec("square_cross", "W", "heat per unit of the other and the level squared", 0.0, 50.0, -1e6, 1e6, "linear"),
        Spec("per_K", "W/K", "heat per kelvin of the body above 20 degC", 0.0, 2.0, -1e5, 1e5, "linear"),
        Spec("product", "W/K", "heat per kelvin and unit of the level", 0.0, 2.0, -1e5, 1e5, "linear"),
    )
    off: ClassVar[Mapping[str, float]] = {s.name: 0.0 for s in parameters}
    proposable = False  # it would explain anything

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["constant"] + _second_order(view, p, view.degC["body"] - REFERENCE_DEGC))


class FreeShift(Mechanism):
    """A displacement; it has no constant, since errors count from their first value."""

    key = "free_shift"
    words = "displacement of no listed mechanism"
    equation = (
        "error = linear u + square u^2 + (cross u + square_cross u^2) v + (per_K + product u) θ_body; "
        "u level, v other or 0"
    )
    source = SECOND_ORDER
    signature = "whatever the error lacks beside the temperatures, as far as a driver and one body's rise tell it"
    acts_at = ("error",)
    drivers: ClassVar[Mapping[str, str]] = ANY
    optional_drivers: ClassVar[frozenset[str]] = frozenset(ANY)
    any_unit: ClassVar[frozenset[str]] = frozenset(ANY)
    ports = ("body",)
    parameters = (
        Spec("linear", "um", "displacement per unit of the level", 0.0, 5.0, -1e5, 1e5, "linear"),
        Spec("square", "um", "displacement per unit of the level squared", 0.0, 5.0, -1e5, 1e5, "linear"),
        Spec("cross", "um", "displacement per unit of both drivers", 0.0, 5.0, -1e5, 1e5, "linear"),
        Spec(
            "square_cross",
            "um",
            "displacement per unit of the other and the level squared",
            0.0,
            5.0,
            -1e5,
            1e5,
            "linear",
        ),
        Spec("per_K", "um/K", "displacement per kelvin of the body's rise", 0.0, 2.0, -1e4, 1e4, "linear"),
        Spec("product", "um/K", "displacement per kelvin and unit of the level", 0.0, 2.0, -1e4, 1e4, "linear"),
    )
    off: ClassVar[Mapping[str, float]] = {s.name: 0.0 for s in parameters}
    proposable = False  # it would explain anything
    port_roles: ClassVar[Mapping[str, PortRole]] = {"body": "body"}

    def displacement(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(_second_order(view, p, view.rise_K["body"]))


def _second_order(view: View, p: Mapping[str, Numeric], over_K: Numeric) -> Numeric:
    u, v = view.driver.get("level", 0.0), view.driver.get("other", 0.0)
    driven = p["linear"] * u + p["square"] * u**2 + (p["cross"] * u + p["square_cross"] * u**2) * v
    return driven + (p["per_K"] + p["product"] * u) * over_K
