"""Mechanisms of feed axes, motor and belt: friction and losses that vanish at rest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import Mechanism, View, power, real, size
from twin.quantity import Spec

LEAD = Spec("lead", "mm", "travel per turn of the screw", 10.0, 0.02, 0.5, 100.0)


class NutFriction(Mechanism):
    """Preloaded ball screw: a constant moment at N = feed / lead turns a minute."""

    key = "nut_friction"
    summary = "friction of the ball screw's nut"
    equation = "P = 2 pi N M / 60, N = feed / lead"
    source = "ISO 3408-3:2006, drag moment of preloaded ball screws; moments of 0.2 to 1 N m"
    signature = "only while the axis moves, proportional to feed; nut and the screw's travelled length"
    needs = "ball screw"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"feed": "mm/min"}
    parameters = (Spec("moment", "N*m", "friction moment", 0.5, 0.5, 0.0, 50.0), LEAD)
    off: ClassVar[Mapping[str, float]] = {"moment": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        turns_per_min = size(view.driver["feed"]) / p["lead"]
        return np.asarray(2.0 * np.pi * turns_per_min * p["moment"] / 60.0)


class ScrewBearing(NutFriction):
    """The screw's axial bearings: the same law as the nut's, at the screw's fixed end."""

    key = "screw_bearing"
    summary = "friction of the feed screw's bearings"
    source = "Harris 2001, Rolling Bearing Analysis, ch. 14; moments of 0.2 to 1 N m"
    signature = "only while the axis moves, proportional to feed; the screw's fixed end and its housing"
    parameters = (Spec("moment", "N*m", "friction moment of the bearings", 0.3, 0.5, 0.0, 50.0), LEAD)


class GuideFriction(Mechanism):
    """Coulomb friction of slides or rolling guides."""

    key = "guide_friction"
    summary = "friction of the guides"
    equation = "P = mu F v"
    source = "Coulomb 1785; mu 0.002 to 0.01 for rolling guides, 0.05 to 0.15 for slides"
    signature = "only while the axis moves, proportional to feed; along the guides"
    needs = "guides"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"feed": "mm/min"}
    parameters = (
        Spec("friction", "1", "coefficient of friction mu", 0.01, 1.0, 0.0, 1.0),
        Spec("load", "N", "load F on the guides: weight and preload", 5000.0, 0.3, 1.0, 1e6),
    )
    off: ClassVar[Mapping[str, float]] = {"friction": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        speed_m_per_s = size(view.driver["feed"]) / 60e3
        return np.asarray(p["friction"] * p["load"] * speed_m_per_s)


RATED = Spec("rated", "rpm", "speed at which the loss is stated", 6000.0, 0.01, 1.0, 2e5)


class MotorLoss(Mechanism):
    """Losses of a motor that turns without load. For copper losses under load add `ohmic_heat` by the current."""

    key = "motor_loss"
    summary = "losses of the spindle motor"
    equation = "P = idle + linear x + quadratic x^2 with x = n / rated; 0 at rest"
    source = "Steinmetz 1892 and Bertotti 1988: hysteresis losses proportional to n, eddy currents to n^2"
    signature = "the motor leads, conducted to the head; some of it as soon as the spindle turns, whatever its speed"
    needs = "motor"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        Spec("idle", "W", "magnetising and inverter loss while it turns at all", 40.0, 0.6, 0.0, 5000.0),
        Spec("linear", "W", "loss proportional to speed, at the rated speed", 110.0, 0.6, 0.0, 20e3),
        Spec("quadratic", "W", "loss proportional to speed squared, at the rated speed", 80.0, 0.6, 0.0, 20e3),
        RATED,
    )
    off: ClassVar[Mapping[str, float]] = {"idle": 0.0, "linear": 0.0, "quadratic": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        x = size(view.driver["speed"]) / p["rated"]
        return np.asarray(np.where(real(x) > 0, p["idle"] + p["linear"] * x + p["quadratic"] * x**2, 0.0))


class BeltLoss(Mechanism):
    """Flexing and windage of the belt and its pulleys."""

    key = "belt_loss"
    summary = "losses of the belt"
    equation = "P = power (n / rated)^exponent"
    source = "Gerbert 1999, Traction Belt Mechanics; exponent between 1 (hysteresis) and 2 to 3 (windage)"
    signature = "rear of the spindle, head and air; grows with speed as n^1.5"
    needs = "belt"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        Spec("power", "W", "loss at the rated speed", 70.0, 0.6, 0.0, 5000.0),
        Spec("exponent", "1", "how it grows with speed", 1.5, 0.15, 0.5, 3.0),
        RATED,
    )
    off: ClassVar[Mapping[str, float]] = {"power": 0.0}
    shape = ("exponent",)

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["power"] * power(view.driver["speed"] / p["rated"], p["exponent"]))
