"""Electrical heat: a heater by its setting, alone or on a shared supply; a conductor or a cell by its current."""

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
    off: ClassVar[Mapping[str, float]] = {"gain": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(p["gain"] * view.driver["level"])


class SupplySag(Mechanism):
    """Loads on one supply: while another draws current the voltage falls, and this one heats less.

    `acts_on` names the heat that is lessened; the other load's heat, if it suffers too, has a sag of its own.
    """

    key = "supply_sag"
    words = "voltage drop of a shared supply"
    equation = "P = P0 (1 - sag other / rated)"
    source = "Ohm 1827: inner resistance of a source, linear in the other load's current"
    signature = "a heater warms its place less while another one is on, in step with that one's setting"
    acts_at = ("heat",)
    drivers: ClassVar[Mapping[str, str]] = {"other": "1"}
    parameters = (
        Spec("sag", "1", "share of the heat that is lost at the other's rated level", 0.2, 0.8, 0.0, 1.0, "logit"),
        Spec("rated", "1", "level of the other, in its channel's unit, at which `sag` is stated", 1.0, 0.01, 1e-6, 1e6),
    )
    off: ClassVar[Mapping[str, float]] = {"sag": 0.0}

    def factor(self, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(1.0 - p["sag"] * view.driver["other"] / p["rated"])


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
    off: ClassVar[Mapping[str, float]] = {"resistance": 0.0, "entropic": 0.0}
    shape = ("coefficient",)

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        current_A, body_degC = view.driver["current"], view.degC["body"]
        joule_W = p["resistance"] * current_A**2 * np.exp(p["coefficient"] * (body_degC - p["reference"]))
        return np.asarray(joule_W + p["entropic"] * current_A * (body_degC + ZERO_DEGC_K))
