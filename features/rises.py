"""Inputs of the models: temperature rises, rates, ambient-relative rises, first-order lags, start ambient.

An input is named by its channel and, behind an @, what is made of it; the plain channel name is the rise.

| name | what | unit |
|---|---|---|
| `front` | rise T(t) − T(0) of a temperature, or a driver as recorded | K, or the driver's unit |
| `front@rate` | slope of the rise over the last 10 min | K/h |
| `front@ambient` | T(t) − T_ambient(t), less its value at the start | K |
| `front@lag30min` | rise (or driver) behind a first-order lag of the stated time constant | K |
| `room@start` | value at the batch's first usable sample, held | degC |
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from data.batch import Batch
from data.errors import InputError

Array = NDArray[np.float64]
_RATE_WINDOW_S = 600.0
_LAG = re.compile(r"^lag(\d+(?:\.\d+)?)(s|min|h)$")
_SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0}


def feature(batch: Batch, name: str) -> Array:
    """One input of one batch, shape (n,), in the unit of `feature_unit`; NaN where masked.

    Raises:
        InputError: unknown channel or unknown kind of feature.
    """
    channel, _, kind = name.partition("@")
    values = batch.masked(channel)
    if kind == "start":
        return np.full(batch.n_rows, _first(values))
    base = values - _first(values) if batch.channels[channel].role in ("temperature", "ambient") else values
    if kind == "":
        return base
    if kind == "rate":
        return _rate_per_h(base, batch.step_s)
    if kind == "ambient":
        ambient = batch.names("ambient")
        if not ambient:
            raise InputError(f"feature {name!r}: machine {batch.machine} has no channel with role ambient")
        room = batch.masked(ambient[0])
        return base - (room - _first(room))
    if match := _LAG.match(kind):
        return first_order_lag(base, float(match[1]) * _SECONDS[match[2]], batch.step_s)
    raise InputError(f"feature {name!r}: unknown kind {kind!r}; allowed: rate, ambient, start, lag<number><s|min|h>")


def feature_unit(batch: Batch, name: str) -> str:
    """Unit of a feature: K, K/h, degC, or the driver's own."""
    channel, _, kind = name.partition("@")
    spec = batch.channels[channel]
    if spec.role not in ("temperature", "ambient"):
        return f"{spec.unit}/h" if kind == "rate" else spec.unit
    return {"rate": "K/h", "start": spec.unit}.get(kind, "K")


def zeroed_error_um(batch: Batch, target: str) -> Array:
    """The error channel in µm less its first usable sample, shape (n,); NaN where masked."""
    values = batch.masked(target)
    return values - _first(values)


def first_order_lag(values: Array, tau_s: float, step_s: float) -> Array:
    """Response of τ dv/dt + v = u, exact for u held over a step, started in equilibrium at u(0); shape (n,).

    A hole is bridged by holding the last input and stays NaN in the result.
    """
    held = hold_last(values)
    keep = float(np.exp(-step_s / tau_s)) if tau_s > 0 else 0.0
    out = np.empty_like(held)
    state = held[0] if len(held) else 0.0
    for i, u in enumerate(held):
        out[i] = state = keep * state + (1.0 - keep) * u if i else u
    out[~np.isfinite(values)] = np.nan
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


def _first(values: Array) -> float:
    ok = np.isfinite(values)
    return float(values[np.argmax(ok)]) if ok.any() else float("nan")


def _rate_per_h(values: Array, step_s: float) -> Array:
    back = max(1, round(_RATE_WINDOW_S / step_s)) if step_s > 0 else 1
    earlier = np.concatenate([np.full(min(back, len(values)), values[0] if len(values) else 0.0), values[:-back]])
    elapsed = np.minimum(np.arange(len(values)), back) * step_s
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(elapsed > 0, (values - earlier[: len(values)]) / elapsed * 3600.0, 0.0)
