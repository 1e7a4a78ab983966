"""Where a sensor sits inside its body: what a lump of one temperature cannot show."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from twin.mechanisms.base import Array, Mechanism, PortRole, View
from twin.quantity import Spec


class SensorPlace(Mechanism):
    """A sensor that sits towards a neighbour of its body, or away from it, where the body is not at its mean.

    Heat through the link between the two leaves a gradient in the body, nearly straight and nearly at once where the
    body conducts better than the link: what the sensor shows beside the mean is a share of their difference. A sign
    that the network is too coarse there, no fault of the sensor.
    """

    key = "sensor_place"
    words = "sensor off its body's mean"
    equation = "T_m = T_s + share · (T_towards - T_s)"
    source = "Incropera et al. 2007, Fundamentals of Heat and Mass Transfer, ch. 5: lumped body of small Biot number"
    signature = "one sensor ahead of its body (behind, if negative) by a share of the difference to a linked one"
    acts_at = ("sensor",)
    ports = ("towards",)
    parameters = (
        Spec("share", "1", "share of the way towards the neighbour, negative away", 0.0, 0.1, -0.5, 0.9, "linear"),
    )
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"share": 0.0}
    fault = True  # a rival all the same: the network is coarse there, the machine lacks nothing
    port_roles: ClassVar[Mapping[str, PortRole]] = {"towards": "neighbour"}

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(seen + p["share"] * (view.degC["towards"] - seen))
