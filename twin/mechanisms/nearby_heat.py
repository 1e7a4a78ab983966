"""Mechanisms of heat near the structure or from the cut: cabinet, hydraulic unit, sun, cutting."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from data.arrays import Numeric
from twin.mechanisms.base import Mechanism, View, real, size, steps_s
from twin.quantity import Spec


class CabinetHeat(Mechanism):
    """Electronics and auxiliaries that run whether or not the spindle does; with a driver, only while it is 1."""

    key = "cabinet_heat"
    summary = "waste heat of a control cabinet or of auxiliaries"
    equation = "P = heat running; running is 1 where no driver is named"
    source = "energy balance of a steady source; 0.2 to 1 kW a cabinet"
    signature = "one side of the column or bed, also with the spindle stopped"
    needs = "cabinet"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"running": "1"}
    optional_drivers: ClassVar[frozenset[str]] = frozenset({"running"})
    parameters = (Spec("heat", "W", "heat that reaches the machine", 200.0, 0.8, 0.0, 10e3, per="running"),)
    off: ClassVar[Mapping[str, float]] = {"heat": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(p["heat"] * size(view.driver.get("running", 1.0)))


class HydraulicUnit(Mechanism):
    """A pump that runs for the first `duty` of every `period`, counted from the batch's start.

    The heat is the exact mean over the interval that follows each time, so that a cycle shorter than the sampling
    leaves its average. With a driver the cycle is at work only while that is 1.
    """

    key = "hydraulic_unit"
    summary = "waste heat of a hydraulic unit or pump that cycles"
    equation = "P = heat on running while frac(t / period) < duty, else 0; running is 1 where no driver is named"
    source = "energy balance of a cycled source; 0.2 to 1 kW a unit"
    signature = "one side of the column or bed, in cycles, also with the spindle stopped"
    needs = "hydraulic unit"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"running": "1"}
    optional_drivers: ClassVar[frozenset[str]] = frozenset({"running"})
    along_time = True  # it works on whole intervals
    parameters = (
        Spec("heat", "W", "heat that reaches the machine while the pump runs", 500.0, 0.8, 0.0, 20e3, per="running"),
        Spec("duty", "1", "share of the time that the pump runs", 0.4, 0.8, 0.0, 1.0, "logit"),
        Spec("period", "min", "length of a cycle", 10.0, 0.7, 0.1, 1440.0),
    )
    off: ClassVar[Mapping[str, float]] = {"heat": 0.0}
    shape = ("duty", "period")
    scan: ClassVar[Mapping[str, tuple[float, ...]]] = {"period": (3.0, 8.0, 20.0, 50.0, 120.0)}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        period_s, step_s = 60.0 * p["period"], steps_s(view)
        begun_s, done_s = (_run_s(t, p["duty"], period_s) for t in (view.time_s, view.time_s + step_s))
        return np.asarray(p["heat"] * (done_s - begun_s) / step_s * size(view.driver.get("running", 1.0)))


class Sun(Mechanism):
    """Sunlight on one face, by the clock; none where the time of day is not known."""

    key = "sun"
    summary = "sunlight on one face"
    equation = "P = irradiance area absorptivity sin(pi (t - rise) / (set - rise)) from rise to set, else 0"
    source = "Monteith and Unsworth 2013, Principles of Environmental Physics, ch. 5: half sine of a clear day"
    signature = "one face and a sideways tilt, at the same time of day"
    needs = "window"
    acts_at = ("node",)
    # Within a midsummer's day at 60 degrees: with free hours a heat that goes on by night would pass for sunlight.
    parameters = (
        Spec("irradiance", "W/m**2", "at its highest, on the face", 150.0, 0.7, 0.0, 1400.0),
        Spec("area", "m**2", "sunlit surface", 1.0, 0.5, 0.0, 200.0),
        Spec("absorptivity", "1", "share of the sunlight that the paint absorbs", 0.5, 0.8, 0.01, 1.0, "logit"),
        Spec("rise", "h", "time of day at which the sun reaches the face", 8.0, 1.5, 3.0, 18.0, "linear"),
        Spec("set", "h", "time of day at which it leaves the face", 16.0, 1.5, 7.0, 22.0, "linear"),
    )
    off: ClassVar[Mapping[str, float]] = {"irradiance": 0.0}
    shape = ("rise", "set")
    scan_points: ClassVar[tuple[Mapping[str, float], ...]] = (
        {"rise": 5.0, "set": 11.0},
        {"rise": 10.0, "set": 14.0},
        {"rise": 12.0, "set": 18.0},
        {"rise": 15.0, "set": 21.0},
    )

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        since_h, day_h = view.clock_h - p["rise"], p["set"] - p["rise"]
        shines = (real(since_h) > 0) & (real(since_h) < real(day_h))  # never where the clock is nan or the day empty
        height = np.sin(np.pi * np.where(shines, since_h, 0.0) / np.where(shines, day_h, 1.0))
        return np.asarray(p["irradiance"] * p["area"] * p["absorptivity"] * height)


class CuttingHeat(Mechanism):
    """The part of the cutting power that neither chips nor coolant carry away; braking gives none back."""

    key = "cutting_heat"
    summary = "heat of cutting"
    equation = "P = share P_cut"
    source = "Loewen and Shaw 1954, Trans. ASME 76, 217, partition of cutting heat; 3 to 10 % into the spindle"
    signature = "follows load, not speed"
    needs = "cutting"
    acts_at = ("node",)
    drivers: ClassVar[Mapping[str, str]] = {"power": "W"}
    parameters = (Spec("share", "1", "share of the power that warms these places", 0.05, 0.7, 0.0, 1.0, "logit"),)
    off: ClassVar[Mapping[str, float]] = {"share": 0.0}

    def heat_W(self, view: View, p: Mapping[str, Numeric]) -> Numeric:
        power_W = view.driver["power"]
        return np.asarray(p["share"] * np.where(real(power_W) > 0, power_W, 0.0))


def _run_s(time_s: Numeric, duty: Numeric, period_s: Numeric) -> Numeric:
    """Time run since the start, s: the integral of the on/off cycle."""
    turns = time_s / period_s
    whole = np.floor(real(turns))
    part = turns - whole
    return np.asarray(period_s * (duty * whole + np.where(real(part) < real(duty), part, duty)))
