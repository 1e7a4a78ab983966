"""Mechanisms of electrical heat: heaters, supply sag, conductors, and the heat and growth of battery cells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import ZERO_DEGC_K, Mechanism, PortRole, View, course, size, steps_s
from twin.quantity import Spec


class ElectricalHeat(Mechanism):
    """A heater: watts per unit of its driver, in the unit that the driver's channel has (per cent, or 0 and 1).

    A negative level cools, as a Peltier element does.
    """

    key = "electrical_heat"
    summary = "electrical heater"
    equation = "P = gain level"
    source = "Joule 1841, energy balance of a resistive heater at constant supply"
    signature = "in step with the heater's setting, proportional to it"
    needs = "heater"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"level": "1"}
    parameters = (Spec("gain", "W", "heat per unit of the driver", 1.0, 1.0, 0.0, 1e6, per="level"),)
    off: ClassVar[Mapping[str, float]] = {"gain": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["gain"] * view.driver["level"])


class SupplySag(Mechanism):
    """Loads on one supply: while another draws current the voltage drops, and this one heats less.

    `acts_on` names the heat that is lessened; the other load's heat, if it suffers too, has a sag of its own.
    """

    key = "supply_sag"
    summary = "voltage drop of a shared supply"
    equation = "P = P0 (1 - sag other / rated)"
    source = "Ohm 1827: inner resistance of a source, linear in the other load's current"
    signature = "a heater warms its place less while another one is on, in step with that one's setting"
    needs = "heater"
    acts_at = ("heat",)
    drivers: ClassVar[Mapping[str, str]] = {"other": "1"}
    parameters = (
        Spec("sag", "1", "share of the heat that is lost at the other's rated level", 0.2, 0.8, 0.0, 1.0, "logit"),
        Spec("rated", "1", "level of the other, in its channel's unit, at which `sag` is stated", 1.0, 0.01, 1e-6, 1e6),
    )
    off: ClassVar[Mapping[str, float]] = {"sag": 0.0}

    def factor(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(1.0 - p["sag"] * size(view.driver["other"]) / p["rated"])


class OhmicHeat(Mechanism):
    """Current through a resistance that may change with temperature; in a cell also the heat of its reaction.

    The current is positive while it charges; entropic is then dU/dT of the cell, 0 for a plain conductor. Copper has
    a temperature coefficient near +0.004 /K, a lithium-ion cell one near -0.02 /K.
    """

    key = "ohmic_heat"
    summary = "heat of a current"
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

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        current_A, body_degC = view.driver["current"], view.degC["body"]
        joule_W = p["resistance"] * current_A**2 * np.exp(p["coefficient"] * (body_degC - p["reference"]))
        return np.asarray(joule_W + p["entropic"] * current_A * (body_degC + ZERO_DEGC_K))


CAPACITY = Spec("capacity", "A*h", "charge at the last of the evenly spaced points", 3.0, 0.01, 1e-3, 1e4)
START = Spec("start", "A*h", "charge drawn before the batch begins", 0.0, 0.05, -1e4, 1e4, "linear")
VOLTAGES = (4.1, 4.05, 3.95, 3.8, 3.7, 3.6, 3.5, 3.2)  # usual for a nickel-rich lithium-ion cell
STRAINS, STRAINS_PER_K = 12, 5  # points beyond charge 0, where the strain counts as 0, and points from charge 0


class VoltageLossHeat(Mechanism):
    """What a cell's voltage lacks of the one at which its reaction makes no heat, times the current.

    The thermoneutral voltage is the open-circuit voltage less T dU/dT: both kinds of heat of a reaction in one table.
    """

    key = "voltage_loss_heat"
    summary = "heat of a cell by its loss of voltage"
    equation = "P = I (V - U(q)), q = start - integral of I dt; spline U through u0 at 0 … u7 at capacity"
    source = "Bernardi, Pawlikowski and Newman 1985, J. Electrochem. Soc. 132, 5, eq. 21"
    signature = "grows with the current and, at the same current, with the charge drawn; most near the end"
    needs = "battery cell"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"current": "A", "voltage": "V"}
    along_time = True
    parameters = (
        CAPACITY,
        START,
        *(
            Spec(f"u{k}", "V", f"thermoneutral voltage at {k}/7 of the capacity", value, 0.1, -1e3, 1e3, "linear")
            for k, value in enumerate(VOLTAGES)
        ),
    )
    off = None  # its watts are the whole difference of two voltages

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        current_A = view.driver["current"]
        each_Ah = current_A * steps_s(view) / 3600.0
        drawn_Ah = p["start"] - (np.cumsum(each_Ah, axis=-1) - each_Ah / 2)  # in the middle of each interval
        neutral_V = course(drawn_Ah / p["capacity"], *(p[f"u{k}"] for k in range(len(VOLTAGES))))
        return np.asarray(current_A * (view.driver["voltage"] - neutral_V))


class ChargeStrain(Mechanism):
    """Electrodes that swell and shrink with the charge, and a body whose growth per kelvin changes with it.

    In runs at constant currents a rise in temperature and the current itself go together: the second table may be
    for either.
    """

    key = "charge_strain"
    summary = "growth of a cell with the charge drawn"
    equation = "strain = f(q) + θ g(q), q = start - integral of I dt; splines through 0, f1 … f12 and g0 … g4"
    source = "Louli, Ellis and Dahn 2019, Joule 3, 745: pressure over charge; with linear thermal expansion"
    signature = "the same course over the charge at every rate, and not over time or temperature"
    needs = "battery cell"
    acts_at = ("error",)
    drivers: ClassVar[Mapping[str, str]] = {"current": "A"}
    ports = ("body",)
    along_time = True
    parameters = (
        CAPACITY,
        START,
        *(
            Spec(f"f{k}", "um/m", f"strain at {k}/{STRAINS} of the capacity", 0.0, 300.0, -1e5, 1e5, "linear")
            for k in range(1, STRAINS + 1)
        ),
        *(
            Spec(f"g{k}", "um/m/K", f"strain per kelvin at {k}/{STRAINS_PER_K - 1} of the capacity", 10.0, 20.0,
                 -1e4, 1e4, "linear")
            for k in range(STRAINS_PER_K)
        ),
    )  # fmt: skip
    off: ClassVar[Mapping[str, float]] = {
        **{f"f{k}": 0.0 for k in range(1, STRAINS + 1)},
        **{f"g{k}": 0.0 for k in range(STRAINS_PER_K)},
    }
    port_roles: ClassVar[Mapping[str, PortRole]] = {"body": "body"}

    def displacement(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        step_s = np.diff(view.time_s, axis=-1)  # a row's driver holds from there on
        each_Ah = view.driver["current"][..., :-1] * step_s / 3600.0
        drawn_Ah = np.concatenate([np.zeros((*each_Ah.shape[:-1], 1)), -np.cumsum(each_Ah, axis=-1)], axis=-1)
        share = (p["start"] + drawn_Ah) / p["capacity"]
        strain = course(share, np.zeros(1), *(p[f"f{k}"] for k in range(1, STRAINS + 1)))
        per_K = course(share, *(p[f"g{k}"] for k in range(STRAINS_PER_K)))
        return np.asarray(strain + view.rise_K["body"] * per_K)
