"""Mechanisms of sensors and clocks: lag, bonding, offset, drift, self-heating, exchange, resolution, skew, place."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from data.arrays import Numeric
from data.errors import closest
from twin.mechanisms.base import Mechanism, PortRole, View, real
from twin.quantity import Spec
from twin.schema import MechanismPart, TwinPart, several


class SensorLag(Mechanism):
    """A sensor of one time constant, exact for what moves linearly between samples; steady at the first one.

    `view.step_s` is the spacing of the samples; where it is nan they are at `view.time_s`, evenly or not.
    """

    key = "sensor_lag"
    summary = "sensor that follows late"
    equation = "lag · dT_m/dt = T_s - T_m,  T_m(0) = T_s(0)"
    source = "Franklin, Powell and Workman (1998), Digital Control of Dynamic Systems, pp. 204-206, first-order hold"
    signature = (
        "hysteresis loop of one sensor against the others while temperatures rise fast; gone in the steady state"
    )
    acts_at = ("sensor",)
    parameters = (Spec("lag", "s", "time constant of the sensor in its place", 40.0, 0.7, 0.0, 10800.0),)
    along_time = True
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"lag": 0.0}
    scan: ClassVar[Mapping[str, tuple[float, ...]]] = {"lag": (30.0, 90.0, 240.0, 720.0, 2100.0, 7200.0)}
    fault = True

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        seen, lag = _along_time(seen, p["lag"])
        if np.isfinite(view.step_s):
            return _filtered(seen, *_weights(np.asarray(view.step_s), lag))
        step_s = np.diff(np.broadcast_to(view.time_s, seen.shape), axis=-1)
        return _scanned(seen, *_weights(step_s, lag))


class SensorBonding(Mechanism):
    """A sensor that the air cools: it shows a temperature between the surface's and the air's."""

    key = "sensor_bonding"
    summary = "poorly bonded sensor"
    equation = "T_m = T_air + bonding · (T_s - T_air)"
    source = "Michalski et al. (2001), Temperature Measurement: bonding = R_film / (R_film + R_contact)"
    signature = "gain error of one sensor that is proportional to the difference between surface and air"
    acts_at = ("sensor",)
    ports = ("air",)
    parameters = (Spec("bonding", "1", "share of the surface in what the sensor shows", 0.95, 0.7, 0.0, 1.0, "logit"),)
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"bonding": 1.0}
    fault = True

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        air = view.degC["air"]
        return np.asarray(air + p["bonding"] * (seen - air))


class SensorOffset(Mechanism):
    """A sensor that shows the same error at every temperature."""

    key = "sensor_offset"
    summary = "constant error of a sensor"
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

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(seen + p["offset"])


class SensorDrift(Mechanism):
    """A sensor whose error grows evenly during a run; a drift from run to run is an offset of each."""

    key = "sensor_drift"
    summary = "sensor that drifts"
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

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(seen + p["rate"] * view.time_s / 3600.0)


class SensorSelfHeat(Mechanism):
    """A resistance thermometer that its measuring current warms: an offset that is never negative."""

    key = "sensor_self_heat"
    summary = "self-heating of a sensor"
    equation = "T_m = T_s + excess,  excess = I² R / G_contact"
    source = "IEC 60751 (2022), self-heating of resistance thermometers"
    signature = "one sensor too warm by the same amount at equilibrium; no effect on rises"
    acts_at = ("sensor",)
    parameters = (Spec("excess", "K", "rise of the sensor above its place by its own current", 0.1, 0.8, 0.0, 5.0),)
    linear_reading = True
    off: ClassVar[Mapping[str, float]] = {"excess": 0.0}
    fault = True

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(seen + p["excess"])


def _along_time(seen: Numeric, parameter: Numeric) -> tuple[Numeric, Numeric]:
    """Both with the same number of axes, `seen` broadcast against a parameter that has no time axis of its own."""
    parameter = np.atleast_1d(parameter)
    lead = np.broadcast_shapes(seen.shape[:-1], parameter.shape[:-1])
    seen = np.broadcast_to(seen, (*lead, seen.shape[-1]))
    return seen, parameter.reshape((1,) * (seen.ndim - parameter.ndim) + parameter.shape)


def _weights(step_s: Numeric, lag_s: Numeric) -> tuple[Numeric, Numeric, Numeric]:
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


def _filtered(seen: Numeric, kept: Numeric, before: Numeric, now: Numeric) -> Numeric:
    """The recursion where the weights hold for all time; one call for every lag among the parameter sets."""
    if kept.size == 1:
        return _of_one_lag(seen, kept.item(), before.item(), now.item())
    out = np.empty(seen.shape, np.result_type(seen, kept))
    for at in np.ndindex(kept.shape[:-1]):
        rows = tuple(slice(None) if n == 1 else i for i, n in zip(at, kept.shape[:-1], strict=True))
        out[rows] = _of_one_lag(seen[rows], kept[(*at, 0)], before[(*at, 0)], now[(*at, 0)])
    return out


def _of_one_lag(seen: Numeric, kept: complex, before: complex, now: complex) -> Numeric:
    from scipy.signal import lfilter  # takes long to load

    steady = (kept + before) * seen[..., :1]
    return np.asarray(lfilter([now, before], [1.0, -kept], seen, axis=-1, zi=steady)[0])


def _scanned(seen: Numeric, kept: Numeric, before: Numeric, now: Numeric) -> Numeric:
    """The recursion over uneven steps, weights (..., M - 1)."""
    out = np.empty(seen.shape, np.result_type(seen, kept))
    out[..., 0] = seen[..., 0]
    forced = before * seen[..., :-1] + now * seen[..., 1:]
    kept = np.broadcast_to(kept, forced.shape)
    for k in range(forced.shape[-1]):
        out[..., k + 1] = kept[..., k] * out[..., k] + forced[..., k]
    return out


class SensorSwap(Mechanism):
    """Two sensors with exchanged names: place, lag, bonding and offset go together."""

    key = "sensor_swap"
    summary = "two sensors exchanged"
    equation = "T_a = T_s(place b),  T_b = T_s(place a)"
    source = "a permutation of two labels; no parameter"
    signature = "order of the time constants is wrong: the sensor near the heat is late, its partner early"
    acts_at = ("sensor",)
    off = None  # exchanged or not
    together = 2
    fault = True

    def expand(self, name: str, part: MechanismPart, twin: TwinPart) -> TwinPart:
        on = several(part.acts_on)
        if len(set(on)) != 2:
            raise ValueError(f"mechanisms.{name}.acts_on: got {list(on)}, expected the two sensors that are exchanged")
        for channel in on:
            if channel not in twin.sensors:
                raise ValueError(f"mechanisms.{name}.acts_on: no sensor {channel!r}; {closest(channel, twin.sensors)}")
        one, other = on
        exchanged = {one: twin.sensors[other], other: twin.sensors[one]}
        return twin.model_copy(update={"sensors": {n: exchanged.get(n, s) for n, s in twin.sensors.items()}})


class SensorStuck(Mechanism):
    """A sensor that shows its last value for good."""

    key = "sensor_stuck"
    summary = "sensor that hangs"
    equation = "T_m(t) = T_s(min(t, start))"
    source = "Isermann (2006), Fault-Diagnosis Systems: stuck sensor"
    signature = "one sensor constant to the last digit while its neighbours move"
    acts_at = ("sensor",)
    parameters = (
        Spec("start", "s", "time in the run from which the sensor hangs", 3600.0, 3600.0, 0.0, 1e7, "linear"),
    )
    along_time = True
    off = None  # a start beyond the run is one, but nothing leads there by small steps
    fault = True

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        stuck = real(view.time_s) > real(p["start"])
        return np.where(stuck, _value_at(seen, view, p["start"]), seen)


class SensorQuantised(Mechanism):
    """A reading in coarse steps. Its mean follows the temperature: derivatives pass as if there were no steps."""

    key = "sensor_quantised"
    summary = "coarse resolution of a sensor"
    equation = "T_m = step · round(T_s / step)"
    source = "Widrow, Kollár and Liu (1996), statistical theory of quantization: zero-mean error, step / √12"
    signature = "stairs in one channel, no displacement with them; jumps of rates computed from it"
    acts_at = ("sensor",)
    parameters = (Spec("step", "K", "width of a step", 0.1, 0.7, 0.0, 5.0),)
    off: ClassVar[Mapping[str, float]] = {"step": 0.0}
    fault = True
    proposable = False  # steps leave no smooth trace

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        step, true = real(p["step"]), real(seen)
        rounded = step * np.round(true / np.where(step > 0, step, 1.0))
        return np.asarray(seen + np.where(step > 0, rounded - true, 0.0))


class TimeSkew(Mechanism):
    """A channel whose clock is ahead or behind: it shows now what happens `delay` later (earlier, if negative)."""

    key = "time_skew"
    all_errors = True
    summary = "clock of a channel against the others"
    equation = "y_m(t) = y(t + delay)"
    source = "Taylor expansion: residual = delay · dy/dt; linear interpolation between samples"
    signature = "residual proportional to the rate of change, of one sign while warming and the other after the stop"
    acts_at = ("sensor", "error")
    parameters = (Spec("delay", "s", "how far the channel runs ahead, signed", 0.0, 120.0, -3600.0, 3600.0, "linear"),)
    along_time = True
    off: ClassVar[Mapping[str, float]] = {"delay": 0.0}
    scan: ClassVar[Mapping[str, tuple[float, ...]]] = {
        "delay": (-600.0, -180.0, -60.0, -20.0, 20.0, 60.0, 180.0, 600.0)
    }
    fault = True

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return _value_at(seen, view, view.time_s + p["delay"])


def _value_at(seen: Numeric, view: View, at_s: Numeric) -> Numeric:
    """`seen` (..., M) at times (..., K), linear between the samples at `view.time_s` and held beyond them."""
    time_s, at_s = np.atleast_1d(view.time_s), np.atleast_1d(at_s)
    n = seen.shape[-1]
    if n == 1:
        return np.asarray(seen + 0.0 * at_s)
    low = np.clip(_interval(time_s, real(at_s)), 0, n - 2)
    t0, t1 = _take(time_s, low), _take(time_s, low + 1)
    share = (at_s - t0) / np.where(t1 > t0, t1 - t0, 1.0)
    share = np.where(real(share) < 0, 0.0, np.where(real(share) > 1, 1.0, share))
    return np.asarray((1.0 - share) * _take(seen, low) + share * _take(seen, low + 1))


def _interval(time_s: Numeric, at_s: Numeric) -> NDArray[np.int64]:
    """Number of the interval that each time lies in; rows of `time_s` go with rows of `at_s`."""
    if time_s.ndim == 1:
        return np.searchsorted(time_s, at_s, side="right") - 1
    lead = np.broadcast_shapes(time_s.shape[:-1], at_s.shape[:-1])
    time_s = np.broadcast_to(time_s, (*lead, time_s.shape[-1]))
    at_s = np.broadcast_to(at_s, (*lead, at_s.shape[-1]))
    rows = [np.searchsorted(time_s[i], at_s[i], side="right") - 1 for i in np.ndindex(lead)]
    return np.array(rows, dtype=np.int64).reshape(at_s.shape)


def _take(a: Numeric, index: NDArray[np.int64]) -> Numeric:
    """Along the last axis, the axes before it broadcast."""
    lead = np.broadcast_shapes(a.shape[:-1], index.shape[:-1])
    return np.take_along_axis(
        np.broadcast_to(a, (*lead, a.shape[-1])), np.broadcast_to(index, (*lead, index.shape[-1])), axis=-1
    )


class SensorPlace(Mechanism):
    """A sensor that sits towards a neighbour of its body, or away from it, where the body is not at its mean.

    Heat through the link between the two causes a gradient in the body, nearly linear and quasi-static where the body
    conducts better than the link: the sensor deviates from the mean by a share of their difference. It indicates that
    the network is too coarse there, not a fault of the sensor.
    """

    key = "sensor_place"
    summary = "sensor off its body's mean"
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

    def reading(self, seen: Numeric, view: View, p: Mapping[str, Numeric]) -> Numeric:
        return np.asarray(seen + p["share"] * (view.degC["towards"] - seen))
