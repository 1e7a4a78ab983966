"""Electrical heat: a heater by its setting, a conductor or a cell by its current."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from twin.mechanisms.analytic import ZERO_DEGC_K
from twin.mechanisms.base import Array, Mechanism, View
from twin.quantity import Spec


class ElectricalHeat(Mechanism):
    """A heater: watts per unit of its driver, in the unit that the driver's channel has (per cent, or 0 and 1)."""

    key = "electrical_heat"
    words = "electrical heater"
    equation = "P = gain level"
    source = "Joule 1841, energy balance of a resistive heater at constant supply"
    signature = "in step with the heater's setting, proportional to it"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"level": "1"}
    parameters = (Spec("gain", "W", "heat per unit of the driver", 1.0, 1.0, 0.0, 1e6),)

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(p["gain"] * view.driver["level"])


class OhmicHeat(Mechanism):
    """Current through a resistance that may change with temperature; in a cell also the heat of its reaction.

    The current is positive while it charges; entropic is then dU/dT of the cell, 0 for a plain conductor. Copper has
    a temperature coefficient near +0.004 /K, a lithium-ion cell one near -0.02 /K.
    """

    key = "ohmic_heat"
    words = "heat of a current"
    equation = "P = R I^2 exp(coefficient (T - reference)) + entropic I (T + 273.15)"
    source = "Joule 1841; Bernardi, Pawlikowski and Newman 1985, J. Electrochem. Soc. 132, 5, eq. 21"
    signature = "grows with the square of the current; a reversible part changes sign with it"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"current": "A"}
    ports = ("body",)
    parameters = (
        Spec("resistance", "ohm", "resistance at the reference temperature", 0.02, 1.0, 0.0, 1e6),
        Spec("coefficient", "1/K", "relative change of the resistance per kelvin", 0.0, 0.01, -0.1, 0.1, "linear"),
        Spec("reference", "degC", "temperature at which the resistance is stated", 25.0, 0.1, -40.0, 200.0, "linear"),
        Spec("entropic", "V/K", "reversible heat per ampere and kelvin", 0.0, 2e-4, -2e-3, 2e-3, "linear"),
    )

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        current_A, body_degC = view.driver["current"], view.degC["body"]
        joule_W = p["resistance"] * current_A**2 * np.exp(p["coefficient"] * (body_degC - p["reference"]))
        return np.asarray(joule_W + p["entropic"] * current_A * (body_degC + ZERO_DEGC_K))
