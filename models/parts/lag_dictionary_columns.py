"""What a lag dictionary offers: each input and driver at several delays, and what the start of a run says.

| columns | what | per 1 of |
|---|---|---|
| `front after 30 min` | the rise behind a first-order lag of that time constant | K |
| `spindle^2 after 30 min` | a driver, or the square of a speed, behind such a lag; at rest before | full scale |
| `front at start, gone in 2 h` | how far a sensor stood from the others at the start, times 1 − exp(−t/τ) | K |
| `start level, gone in 2 h` | median start temperature above 20 °C (ISO 1), times 1 − exp(−t/τ) | K |
| `clock, gone in 2 h` | 1 − exp(−t/τ): what every start does | 1 |

All are 0 at the first row of a batch, as the error is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from features.rises import first_order_lag
from models.batchwise import bridged

Array = NDArray[np.float64]
PROMPT, UNDRIVEN, DRIVEN = 0, 1, 2  # how far a column reaches: inputs of now, what is measured, what is commanded
_PROMPT_MIN = 10.0
_LAGS_MIN = (0.0, 10.0, 30.0, 120.0, 480.0)
_GONE_MIN = (30.0, 120.0, 480.0)
_CLOCK_GONE_MIN = (10.0, *_GONE_MIN)
_REFERENCE_DEGC = 20.0
_FULL_SCALE_K = 10.0  # a driver at full scale, and the clock, count like a rise of so many K
_KELVIN = ("K", "degC")
_THERMAL = ("temperature", "ambient")


@dataclass(frozen=True)
class Columns:
    """Columns x (n, m) of a design, their names, and what sets their prior spread.

    `prior_K` (m,) is the size that a column's coefficient is expected to have, relative to one per K; where `source`
    (m,) is not −1, it is per full scale of that column of `raw`, to the `power` (m,): the largest size in training.
    """

    x: Array
    names: tuple[str, ...]
    prior_K: Array
    source: NDArray[np.int64]
    power: Array
    reach: NDArray[np.int64]
    largest: Array  # (K, r) largest size of each raw signal in each batch

    def prior(self, train: Sequence[int]) -> Array:
        """Expected relative size of the coefficients (m,) for a training set."""
        largest = self.largest[list(train)].max(axis=0, initial=0.0)
        full = np.where(largest > 0, largest, 1.0)
        scale = np.append(full, 1.0)[self.source] ** self.power
        return np.asarray(self.prior_K / scale)

    @classmethod
    def of(cls, design: Design) -> Columns:
        parts = [*_inputs(design), *_drivers(design), *_starts(design)]
        raw = _raw_signals(design)
        held = np.nan_to_num(np.abs(raw))
        largest = np.array([held[design.rows(k)].max(axis=0, initial=0.0) for k in range(design.n_batches)])
        x = np.column_stack([p.values for p in parts]) if parts else np.empty((len(design.time_s), 0))
        for k in range(design.n_batches):
            rows = design.rows(k)
            if rows.stop > rows.start:
                x[rows] -= x[rows.start]
        return cls(
            x,
            tuple(p.name for p in parts),
            np.array([p.prior_K for p in parts]),
            np.array([p.source for p in parts], np.int64),
            np.array([float(p.power) for p in parts]),
            np.array([p.reach for p in parts], np.int64),
            largest.reshape(design.n_batches, raw.shape[1]),
        )


@dataclass(frozen=True)
class _Column:
    name: str
    values: Array
    prior_K: float = 1.0
    source: int = -1
    power: int = 1
    reach: int = UNDRIVEN


def _raw_signals(design: Design) -> Array:
    """Inputs that are not in K, then the drivers: what has a full scale."""
    return np.column_stack([design.x[:, _scaled_inputs(design)], _driver_values(design)])


def _scaled_inputs(design: Design) -> list[int]:
    return [c for c, unit in enumerate(design.input_units) if unit not in _KELVIN]


def _driver_values(design: Design) -> Array:
    return design.drivers if design.driver_names else np.empty((len(design.time_s), 0))


def _inputs(design: Design) -> list[_Column]:
    held = bridged(design, design.x)
    source = {c: i for i, c in enumerate(_scaled_inputs(design))}
    return [
        _Column(
            f"{name} after {lag_min:g} min",
            _lagged(design, held[:, c], lag_min, at_rest=False),
            _FULL_SCALE_K if c in source else 1.0,
            source.get(c, -1),
            reach=PROMPT if lag_min <= _PROMPT_MIN else UNDRIVEN,
        )
        for lag_min in _LAGS_MIN
        for c, name in enumerate(design.inputs)
    ]


def _drivers(design: Design) -> list[_Column]:
    held = bridged(design, _driver_values(design))
    first = len(_scaled_inputs(design))
    out = []
    for d, (name, unit) in enumerate(zip(design.driver_names, design.driver_units, strict=True)):
        # Friction and windage grow with speed and its square; a feed acts through the distance travelled.
        for power in (1, 2) if unit == "rpm" else (1,):
            for lag_min in _LAGS_MIN:
                values = _lagged(design, np.abs(held[:, d]) ** power, lag_min, at_rest=True)
                label = f"{name}^{power}" if power > 1 else name
                out.append(_Column(f"{label} after {lag_min:g} min", values, _FULL_SCALE_K, first + d, power, DRIVEN))
    return out


def _starts(design: Design) -> list[_Column]:
    """How the machine stood at the start: known only where the batches themselves are at hand."""
    out = [_Column(f"clock, gone in {g:g} min", _gone(design, g), _FULL_SCALE_K) for g in _CLOCK_GONE_MIN]
    channels = list(dict.fromkeys(name.partition("@")[0] for name in design.inputs))
    if not design.batches:
        return out
    thermal = [c for c in channels if design.batches[0].channels[c].role in _THERMAL]
    if not thermal:
        return out
    start_degC = np.array([[_first(b.masked(c)) for c in thermal] for b in design.batches])
    level_degC = np.median(start_degC, axis=1)
    for g in _GONE_MIN:
        gone = _gone(design, g)
        out.append(_Column(f"start level, gone in {g:g} min", (level_degC - _REFERENCE_DEGC)[design.group] * gone))
        if len(thermal) > 1:
            away_K = (start_degC - level_degC[:, None])[design.group]
            out += [_Column(f"{c} at start, gone in {g:g} min", away_K[:, i] * gone) for i, c in enumerate(thermal)]
    return out


def _lagged(design: Design, values: Array, lag_min: float, *, at_rest: bool) -> Array:
    start = 0.0 if at_rest else None
    return _by_batch(design, lambda rows: first_order_lag(values[rows], 60.0 * lag_min, _step_s(design, rows), start))


def _gone(design: Design, gone_min: float) -> Array:
    return _by_batch(design, lambda rows: -np.expm1(-(design.time_s[rows] - design.time_s[rows][0]) / (60 * gone_min)))


def _by_batch(design: Design, values: Callable[[slice], Array]) -> Array:
    rows = [design.rows(k) for k in range(design.n_batches)]
    return np.concatenate([np.empty(0), *(values(r) for r in rows if r.stop > r.start)])


def _step_s(design: Design, rows: slice) -> float:
    time_s = design.time_s[rows]
    return float((time_s[-1] - time_s[0]) / (len(time_s) - 1)) if len(time_s) > 1 else 0.0


def _first(values: Array) -> float:
    ok = np.isfinite(values)
    return float(values[np.argmax(ok)]) if ok.any() else float("nan")
