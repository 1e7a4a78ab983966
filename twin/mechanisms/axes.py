"""Feed axes: friction of the nut, of the guides and of the screw's bearings; all vanish when the axis rests."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from twin.mechanisms.analytic import size
from twin.mechanisms.base import Array, Mechanism, View
from twin.quantity import Spec

LEAD = Spec("lead", "mm", "travel per turn of the screw", 10.0, 0.02, 0.5, 100.0)


class NutFriction(Mechanism):
    """Preloaded ball screw: a constant moment at N = feed / lead turns a minute."""

    key = "nut_friction"
    words = "friction of the ball screw's nut"
    equation = "P = 2 pi N M / 60, N = feed / lead"
    source = "ISO 3408-3:2006, drag moment of preloaded ball screws; moments of 0.2 to 1 N m"
    signature = "only while the axis moves, proportional to feed; nut and the screw's travelled length"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"feed": "mm/min"}
    parameters = (Spec("moment", "N*m", "friction moment", 0.5, 0.5, 0.0, 50.0), LEAD)
    off: ClassVar[Mapping[str, float]] = {"moment": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        turns_per_min = size(view.driver["feed"]) / p["lead"]
        return np.asarray(2.0 * np.pi * turns_per_min * p["moment"] / 60.0)


class ScrewBearing(NutFriction):
    """The screw's axial bearings: the same law as the nut's, at the screw's fixed end."""

    key = "screw_bearing"
    words = "friction of the feed screw's bearings"
    source = "Harris 2001, Rolling Bearing Analysis, ch. 14; moments of 0.2 to 1 N m"
    signature = "only while the axis moves, proportional to feed; the screw's fixed end and its housing"
    parameters = (Spec("moment", "N*m", "friction moment of the bearings", 0.3, 0.5, 0.0, 50.0), LEAD)


class GuideFriction(Mechanism):
    """Coulomb friction of slides or rolling guides."""

    key = "guide_friction"
    words = "friction of the guides"
    equation = "P = mu F v"
    source = "Coulomb 1785; mu 0.002 to 0.01 for rolling guides, 0.05 to 0.15 for slides"
    signature = "only while the axis moves, proportional to feed; along the guides"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"feed": "mm/min"}
    parameters = (
        Spec("friction", "1", "coefficient of friction mu", 0.01, 1.0, 0.0, 1.0),
        Spec("load", "N", "load F on the guides: weight and preload", 5000.0, 0.3, 1.0, 1e6),
    )
    off: ClassVar[Mapping[str, float]] = {"friction": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Array]) -> Array:
        speed_m_per_s = size(view.driver["feed"]) / 60e3
        return np.asarray(p["friction"] * p["load"] * speed_m_per_s)
