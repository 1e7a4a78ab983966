"""Mechanisms of rolling bearings: friction by speed and by preload, and the effect of temperature on both.

Moments in N mm, speed n in rpm, mean diameter dm in mm: P = pi/30 * 1e-3 * n * M, rounded to 1.047e-4 as in the books.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import Mechanism, PortRole, View, power, real, size
from twin.quantity import Spec

W_PER_RPM_NMM = 1.047e-4
THIN_FILM = 2000.0  # nu n, mm²/s rpm: below it the viscous moment no longer depends on speed
VISCOSITY_EXPONENT = 2.0 / 3.0
VISCOUS_LOAD_EXPONENT = 0.54  # of the rolling moment of ball bearings
LEAST_PRELOAD = 0.1  # of the preload at rest: weight and centrifugal load stay, and so does the lubricant

COUNT = Spec("count", "1", "how many equal bearings", 2.0, 0.01, 1.0, 20.0)
MEAN_DIAMETER = Spec("mean_diameter", "mm", "mean diameter of a bearing, (bore + outside) / 2", 77.5, 0.02, 5.0, 500.0)


class BearingViscous(Mechanism):
    """Shearing of the lubricant. `viscosity` is that at the working temperature; see `ViscosityFeedback`."""

    key = "bearing_viscous"
    summary = "viscous friction of the bearings"
    equation = "P = count 1.047e-4 n M0; M0 = f0 1e-7 (nu n)^(2/3) dm^3 for nu n >= 2000, else 160e-7 f0 dm^3"
    source = (
        "Palmgren 1959, Ball and Roller Bearing Engineering, 3rd ed.; Harris 2001, Rolling Bearing Analysis, ch. 14"
    )
    signature = "rise at the nose grows with speed as n^1.3 to n^1.7"
    needs = "bearings"
    goes_with = ("bearing_load",)  # Palmgren 1959: M = M0 + M1, no bearing has one part alone
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        COUNT,
        MEAN_DIAMETER,
        Spec("lubrication", "1", "Palmgren's f0: 1 to 2 grease, 1.7 oil mist, 3 to 6 oil", 1.0, 0.4, 0.0, 20.0),
        Spec("viscosity", "mm**2/s", "kinematic viscosity of the oil at work", 22.0, 0.5, 1.0, 1000.0),
    )
    off: ClassVar[Mapping[str, float]] = {"lubrication": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        n = size(view.driver["speed"])
        film = p["viscosity"] * n
        per_f0 = np.where(real(film) < THIN_FILM, 160e-7, 1e-7 * power(film, VISCOSITY_EXPONENT))
        moment_Nmm = p["lubrication"] * per_f0 * p["mean_diameter"] ** 3
        return np.asarray(p["count"] * W_PER_RPM_NMM * n * moment_Nmm)


class BearingLoad(Mechanism):
    """Rolling and sliding under preload, independent of the lubricant."""

    key = "bearing_load"
    summary = "friction of the bearings under load"
    equation = "P = count 1.047e-4 n M1; M1 = z (F/C0)^y F dm"
    source = (
        "Palmgren 1959, Ball and Roller Bearing Engineering, 3rd ed.; Harris 2001, Rolling Bearing Analysis, ch. 14"
    )
    signature = "rise proportional to speed"
    needs = "bearings"
    goes_with = ("bearing_viscous",)
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        COUNT,
        MEAN_DIAMETER,
        Spec("preload", "N", "load on each bearing", 800.0, 0.5, 1.0, 1e5),
        Spec("static_capacity", "N", "static load rating C0 of a bearing", 26e3, 0.1, 100.0, 1e7),
        Spec("load_factor", "1", "Palmgren's z", 0.001, 0.3, 0.0, 0.01),
        Spec("load_exponent", "1", "Palmgren's y", 0.33, 0.1, 0.1, 1.0),
    )
    off: ClassVar[Mapping[str, float]] = {"load_factor": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        stress = (p["preload"] / p["static_capacity"]) ** p["load_exponent"]
        moment_Nmm = p["load_factor"] * stress * p["preload"] * p["mean_diameter"]
        return np.asarray(p["count"] * W_PER_RPM_NMM * size(view.driver["speed"]) * moment_Nmm)


class ViscosityFeedback(Mechanism):
    """The lubricant thins as it warms: multiplies a `bearing_viscous` heat whose viscosity holds at `reference`.

    Right where nu n >= 2000; below, at a few turns a second, the moment does not depend on the viscosity. Ball screws
    and rolling guides follow the same law; of slides in mixed friction `slope` is an effective one. The losses of a
    belt or a motor and the load's share of a bearing's friction do not depend on the viscosity.
    """

    key = "viscosity_feedback"
    multiplies = ("bearing_viscous", "nut_friction", "screw_bearing", "guide_friction")
    summary = "lubricant that thins as it warms"
    equation = (
        "nu = nu_ref exp(-slope (T_oil - reference)), so heat is multiplied by exp(-2/3 slope (T_oil - reference))"
    )
    source = "Reynolds 1886, Phil. Trans. 177, exponential law of viscosity; Palmgren 1959 for the exponent 2/3"
    signature = "heat peaks early, then falls; the rise in winter exceeds that in summer"
    acts_at = ("heat",)
    ports = ("oil",)
    parameters = (
        Spec("slope", "1/K", "relative fall of the viscosity per kelvin", 0.035, 0.3, 0.0, 0.1),
        Spec("reference", "degC", "temperature at which the viscosity is stated", 40.0, 0.1, -20.0, 120.0, "linear"),
    )
    off: ClassVar[Mapping[str, float]] = {"slope": 0.0}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"oil": "outlet"}

    def factor(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(np.exp(-VISCOSITY_EXPONENT * p["slope"] * (view.degC["oil"] - p["reference"])))


class PreloadFeedback(Mechanism):
    """A shaft warmer than its housing tightens the bearing: multiplies a `bearing_load` or `bearing_viscous` heat.

    M1 grows as F^(1 + y), so the load's heat does; a preload that is lost altogether gives no heat, never less. The
    viscous moment grows as F^0.54 and stays below a tenth of the preload (rolling moment of ball bearings: SKF 2016,
    Rolling bearings, p. 104).
    """

    key = "preload_feedback"
    multiplies = ("bearing_load", "bearing_viscous")
    summary = "preload that rises with the shaft's lead over the housing"
    equation = "F = F0 [1 + kappa (T_shaft - T_housing)], heat times (F/F0)^(1 + y), 0 where F < 0; viscous: ^0.54"
    source = "Stein and Tu 1994, J. Dyn. Syst. Meas. Control 116; Palmgren 1959 for 1 + y; SKF 2016 for 0.54"
    signature = "overshoot 10 to 40 min after a step of the speed"
    needs = "bearings"
    acts_at = ("heat",)
    ports = ("shaft", "housing")
    parameters = (
        Spec("kappa", "1/K", "relative rise of the preload per kelvin of the shaft's lead", 0.05, 0.6, 0.0, 0.5),
        Spec("load_exponent", "1", "Palmgren's y, as in the load's law", 0.33, 0.1, 0.1, 1.0),
    )
    off: ClassVar[Mapping[str, float]] = {"kappa": 0.0}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"shaft": "outlet", "housing": "outlet"}

    def __init__(self, viscous: bool = False) -> None:
        self.viscous = viscous  # whether it multiplies a viscous heat

    def multiplying(self, law: str) -> PreloadFeedback:
        return PreloadFeedback(law == "bearing_viscous")

    def factor(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        preload = 1.0 + p["kappa"] * (view.degC["shaft"] - view.degC["housing"])
        if self.viscous:
            return power(np.where(real(preload) > LEAST_PRELOAD, preload, LEAST_PRELOAD), VISCOUS_LOAD_EXPONENT)
        return power(np.where(real(preload) > 0, preload, 0.0), 1.0 + p["load_exponent"])
