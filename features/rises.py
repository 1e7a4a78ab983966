"""Inputs of the models: temperature rises, rates, ambient-relative rises, first-order lags, start ambient.

An input is named by its channel and, behind an @, what is made of it; the plain channel name is the rise.

| name | what | unit |
|---|---|---|
| `front` | rise T(t) − T(0) of a temperature, or a driver as recorded | K, or the driver's unit |
| `front@rate` | slope of the rise over the last 10 min (since the first usable sample where that is nearer) | K/h |
| `front@ambient` | T(t) − T_ambient(t), less its first usable value | K |
| `front@lag30min` | rise behind a first-order lag of the stated time constant | K |
| `speed@lag30min` | driver behind the same lag, at rest (0) when the batch starts | the driver's unit |
| `room@start` | value at the batch's first usable sample, held | degC |
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError, closest
from data.sweeps import position_bins, sweep_numbers

RATE_WINDOW_S = 600.0
_THERMAL = ("temperature", "ambient")
_LAG = re.compile(r"^lag(\d+(?:\.\d+)?)(s|min|h)$")
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def feature(batch: Batch, name: str) -> Array:
    """One input of one batch, shape (n,), in the unit of `feature_unit`; NaN where masked.

    Raises:
        InputError: unknown channel or unknown kind of feature.
    """
    channel, kind = _parts(name)
    values = batch.masked(channel)
    thermal = batch.channels[channel].role in _THERMAL
    if kind == "start":
        return np.full(batch.n_rows, first_finite(values))
    if kind == "ambient":
        values = values - batch.masked(_ambient(batch, name))
        return values - first_finite(values)
    base = values - first_finite(values) if thermal else values
    if kind == "rate":
        return _rate_per_h(base, batch.step_s)
    if _LAG.match(kind):
        return first_order_lag(base, parsed_feature(name)[2], batch.step_s, start=None if thermal else 0.0)
    return base


def feature_unit(batch: Batch, name: str) -> str:
    """Unit of a feature: K, K/h, degC, or the driver's own.

    Raises:
        InputError: unknown channel or unknown kind of feature.
    """
    channel, kind = _parts(name)
    if channel not in batch.channels:
        raise InputError(
            f"batch {batch.batch_id} of {batch.machine}: no channel {channel!r}; {closest(channel, batch.channels)}"
        )
    spec = batch.channels[channel]
    if kind == "ambient":
        _ambient(batch, name)
    if spec.role not in _THERMAL:
        return f"{spec.unit}/h" if kind == "rate" else spec.unit
    return {"rate": "K/h", "start": spec.unit}.get(kind, "K")


def zeroed_error_um(batch: Batch, target: str) -> Array:
    """The error channel in µm less its first usable sample, shape (n,); NaN where masked.

    An error along an axis less that of the first sweep at the same position, E(P, t) − E(P, 0): linear between the
    first sweep's positions, NaN beyond them.
    """
    values = batch.masked(target)
    channel = batch.channels[target].position
    return values - (_first_sweep_um(batch, values, channel) if channel else first_finite(values))


def first_order_lag(values: Array, tau_s: float, step_s: float, start: float | None = None) -> Array:
    """Response of τ dv/dt + v = u, exact for u held over the step before its sample; shape (n,).

    The first value is the state: `start`, or u(0), which is equilibrium. A hole is bridged by holding the last
    input and stays NaN in the result. A time constant of 0 gives the input itself.
    """
    if tau_s == 0 or len(values) == 0:
        return values.copy()
    held = hold_last(values)
    out = lagged(held, held[0] if start is None else start, float(np.exp(-step_s / tau_s)))
    out[~np.isfinite(values)] = np.nan
    return out


def lagged(values: Array, start: Array | float, keep: float) -> Array:
    """v(k) = keep v(k−1) + (1 − keep) u(k) along rows (n, …) without holes, v = `start` in the first row."""
    from scipy.signal import lfilter  # takes long to load

    out = np.empty_like(values)
    out[:1] = start
    out[1:], _ = lfilter([1.0 - keep], [1.0, -keep], values[1:], axis=0, zi=keep * out[:1])
    return out


def hold_last(values: Array) -> Array:
    """NaN replaced by the last finite value before it (the first finite one at the start), shape (n,)."""
    ok = np.isfinite(values)
    if ok.all() or not ok.any():
        return values.copy()
    last = np.maximum.accumulate(np.where(ok, np.arange(len(values)), -1))
    return values[np.where(last < 0, int(np.argmax(ok)), last)]


def temperature_inputs(
    batches: Sequence[Batch], roles: tuple[str, ...] = ("temperature", "ambient")
) -> tuple[str, ...]:
    """Candidate channels in the first batch's order."""
    return batches[0].names(*roles) if batches else ()


def _first_sweep_um(batch: Batch, error_um: Array, channel: str) -> Array:
    """The first sweep's error at every row's position, (n,); NaN without a position, or outside that sweep."""
    position_mm = batch.masked(channel)
    read = np.flatnonzero(np.isfinite(error_um) & np.isfinite(position_mm))
    if not len(read):
        return np.full(batch.n_rows, np.nan)
    at_mm = position_mm[read]
    bins = position_bins(at_mm)
    first = read[sweep_numbers(batch.time_s[read], at_mm) == 0]
    here, rows = np.unique(bins[: len(first)], return_index=True)  # of several readings of a position the first
    known_mm, known_um = position_mm[first[rows]], error_um[first[rows]]
    out = np.full(batch.n_rows, np.nan)
    inside = (bins >= here[0]) & (bins <= here[-1])
    out[read[inside]] = np.interp(at_mm[inside], known_mm, known_um)
    return out


def first_finite(values: Array) -> float:
    """The first finite value; NaN where there is none."""
    ok = np.isfinite(values)
    return float(values[np.argmax(ok)]) if ok.any() else float("nan")


def _rate_per_h(values: Array, step_s: float) -> Array:
    """Slope to the sample 10 min before, or to the first usable one where that is nearer; 0 there."""
    ok = np.isfinite(values)
    if step_s <= 0 or not ok.any():
        return np.where(ok, 0.0, np.nan)
    row = np.arange(len(values))
    earlier = np.maximum(row - max(1, round(RATE_WINDOW_S / step_s)), int(np.argmax(ok)))
    elapsed_h = np.maximum(row - earlier, 1) * step_s / 3600.0
    return (values - values[np.minimum(earlier, row)]) / elapsed_h


def parsed_feature(name: str) -> tuple[str, str, float]:
    """Channel, kind (`rise`, `rate`, `ambient`, `start` or `lag`) and time constant in s of a feature name.

    Raises:
        InputError: an unknown kind.
    """
    channel, kind = _parts(name)
    if match := _LAG.match(kind):
        return channel, "lag", float(match[1]) * _SECONDS[match[2]]
    return channel, kind or "rise", 0.0


def _parts(name: str) -> tuple[str, str]:
    """Channel and kind of a feature name; the kind is checked."""
    channel, at, kind = name.partition("@")
    if at and kind not in ("rate", "ambient", "start") and not _LAG.match(kind):
        raise InputError(
            f"feature {name!r}: unknown kind {kind!r}; allowed: rate, ambient, start, lag<number><s|min|h>"
        )
    return channel, kind


def _ambient(batch: Batch, name: str) -> str:
    """The channel that ambient-relative features are taken against: the first ambient one."""
    channel = name.partition("@")[0]
    ambient = batch.names("ambient")
    if not ambient:
        raise InputError(f"feature {name!r}: machine {batch.machine} has no channel with role ambient")
    if channel in batch.channels and batch.channels[channel].role not in _THERMAL:
        raise InputError(
            f"feature {name!r}: channel {channel!r} is a {batch.channels[channel].role}; expected a temperature"
        )
    return ambient[0]
