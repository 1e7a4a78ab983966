"""Mechanisms of surfaces: forced and natural convection, draught, radiation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import ZERO_DEGC_K, Mechanism, PortRole, View, power, real, steps_s
from twin.quantity import Spec

STEFAN_BOLTZMANN = 5.670374419e-8  # W/m²/K⁴, CODATA 2018
NEVER_S = -1e9


class RotatingConvection(Mechanism):
    """The air that a turning surface drags along; multiplies what the exposure has at rest.

    From Nu = 0.133 Re^(2/3) Pr^(1/3) and Re = pi n d^2 / (60 nu_air): 96 W/m²K or so at 6000 rpm and 80 mm.
    """

    key = "rotating_convection"
    summary = "air dragged along by turning parts"
    equation = "h = h_rest [1 + gain (n / rated)^exponent]"
    source = "Becker 1963, Int. J. Heat Mass Transfer 6, 1053: Nu = 0.133 Re^(2/3) Pr^(1/3)"
    signature = "time constants are shorter running than stopped"
    needs = "rotating parts"
    acts_at = ("exposure", "link")
    drivers: ClassVar[Mapping[str, str]] = {"speed": "rpm"}
    parameters = (
        Spec("gain", "1", "what the rated speed adds, in multiples of the exchange at rest", 3.5, 0.6, 0.0, 50.0),
        Spec("exponent", "1", "how it grows with speed", 2.0 / 3.0, 0.1, 0.3, 1.0),
        Spec("rated", "rpm", "speed at which the gain is stated", 6000.0, 0.01, 1.0, 2e5),
    )
    off: ClassVar[Mapping[str, float]] = {"gain": 0.0}
    shape = ("exponent",)

    def factor(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(1.0 + p["gain"] * power(view.driver["speed"] / p["rated"], p["exponent"]))


class NaturalConvection(Mechanism):
    """Air that rises along a vertical wall: laminar or turbulent, whichever exchanges more.

    They meet where dT L^3 = (1.42 / 1.31)^12 = 2.6 K m^3. The heat leaves the port `air` where that is a body.
    """

    key = "natural_convection"
    summary = "natural convection that grows with the temperature difference"
    equation = "P = area h (T_air - T); h = max(1.42 (|dT|/height)^(1/4), 1.31 |dT|^(1/3)) W/m2K"
    source = "McAdams 1954, Heat Transmission, 3rd ed.; Holman 2010, Heat Transfer, table 7-2, vertical plane"
    signature = "time constants shorten as the difference to the air grows"
    acts_at = ("node",)
    ports = ("body", "air")
    takes_from: ClassVar[str | None] = "air"
    parameters = (
        Spec("area", "m**2", "surface", 1.0, 0.7, 0.0, 200.0),
        Spec("height", "m", "height of the wall", 0.5, 0.3, 0.005, 10.0),
    )
    off: ClassVar[Mapping[str, float]] = {"area": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        lead = view.degC["air"] - view.degC["body"]
        laminar = 1.42 * power(lead / p["height"], 0.25)
        turbulent = 1.31 * power(lead, 1.0 / 3.0)
        return np.asarray(p["area"] * np.where(real(laminar) > real(turbulent), laminar, turbulent) * lead)


class Radiation(Mechanism):
    """A grey surface facing a large or black surrounding, or another body: the port `surrounding`.

    The heat leaves that port where it is a body. About 5 W/m²K at a workshop's temperatures.
    """

    key = "radiation"
    summary = "radiation to walls or from a hot neighbour"
    equation = "P = emissivity sigma area (T_surrounding^4 - T^4), T in K"
    source = "Stefan 1879, Boltzmann 1884; CODATA 2018"
    signature = "follows walls or a hot neighbour that the air sensor does not see"
    acts_at = ("node",)
    ports = ("body", "surrounding")
    takes_from: ClassVar[str | None] = "surrounding"
    parameters = (
        Spec("area", "m**2", "radiating surface, times the view factor", 1.0, 0.7, 0.0, 200.0),
        Spec("emissivity", "1", "emissivity: 0.9 painted, 0.1 to 0.3 bare metal", 0.9, 0.5, 0.01, 1.0, "logit"),
    )
    off: ClassVar[Mapping[str, float]] = {"area": 0.0}
    port_roles: ClassVar[Mapping[str, PortRole]] = {"surrounding": "facing"}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        body_K, other_K = view.degC["body"] + ZERO_DEGC_K, view.degC["surrounding"] + ZERO_DEGC_K
        # (a^4 - b^4) as a product: exactly 0 at equal temperatures, no cancellation near them
        difference_K4 = (other_K - body_K) * (other_K + body_K) * (other_K**2 + body_K**2)
        return np.asarray(p["emissivity"] * STEFAN_BOLTZMANN * p["area"] * difference_K4)


class Draught(Mechanism):
    """An open door or gate for a while: exposures exchange more, surroundings cool. `acts_on` names either or both.

    The window counts from a batch's start or, with `clock`, is a time of every day, the same in all batches; none
    where the time of day is not known. It opens and closes within one interval of the simulation.
    """

    key = "draught"
    all_air = True
    summary = "draught from an open door or gate"
    equation = "within start <= t < start + duration: G = factor G0, T_air = T_air0 - drop; t of the run or the day"
    source = "step model of a gate opening; h x 1.5 to 3 and 2 to 10 K for 5 to 30 min"
    signature = "short dips, thin parts first"
    acts_at = ("exposure", "surrounding")
    parameters = (
        Spec("start", "h", "when it begins, from the batch's start or by the clock", 1.0, 1.0, 0.0, 1e4, "linear"),
        Spec("duration", "min", "how long it lasts", 15.0, 0.6, 0.0, 1e4),
        Spec("factor", "1", "what the exchange is multiplied by", 2.0, 0.4, 0.1, 20.0),
        Spec("drop", "K", "by how much the air is colder meanwhile", 4.0, 0.6, 0.0, 40.0),
        Spec("clock", "1", "1: `start` is a time of day; 0: it counts from the batch", 0.0, 0.5, 0.0, 1.0, "linear"),
    )
    off: ClassVar[Mapping[str, float]] = {"factor": 1.0, "drop": 0.0}
    shape = ("start", "duration")
    window = ("start", "duration")
    scan_points: ClassVar[tuple[Mapping[str, float], ...]] = tuple(
        {"start": hour, "clock": 1.0} for hour in (5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0,
                                                   18.0, 20.0, 22.0)
    )  # fmt: skip

    def factor(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(1.0 + (p["factor"] - 1.0) * self.at_work(view, p))

    def surrounding_K(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(-p["drop"] * self.at_work(view, p))

    def at_work(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        """How far it is open, 0 to 1, at every time: the edges take one interval, or a fit could not move them."""
        edge_s = np.fmax(steps_s(view), 1.0)  # where the step is not known, all but at once
        begin_s = 3600.0 * p["start"]
        end_s = begin_s + 60.0 * p["duration"]
        begun, done = (_ramp(0.5 + (_counted_s(view, p["clock"]) - at_s) / edge_s) for at_s in (begin_s, end_s))
        return np.asarray(begun - done)


def _counted_s(view: View, clock: Numeric) -> Numeric:
    """Time from the batch's start, or of the day, s; long before any window where that is not known."""
    known = np.isfinite(view.clock_h)
    ahead_s = 3600.0 * np.where(known, view.clock_h, 0.0) - view.time_s
    unknown_s = np.where(real(clock) > 0, NEVER_S, view.time_s)
    return np.asarray(np.where(known, view.time_s + clock * ahead_s, unknown_s))


def _ramp(x: Numeric) -> Numeric:
    """x within 0 to 1."""
    return np.where(real(x) <= 0.0, 0.0, np.where(real(x) >= 1.0, 1.0, x))
