"""Lagged responses: columns of the lag dictionary, distributed lags, and their penalised regression.

| columns | what | per 1 of |
|---|---|---|
| `front after 30 min` | the rise behind a first-order lag of that time constant | K |
| `spindle^2 after 30 min` | a driver, or the square of a speed, behind such a lag; at rest before | full scale |
| `front at start, gone in 2 h` | how far a sensor stood from the others at the start, times 1 − exp(−t/τ) | K |
| `start level, gone in 2 h` | median start temperature above 20 °C (ISO 1), times 1 − exp(−t/τ) | K |
| `clock, gone in 2 h` | 1 − exp(−t/τ): common to all starts | 1 |

All are 0 at the first row of a batch, as the error is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from features.rises import first_finite, lagged
from models.linear import Pool, Task, Tuned
from models.program import Builder
from models.solvers.batches import bridged, steps_s

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
    (m,) is not −1, it is per full scale of that raw signal (inputs that are not in K, then the drivers), to the `power`
    (m,): the largest size in training.
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
        raw = np.column_stack([design.x[:, _scaled_inputs(design)], _driver_values(design)])  # what has a full scale
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


def columns_program(b: Builder, inputs: Sequence[str], names: Sequence[str]) -> int:
    """The columns `Columns.of` as operations, but for their level at the start; `names` are those that were fitted."""
    drivers = [name for name, spec in b.known.items() if spec.role == "driver"]
    x, held = b.features(inputs), b.channels(drivers, required=False) if drivers else -1
    parts = [b.lags(x, [60.0 * lag_min for lag_min in _LAGS_MIN], 1.0)]
    powers = [(d, power) for d, name in enumerate(drivers) for power in _powers(b.known[name].unit)]
    if powers:
        signals = b.pick(held, [d for d, _ in powers])
        load = b.add("power", [signals], len(powers), exponents=[power for _, power in powers])
        at = np.arange(len(_LAGS_MIN) * len(powers)).reshape(len(_LAGS_MIN), len(powers))
        parts.append(b.pick(b.lags(load, [60.0 * lag_min for lag_min in _LAGS_MIN], 0.0), at.T.ravel().tolist()))
    gone = b.lags(b.constant(1.0), [60.0 * g for g in _CLOCK_GONE_MIN], 0.0)
    parts.append(gone)
    thermal = [c for c in dict.fromkeys(name.partition("@")[0] for name in inputs) if b.thermal(c)]
    if thermal:
        first = b.add("first", [b.channels(thermal)], len(thermal))
        level = b.add("median", [first], 1)
        away = b.sub(b.join(level, first), b.join(b.constant(_REFERENCE_DEGC), *[level] * len(thermal)))
        if len(thermal) == 1:
            away = b.pick(away, [0])
        wide = b.size(away)
        places = np.repeat(np.arange(len(_CLOCK_GONE_MIN) - len(_GONE_MIN), len(_CLOCK_GONE_MIN)), wide)
        shares = b.pick(gone, places.tolist())
        parts.append(b.add("mul", [b.join(*[away] * len(_GONE_MIN)), shares], wide * len(_GONE_MIN)))
    whole = b.join(*parts)
    if b.size(whole) != len(names):
        raise InputError(
            f"lag_dictionary: the machine's channels give {b.size(whole)} columns, the model was fitted with "
            f"{len(names)}; give the machine file that it was trained with"
        )
    return whole


@dataclass(frozen=True)
class _Column:
    name: str
    values: Array
    prior_K: float = 1.0
    source: int = -1
    power: int = 1
    reach: int = UNDRIVEN


def _scaled_inputs(design: Design) -> list[int]:
    return [c for c, unit in enumerate(design.input_units) if unit not in _KELVIN]


def _driver_values(design: Design) -> Array:
    return design.drivers if design.driver_names else np.empty((len(design.time_s), 0))


def _inputs(design: Design) -> list[_Column]:
    held = bridged(design, design.x)
    source = {c: i for i, c in enumerate(_scaled_inputs(design))}
    delayed = _lagged_by_batch(design, held, at_rest=False)
    return [
        _Column(
            f"{name} after {lag_min:g} min",
            values[:, c],
            _FULL_SCALE_K if c in source else 1.0,
            source.get(c, -1),
            reach=PROMPT if lag_min <= _PROMPT_MIN else UNDRIVEN,
        )
        for lag_min, values in zip(_LAGS_MIN, delayed, strict=True)
        for c, name in enumerate(design.inputs)
    ]


def _drivers(design: Design) -> list[_Column]:
    held = bridged(design, _driver_values(design))
    first = len(_scaled_inputs(design))
    powers = [(d, power) for d, unit in enumerate(design.driver_units) for power in _powers(unit)]
    loads = np.abs(held)[:, [d for d, _ in powers]] ** np.array([float(power) for _, power in powers])
    delayed = _lagged_by_batch(design, loads, at_rest=True)
    out = []
    for c, (d, power) in enumerate(powers):
        label = f"{design.driver_names[d]}^{power}" if power > 1 else design.driver_names[d]
        for lag_min, values in zip(_LAGS_MIN, delayed, strict=True):
            out.append(_Column(f"{label} after {lag_min:g} min", values[:, c], _FULL_SCALE_K, first + d, power, DRIVEN))
    return out


def _powers(unit: str) -> tuple[int, ...]:
    """Friction and windage grow with speed and its square; a feed acts through the distance travelled."""
    return (1, 2) if unit == "rpm" else (1,)


def _starts(design: Design) -> list[_Column]:
    """Columns of the state at the start; beyond the clock they need the batches themselves."""
    out = [_Column(f"clock, gone in {g:g} min", _gone(design, g), _FULL_SCALE_K) for g in _CLOCK_GONE_MIN]
    channels = list(dict.fromkeys(name.partition("@")[0] for name in design.inputs))
    if not design.batches:
        return out
    thermal = [c for c in channels if design.batches[0].channels[c].role in _THERMAL]
    if not thermal:
        return out
    start_degC = np.array([[first_finite(b.masked(c)) for c in thermal] for b in design.batches])
    level_degC = np.median(start_degC, axis=1)
    for g in _GONE_MIN:
        gone = _gone(design, g)
        out.append(_Column(f"start level, gone in {g:g} min", (level_degC - _REFERENCE_DEGC)[design.group] * gone))
        if len(thermal) > 1:
            away_K = (start_degC - level_degC[:, None])[design.group]
            out += [_Column(f"{c} at start, gone in {g:g} min", away_K[:, i] * gone) for i, c in enumerate(thermal)]
    return out


def _lagged_by_batch(design: Design, values: Array, *, at_rest: bool) -> list[Array]:
    """Values (n, c) behind a first-order lag of each time constant; before a batch they are 0 or its first ones."""
    out, steps = [np.empty(values.shape) for _ in _LAGS_MIN], steps_s(design)
    for k in np.flatnonzero(np.diff(design.offsets)).tolist():
        own = values[design.rows(k)]
        before = np.zeros(own.shape[1]) if at_rest else own[0]
        for behind, lag_min in zip(out, _LAGS_MIN, strict=True):
            behind[design.rows(k)] = _lagged(own, before, 60.0 * lag_min / steps[k])
    return out


def _gone(design: Design, gone_min: float) -> Array:
    since_s = design.time_s - design.time_s[design.offsets[design.group]]
    return np.asarray(-np.expm1(-since_s / (60 * gone_min)))


Response = tuple[float, float]  # delay in s, time constant in s


def lag_responses(design: Design, responses: Sequence[Response]) -> Array:
    """Every response of every input, (n, m, p): a first-order lag, then a delay; of 0 and 0 it is the input itself.

    Before a batch starts an input has its first value, which is 0 for a rise; a driver is at rest (0). A delay that is
    no multiple of the batch's step is interpolated. Holes are bridged by the last value; NaN throughout a batch that
    lacks the input wholly.
    """
    x, steps = bridged(design, design.x), steps_s(design)
    drives = np.array([name.partition("@")[0] in design.driver_names for name in design.inputs], bool)
    out = np.empty((len(x), len(responses), x.shape[1]))
    for k in range(design.n_batches):
        own = x[design.rows(k)]
        if np.isnan(own).all():
            out[design.rows(k)] = np.nan
            continue
        before = np.where(drives, 0.0, own[0])
        for i, (delay_s, tau_s) in enumerate(responses):
            out[design.rows(k), i] = _delayed(_lagged(own, before, tau_s / steps[k]), before, delay_s / steps[k])
    return out


def _lagged(x: Array, before: Array, tau: float) -> Array:
    """τ dv/dt + v = x (n, p) from v = `before` in the first row, exact for x held over each step; τ in steps."""
    return x if tau == 0 or len(x) < 2 else lagged(x, before, float(np.exp(-1.0 / tau)))


def _delayed(x: Array, before: Array, delay: float) -> Array:
    """x (n, p) a delay (in steps) later, `before` until then."""
    if delay == 0 or len(x) < 2:
        return x
    whole = int(delay + 1e-9)
    part = max(delay - whole, 0.0) if delay - whole > 1e-6 else 0.0
    earlier = np.vstack([np.tile(before, (whole + 1, 1)), x])[: len(x) + 1]
    return (1.0 - part) * earlier[1:] + part * earlier[:-1]


CRITERIA = ("forward", "leave_batch_out", "aic", "bic")
RIDGES = (1e-2, 1e-4, 1e-6, 1e-8)  # of the mean variance of the columns, strongest first
_ORDERS = (0, 1, 2, 3, 4, 6, 9, 12, 18, 24, 36, 48)


@dataclass(frozen=True)
class Shape:
    """Coefficients β (m, p) of m responses of p inputs are `mix` (m, d) times d free ones per input."""

    responses: tuple[int, ...]
    mix: Array


def free_shapes(max_lags: int) -> list[Shape]:
    """Lags 0 … q, each free, for the orders q up to `max_lags`."""
    return [Shape(tuple(range(q + 1)), np.eye(q + 1)) for q in _orders(max_lags)]


def polynomial_shapes(max_lags: int, degree: int) -> list[Shape]:
    """Lags 0 … q on polynomials of a degree, as orthonormal columns; short orders are free (Almon 1965)."""
    shapes = []
    for q in _orders(max_lags):
        powers = np.vander(np.linspace(-1.0, 1.0, q + 1), degree + 1, increasing=True)
        mix = np.eye(q + 1) if q <= degree else np.linalg.qr(powers)[0]
        shapes.append(Shape(tuple(range(q + 1)), mix))
    return shapes


def koyck_shapes(n_decays: int) -> list[Shape]:
    """The input alone, or with one of `n_decays` geometric tails, which stand behind it (Koyck 1954)."""
    return [Shape((0,), np.eye(1)), *(Shape((0, j), np.eye(2)) for j in range(1, n_decays + 1))]


def _orders(max_lags: int) -> list[int]:
    return sorted({q for q in _ORDERS if q < max_lags} | {max_lags})


class LagRegression(Tuned):
    """Ridge regression on m responses of p inputs, columns response by response; chooses shape and penalty."""

    key = "distributed_lag"
    summary = "regression of a distributed lag"
    source = "Hoerl and Kennard (1970)"

    def __init__(self, shapes: Sequence[Shape], order_by: str) -> None:
        super().__init__()
        self.shapes, self.order_by = list(shapes), order_by
        self.n_responses = 1 + max(r for shape in shapes for r in shape.responses)

    def solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        """Coefficients (F, m p), and per fold the index of the shape and the penalty k."""
        if self.order_by in ("aic", "bic"):
            return self._refit(task, np.argmin(self._criterion(task), axis=1))
        return self._solve(task)

    def _path(self, pool: Pool) -> Array:
        return self._fits(pool)[0]

    def _fits(self, pool: Pool, count: bool = False) -> tuple[Array, Array]:
        """Coefficients (S, m p, G), and with `count` the effective parameters (S, G) including the intercept."""
        sets, columns = pool.xy.shape
        p = columns // self.n_responses
        path = np.zeros((sets, columns, len(self.shapes) * len(RIDGES)))
        parameters = np.zeros((sets, path.shape[2]))
        for s, shape in enumerate(self.shapes):
            at = (np.array(shape.responses)[:, None] * p + np.arange(p)).ravel()
            xx, xy = pool.xx[:, at[:, None], at], pool.xy[:, at]
            mixed = shape.mix.shape[0] != shape.mix.shape[1]
            mix = np.kron(shape.mix, np.eye(p))
            if mixed:
                xx, xy = mix.T @ xx @ mix, xy @ mix
            size = np.einsum("sjj->s", xx) / len(xx[0])
            size = np.where(size > 0, size, 1.0)
            for r, k in enumerate(RIDGES):
                matrix = xx + (k * size)[:, None, None] * np.eye(len(xx[0]))
                coef = np.linalg.solve(matrix, xy[:, :, None])[:, :, 0]
                g = s * len(RIDGES) + r
                path[:, at, g] = coef @ mix.T if mixed else coef
                if count:
                    parameters[:, g] = 1.0 + np.einsum("sij,sji->s", np.linalg.inv(matrix), xx)
        return path, parameters

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {"shape": chosen // len(RIDGES), "k": np.array(RIDGES)[chosen % len(RIDGES)]}

    def _criterion(self, task: Task) -> Array:
        """AIC or BIC (F, G), counting effective rows as the longest lags with the weakest penalty leave them."""
        pool, blocks = task.pool, task.blocks
        path, parameters = self._fits(pool, count=True)
        fold, block = np.nonzero(task.masks)
        S_um = blocks.left_out_S_um(block, pool, fold, path)
        sse = np.zeros(parameters.shape)
        np.add.at(sse, fold, S_um**2 * np.maximum(blocks.count[block] - 1.0, 1.0)[:, None])
        rows = effective_rows(task, path[:, :, -1])[1]
        weight = 2.0 if self.order_by == "aic" else np.log(rows)[:, None]
        fit = np.log(np.maximum(sse, np.finfo(float).tiny) / pool.count[:, None])
        return np.asarray(rows[:, None] * fit + weight * parameters)


def intercepts_um(task: Task, coef: Array) -> Array:
    """Intercepts (F,) of coefficients (F, columns) fitted about the means."""
    moments, pool = task.design.moments, task.pool
    mean_um = pool.mean_y + moments.shift_y
    return np.asarray(mean_um - np.einsum("fj,fj->f", pool.mean_x + moments.shift_x, coef))


def effective_rows(task: Task, coef: Array) -> tuple[Array, Array]:
    """Lag-one autocorrelation ρ of each fold's residuals inside its batches, and n (1 − ρ)/(1 + ρ); (F,) each.

    Source: M. Bartlett, Some aspects of the time-correlation problem, J. R. Stat. Soc. 98 (1935).
    """
    design, usable = task.design, task.design.usable
    residual = np.where(usable[:, None], design.y_um[:, None] - design.x @ coef.T - intercepts_um(task, coef), 0.0)
    residual *= task.masks.T[design.group]
    together = (design.group[1:] == design.group[:-1])[:, None]
    power = np.einsum("nf,nf->f", residual, residual)
    product = np.einsum("nf,nf->f", residual[1:] * together, residual[:-1])
    rho = np.clip(np.divide(product, power, out=np.zeros_like(power), where=power > 0), 0.0, 1.0)
    return rho, np.maximum(task.pool.count * (1.0 - rho) / (1.0 + rho), 2.0)
