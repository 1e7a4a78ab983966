"""Sensors and probes that show something else: swapped, stuck, rounded, shifted in time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from data.errors import closest
from twin.compiling.scope import several
from twin.mechanisms.base import Array, Mechanism, View, real
from twin.quantity import Spec
from twin.schema import MechanismPart, TwinPart


class SensorSwap(Mechanism):
    """Two sensors under each other's name: place, lag, bonding and offset go together."""

    key = "sensor_swap"
    words = "two sensors exchanged"
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
    words = "sensor that hangs"
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

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        stuck = real(view.time_s) > real(p["start"])
        return np.where(stuck, _value_at(seen, view, p["start"]), seen)


class SensorQuantised(Mechanism):
    """A reading in coarse steps. Its mean follows the temperature: derivatives pass as if there were no steps."""

    key = "sensor_quantised"
    words = "coarse resolution of a sensor"
    equation = "T_m = step · round(T_s / step)"
    source = "Widrow, Kollár and Liu (1996), statistical theory of quantization: zero-mean error, step / √12"
    signature = "stairs in one channel, no displacement with them; jumps of rates computed from it"
    acts_at = ("sensor",)
    parameters = (Spec("step", "K", "width of a step", 0.1, 0.7, 0.0, 5.0),)
    off: ClassVar[Mapping[str, float]] = {"step": 0.0}
    fault = True
    proposable = False  # steps leave no smooth trace

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        step, true = real(p["step"]), real(seen)
        rounded = step * np.round(true / np.where(step > 0, step, 1.0))
        return np.asarray(seen + np.where(step > 0, rounded - true, 0.0))


class TimeSkew(Mechanism):
    """A channel whose clock is ahead or behind: it shows now what happens `delay` later (earlier, if negative)."""

    key = "time_skew"
    all_errors = True
    words = "clock of a channel against the others"
    equation = "y_m(t) = y(t + delay)"
    source = "Taylor expansion: residual = delay · dy/dt; linear interpolation between samples"
    signature = "residual proportional to the rate of change, of one sign while warming and the other after the stop"
    acts_at = ("sensor", "error")
    parameters = (Spec("delay", "s", "how far the channel runs ahead, signed", 0.0, 120.0, -3600.0, 3600.0, "linear"),)
    along_time = True
    off: ClassVar[Mapping[str, float]] = {"delay": 0.0}
    fault = True

    def reading(self, seen: Array, view: View, p: Mapping[str, Array]) -> Array:
        return _value_at(seen, view, view.time_s + p["delay"])


def _value_at(seen: Array, view: View, at_s: Array) -> Array:
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


def _interval(time_s: Array, at_s: Array) -> NDArray[np.int64]:
    """Number of the interval that each time lies in; rows of `time_s` go with rows of `at_s`."""
    if time_s.ndim == 1:
        return np.searchsorted(time_s, at_s, side="right") - 1
    lead = np.broadcast_shapes(time_s.shape[:-1], at_s.shape[:-1])
    time_s = np.broadcast_to(time_s, (*lead, time_s.shape[-1]))
    at_s = np.broadcast_to(at_s, (*lead, at_s.shape[-1]))
    rows = [np.searchsorted(time_s[i], at_s[i], side="right") - 1 for i in np.ndindex(lead)]
    return np.array(rows, dtype=np.int64).reshape(at_s.shape)


def _take(a: Array, index: NDArray[np.int64]) -> Array:
    """Along the last axis, the axes before it broadcast."""
    lead = np.broadcast_shapes(a.shape[:-1], index.shape[:-1])
    return np.take_along_axis(
        np.broadcast_to(a, (*lead, a.shape[-1])), np.broadcast_to(index, (*lead, index.shape[-1])), axis=-1
    )
