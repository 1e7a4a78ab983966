"""First-order responses from rest to what acts on a machine: one column per source and time constant.

What a transfer function needs of the rows is their sums per batch, taken once. A response of any time constant is a
combination of the six nearest of the grid (Lagrange in log τ, off by less than 1e-4 of the signal), so poles move
freely without reading a row again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from features.rises import hold_last
from models.batchwise import padded, steps_s, unpadded
from models.thermal_exponential import lag_response

Array = NDArray[np.float64]
TAUS_S = np.geomspace(120.0, 43200.0, 15)
EXPONENTS = (1.0, 1.5, 2.0)
DRIVERS = ("speed", "load", "room")  # kinds of sources that come with the drivers
_LOG_TAUS = np.log(TAUS_S)
_PITCH = float(_LOG_TAUS[1] - _LOG_TAUS[0])
_NODES = 6
_THERMAL = ("temperature", "ambient")
_LIKE_1_K = {"rpm": 1000.0, "mm/min": 1000.0}  # drivers in other units count as they are


@dataclass(frozen=True)
class Source:
    """What acts: `kind` says what is made of the channel or input `name`.

    input: a chosen input as the design has it. speed: (|n| / 1000 rpm)^exponent. load: |another driver|. room: the
    ambient rise. gap: T − T_ambient of a sensor at the batch's start, held; a machine that does not start in
    equilibrium relaxes as if this step acted on it.
    """

    kind: str
    name: str
    exponent: float = 1.0

    @property
    def direct(self) -> bool:
        """Whether it may also act without a lag: a step at the start would only shift the error's zero."""
        return self.kind != "gap"

    def signal(self, design: Design) -> Array:
        """Its values (n,), holes held; NaN throughout a batch that has none of it."""
        if self.kind == "input":
            return _held(design, design.x[:, design.inputs.index(self.name)])
        if self.kind in ("speed", "load"):
            column = design.driver_names.index(self.name) if self.name in design.driver_names else None
            if column is None:
                return np.full(len(design.time_s), np.nan)
            scale = _LIKE_1_K.get(design.driver_units[column], 1.0)
            return np.asarray((np.abs(_held(design, design.drivers[:, column])) / scale) ** self.exponent)
        if self.kind == "room":
            return _temperature(design, self.name) - _first(design, self.name)
        return _first(design, self.name) - _first(design, ambient_of(design))


def drivers_of(design: Design) -> list[Source]:
    """What every batch of a design has of speed (one source per exponent), other drivers and ambient rise."""
    found = []
    for name, unit in zip(design.driver_names, design.driver_units, strict=True):
        if name not in design.inputs:
            found += [Source("speed", name, m) for m in EXPONENTS] if unit == "rpm" else [Source("load", name)]
    room = ambient_of(design)
    found += [Source("room", room)] if room and room not in design.inputs else []
    return [s for s in found if np.isfinite(s.signal(design)).all()]


def gaps_of(design: Design) -> list[Source]:
    """The gaps of those inputs that are plain rises of temperatures, where every batch has them."""
    room = ambient_of(design)
    channels = design.batches[0].channels if room else {}
    names = [n for n in design.inputs if n != room and n in channels and channels[n].role in _THERMAL]
    found = [Source("gap", n) for n in names]
    return [s for s in found if np.isfinite(s.signal(design)).all()]


def responses(design: Design, signals: Array, tau_s: Array) -> Array:
    """τ dv/dt + v = u from v = 0 at each batch's first row, (n, S): one time constant per signal, (S,).

    Exact for a signal held over the step before its sample.
    """
    steps = steps_s(design)
    laid = padded(design, signals)
    out = np.empty_like(laid)
    for tau in np.unique(tau_s):
        some = np.flatnonzero(tau_s == tau)
        flat = laid[:, :, some].transpose(2, 0, 1).reshape(-1, laid.shape[1])
        lagged = lag_response(flat, float(tau), np.tile(steps, len(some)))
        out[:, :, some] = lagged.reshape(len(some), *laid.shape[:2]).transpose(1, 2, 0)
    return unpadded(design, out)


@dataclass(frozen=True)
class Dictionary:
    """The columns of S sources on a design: first the signals themselves, then their responses to every τ.

    Column `(t + 1) S + s` is source s behind `TAUS_S[t]`.
    """

    design: Design
    sources: tuple[Source, ...]

    @cached_property
    def table(self) -> Design:
        """All columns as a design on the same usable rows."""
        own = self.design
        signals = np.column_stack([s.signal(own) for s in self.sources])
        columns = [signals, *(responses(own, signals, np.full(len(self.sources), tau)) for tau in TAUS_S)]
        x = np.nan_to_num(np.column_stack(columns))
        y_um = np.where(own.usable, own.y_um, np.nan)
        return replace(own, inputs=tuple(map(str, range(x.shape[1]))), x=x, y_um=y_um, input_units=(), _columns=None,
                       _parent=None)  # fmt: skip

    def places(self, which: Sequence[int], poles: Sequence[int]) -> list[int]:
        """Columns of some sources: the direct ones, then all behind each pole of the grid."""
        direct = [s for s in which if self.sources[s].direct]
        return [*direct, *((t + 1) * len(self.sources) + s for t in poles for s in which)]

    def block(self, which: Sequence[int]) -> list[int]:
        """All columns of some sources, in the order that `combination` counts them."""
        return [t * len(self.sources) + s for t in range(len(TAUS_S) + 1) for s in which]


def combination(log_tau: Array, direct: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Weights over a dictionary's columns that give poles of any place, and their slopes by log τ.

    Args:
        log_tau: (F, S, L), the L poles of each of S sources in F fits. direct: which sources act directly, (S,).

    Returns:
        (F, (T + 1) S, D + L S): D direct columns, then pole by pole; and (F, (T + 1) S, L S).
    """
    n_fits, n_sources, n_poles = log_tau.shape
    weight, slope = _interpolated(log_tau)
    own, at = np.arange(n_sources), np.flatnonzero(direct)
    lagged = np.zeros((n_fits, len(TAUS_S) + 1, n_sources, n_poles, n_sources))
    moved = np.zeros_like(lagged)
    for pole in range(n_poles):
        lagged[:, 1:, own, pole, own] = weight[:, :, pole].transpose(0, 2, 1)
        moved[:, 1:, own, pole, own] = slope[:, :, pole].transpose(0, 2, 1)
    head = np.zeros((n_fits, (len(TAUS_S) + 1) * n_sources, len(at)))
    head[:, at, np.arange(len(at))] = 1.0
    shape = (n_fits, head.shape[1], n_poles * n_sources)
    return np.concatenate([head, lagged.reshape(shape)], axis=2), moved.reshape(shape)


def _interpolated(log_tau: Array) -> tuple[Array, Array]:
    """Lagrange weights over the grid and their derivatives, (…, T)."""
    place = (log_tau - _LOG_TAUS[0]) / _PITCH
    first = np.clip(np.floor(place).astype(int) - _NODES // 2 + 1, 0, len(TAUS_S) - _NODES)
    away = (place - first)[..., None] - np.arange(_NODES)
    weight, slope = np.zeros((*log_tau.shape, len(TAUS_S))), np.zeros((*log_tau.shape, len(TAUS_S)))
    for a in range(_NODES):
        others = [b for b in range(_NODES) if b != a]
        scale = float(np.prod([a - b for b in others]))
        product = away[..., others].prod(axis=-1) / scale
        change = sum(away[..., [b for b in others if b != c]].prod(axis=-1) for c in others) / (scale * _PITCH)
        np.put_along_axis(weight, first[..., None] + a, product[..., None], axis=-1)
        np.put_along_axis(slope, first[..., None] + a, np.asarray(change)[..., None], axis=-1)
    return weight, slope


def only(design: Design, batches: Sequence[int]) -> Design:
    """Some batches of a design, in the order given."""
    rows = np.concatenate([np.arange(design.offsets[k], design.offsets[k + 1]) for k in batches])
    offsets = np.concatenate([[0], np.cumsum(np.diff(design.offsets)[list(batches)])]).astype(np.int64)
    return replace(design, batch_ids=tuple(design.batch_ids[k] for k in batches), x=design.x[rows],
                   y_um=design.y_um[rows], time_s=design.time_s[rows], offsets=offsets,
                   drivers=design.drivers[rows] if design.driver_names else design.drivers,
                   batches=tuple(design.batches[k] for k in batches) if design.batches else (), _columns=None,
                   _parent=None)  # fmt: skip


def ambient_of(design: Design) -> str:
    """The first ambient channel; "" where the design has no batches or they have none."""
    names = design.batches[0].names("ambient") if design.batches else ()
    return names[0] if names else ""


def _held(design: Design, values: Array) -> Array:
    parts = [hold_last(values[design.rows(k)]) for k in range(design.n_batches)]
    return np.concatenate([*parts, np.empty(0)])


def _temperature(design: Design, name: str) -> Array:
    """A channel's temperature (n,), holes held; NaN throughout a batch that has none."""
    out = np.full(len(design.time_s), np.nan)
    for k, batch in enumerate(design.batches):
        if name in batch.channels:
            out[design.rows(k)] = hold_last(batch.masked(name))
    return out


def _first(design: Design, name: str) -> Array:
    """Its value at each batch's start, held, (n,)."""
    values = _temperature(design, name)
    return values[design.offsets[design.group]] if len(values) else values
