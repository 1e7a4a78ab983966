"""How a temperature sensor shows what it sees: late, badly bonded, off, drifting, warmed by its own current."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from scipy.signal import lfilter

from twin.mechanisms.base import Array, Mechanism, View, real
from twin.quantity import Spec


class SensorLag(Mechanism):
    """A sensor of one time constant, exact for what moves linearly between samples; settled at the first one.

    `view.step_s` is the spacing of the samples; where it is nan they stand at `view.time_s`, evenly or not.
    """

    key = "sensor_lag"
    words = "sensor that follows late"
    equation = "lag · dT_m/dt = T_s - T_m,  T_m(0) = T_s(0)"
    source = "Franklin, Powell and Workman (1998), Digital Control of Dynamic Systems, pp. 204-206, first-order hold"
    signature = (
        "hysteresis loop of one sensor against the others while temperatures rise fast; gone in the steady state"
    )
    acts_at = ("sensor",)
    parameters = (Spec("lag", "s", "time constant of the sensor in its place", 40.0, 0.7, 0.0, 3600.0),)
    along_time = True
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"lag": 0.0}
    fault = True

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        seen, lag = _along_time(seen, p["lag"])
        if np.isfinite(view.step_s):
            return _filtered(seen, *_weights(np.asarray(view.step_s), lag))
        step_s = np.diff(np.broadcast_to(view.time_s, seen.shape), axis=-1)
        return _scanned(seen, *_weights(step_s, lag))


class SensorBonding(Mechanism):
    """A sensor that the air cools: it shows a temperature between the surface's and the air's."""

    key = "sensor_bonding"
    words = "poorly bonded sensor"
    equation = "T_m = T_air + bonding · (T_s - T_air)"
    source = "Michalski et al. (2001), Temperature Measurement: bonding = R_film / (R_film + R_contact)"
    signature = "gain error of one sensor that is proportional to the difference between surface and air"
    acts_at = ("sensor",)
    ports = ("air",)
    parameters = (Spec("bonding", "1", "share of the surface in what the sensor shows", 0.95, 0.7, 0.0, 1.0, "logit"),)
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"bonding": 1.0}
    fault = True

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        air = view.degC["air"]
        return np.asarray(air + p["bonding"] * (seen - air))


class SensorOffset(Mechanism):
    """A sensor that shows the same error at every temperature."""

    key = "sensor_offset"
    words = "constant error of a sensor"
    equation = "T_m = T_s + offset"
    source = "JCGM 200 (2012), instrumental bias, entry 4.20"
    signature = "sensors disagree at equilibrium; no effect on rises, only on models of absolute temperatures"
    acts_at = ("sensor",)
    parameters = (
        Spec("offset", "K", "reading at equilibrium less the true temperature", 0.0, 0.5, -10.0, 10.0, "linear"),
    )
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"offset": 0.0}
    fault = True

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(seen + p["offset"])


class SensorDrift(Mechanism):
    """A sensor whose error grows evenly during a run; a drift from run to run is an offset of each."""

    key = "sensor_drift"
    words = "sensor that drifts"
    equation = "T_m = T_s + rate · t"
    source = "JCGM 200 (2012), instrumental drift, entry 4.21"
    signature = "one sensor leaves its neighbours in a straight line, loaded or not; no displacement goes with it"
    acts_at = ("sensor",)
    parameters = (
        Spec("rate", "K/h", "change of the sensor's error per hour of a run", 0.0, 0.02, -5.0, 5.0, "linear"),
    )
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"rate": 0.0}
    fault = True

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(seen + p["rate"] * view.time_s / 3600.0)


class SensorSelfHeat(Mechanism):
    """A resistance thermometer that its measuring current warms: an offset that is never negative."""

    key = "sensor_self_heat"
    words = "self-heating of a sensor"
    equation = "T_m = T_s + excess,  excess = I² R / G_contact"
    source = "IEC 60751 (2022), self-heating of resistance thermometers"
    signature = "one sensor too warm by the same amount at equilibrium; no effect on rises"
    acts_at = ("sensor",)
    parameters = (Spec("excess", "K", "rise of the sensor above its place by its own current", 0.1, 0.8, 0.0, 5.0),)
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"excess": 0.0}
    fault = True

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        return np.asarray(seen + p["excess"])


def _along_time(seen: Array, parameter: Array) -> tuple[Array, Array]:
    """Both with the same number of axes, `seen` broadcast against a parameter that has no time axis of its own."""
    parameter = np.atleast_1d(parameter)
    lead = np.broadcast_shapes(seen.shape[:-1], parameter.shape[:-1])
    seen = np.broadcast_to(seen, (*lead, seen.shape[-1]))
    return seen, parameter.reshape((1,) * (seen.ndim - parameter.ndim) + parameter.shape)


def _weights(step_s: Array, lag_s: Array) -> tuple[Array, Array, Array]:
    """Of the last reading, the last and the present temperature in the present reading; 0, 0, 1 without a lag.

    Without a lag the derivative by it is still the true one, minus the slope of the temperature.
    """
    late = real(lag_s) > 0
    ratio = step_s / np.where(late, lag_s, 1.0)
    moves = real(ratio) > 1e-5
    kept = np.where(late, np.exp(-ratio), 0.0)
    safe = np.where(moves, ratio, 1.0)
    mean = np.where(moves, -np.expm1(-safe) / safe, 1.0 - ratio / 2.0)
    mean = np.where(late, mean, lag_s / np.where(step_s > 0, step_s, 1.0))
    return kept, mean - kept, 1.0 - mean


def _filtered(seen: Array, kept: Array, before: Array, now: Array) -> Array:
    """The recursion where the weights hold for all time; one call for every lag among the parameter sets."""
    if kept.size == 1:
        return _of_one_lag(seen, kept.item(), before.item(), now.item())
    out = np.empty(seen.shape, np.result_type(seen, kept))
    for at in np.ndindex(kept.shape[:-1]):
        rows = tuple(slice(None) if n == 1 else i for i, n in zip(at, kept.shape[:-1], strict=True))
        out[rows] = _of_one_lag(seen[rows], kept[(*at, 0)], before[(*at, 0)], now[(*at, 0)])
    return out


def _of_one_lag(seen: Array, kept: complex, before: complex, now: complex) -> Array:
    settled = (kept + before) * seen[..., :1]
    return np.asarray(lfilter([now, before], [1.0, -kept], seen, axis=-1, zi=settled)[0])


def _scanned(seen: Array, kept: Array, before: Array, now: Array) -> Array:
    """The recursion over uneven steps, weights (..., M - 1)."""
    out = np.empty(seen.shape, np.result_type(seen, kept))
    out[..., 0] = seen[..., 0]
    forced = before * seen[..., :-1] + now * seen[..., 1:]
    kept = np.broadcast_to(kept, forced.shape)
    for k in range(forced.shape[-1]):
        out[..., k + 1] = kept[..., k] * out[..., k] + forced[..., k]
    return out
