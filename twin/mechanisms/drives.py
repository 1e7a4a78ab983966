"""The spindle's drive: losses of the motor and of the belt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from twin.mechanisms.analytic import power, size
from twin.mechanisms.base import Array, Mechanism, View, real
from twin.quantity import Spec

RATED = Spec("rated", "rpm", "speed at which the loss is stated", 6000.0, 0.01, 1.0, 2e5)


class MotorLoss(Mechanism):
    """Losses of a motor that turns without load. For copper losses under load add `ohmic_heat` by the current."""

    key = "motor_loss"
    words = "losses of the spindle motor"
    equation = "P = idle + linear x + quadratic x^2 with x = n / rated; 0 at rest"
    source = "Steinmetz 1892 and Bertotti 1988: hysteresis losses proportional to n, eddy currents to n^2"
    signature = "the motor leads, conducted to the head; some of it as soon as the spindle turns, whatever its speed"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        Spec("idle", "W", "magnetising and inverter loss while it turns at all", 40.0, 0.6, 0.0, 5000.0),
        Spec("linear", "W", "loss proportional to speed, at the rated speed", 110.0, 0.6, 0.0, 20e3),
        Spec("quadratic", "W", "loss proportional to speed squared, at the rated speed", 80.0, 0.6, 0.0, 20e3),
        RATED,
    )
    off: ClassVar[Mapping[str, float]] = {"idle": 0.0, "linear": 0.0, "quadratic": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        x = size(view.driver["speed"]) / p["rated"]
        return np.asarray(np.where(real(x) > 0, p["idle"] + p["linear"] * x + p["quadratic"] * x**2, 0.0))


class BeltLoss(Mechanism):
    """Flexing and windage of the belt and its pulleys."""

    key = "belt_loss"
    words = "losses of the belt"
    equation = "P = power (n / rated)^exponent"
    source = "Gerbert 1999, Traction Belt Mechanics; exponent between 1 (hysteresis) and 2 to 3 (windage)"
    signature = "rear of the spindle, head and air; grows with speed as n^1.5"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        Spec("power", "W", "loss at the rated speed", 70.0, 0.6, 0.0, 5000.0),
        Spec("exponent", "1", "how it grows with speed", 1.5, 0.15, 0.5, 3.0),
        RATED,
    )
    off: ClassVar[Mapping[str, float]] = {"power": 0.0}
    shape = ("exponent",)

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(p["power"] * power(view.driver["speed"] / p["rated"], p["exponent"]))
