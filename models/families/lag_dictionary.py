"""Family: lagged inputs, drivers and start states with a batch-wise random drift, averaged over settings.

| columns | what | per 1 of |
|---|---|---|
| `front after 30 min` | the rise behind a first-order lag of that time constant | K |
| `spindle^2 after 30 min` | a driver, or the square of a speed, behind the same lag; at rest before | full scale |
| `front at start, gone in 2 h` | difference of a sensor from the others at the start, times 1 − exp(−t/τ) | K |
| `start level, gone in 2 h` | median start temperature above 20 °C (ISO 1), times 1 − exp(−t/τ) | K |
| `clock, gone in 2 h` | 1 − exp(−t/τ): common to all starts | 1 |

All are 0 at the first row of a batch, as the error is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import stdtrit

from data.arrays import Array
from data.checks.base import THERMAL
from data.errors import InputError
from features.design import Design
from features.rises import first_finite
from models.base import Family, Plain
from models.metrics import SIDE_OF_90
from models.numerics.batch_process import BatchProcess, Windows
from models.numerics.batches import bridged, by_batch, too_few_rows
from models.numerics.lags import lag_responses
from models.program import Builder

PROMPT, UNDRIVEN, DRIVEN = 0, 1, 2  # how far a column reaches: inputs of now, what is measured, what is commanded
_PROMPT_MIN = 10.0
_LAGS_MIN = (0.0, 10.0, 30.0, 120.0, 480.0)
_LAGS_S = [60.0 * lag_min for lag_min in _LAGS_MIN]
_GONE_MIN = (30.0, 120.0, 480.0)
_CLOCK_GONE_MIN = (10.0, *_GONE_MIN)
_REFERENCE_DEGC = 20.0
_FULL_SCALE_K = 10.0  # a driver at full scale, and the clock, count like a rise of so many K
_KELVIN = ("K", "degC")

_LEVELS = (0.1, 10.0, 1000.0)  # prior variance of a gain per K, in units of what no column explains
_STEADY = (1.0, 100.0)  # offset and noise of that, against its walk in an hour
_SHARPNESS = 10.0  # a setting with a tenth more residual counts e^-1 as much
_ODD = 6.0  # a batch is mistrusted whose residual is so many times the median of the others without its pull
_ONE_ODD_IN = 4  # batches at most, so that the others are a majority
_FEWEST_BATCHES = 3
_FEWEST_WINDOWS = 4


@dataclass(frozen=True)
class Column:
    """A column of a design (n,): how far it reaches, and what sets the prior spread of its coefficient.

    `prior_K` is the size that the coefficient is expected to have, relative to one per K; where `source` is not −1, it
    is per full scale of that raw signal (inputs that are not in K, then the drivers), to the `power`: the largest size
    in training.
    """

    name: str
    values: Array
    prior_K: float = 1.0
    source: int = -1
    power: int = 1
    reach: int = UNDRIVEN


@dataclass(frozen=True)
class Columns:
    """All columns of a design, as x (n, m) relative to each batch's start."""

    x: Array
    each: tuple[Column, ...]
    largest: Array  # (K, r) largest size of each raw signal in each batch

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.each)

    @cached_property
    def reach(self) -> NDArray[np.int64]:
        return np.array([c.reach for c in self.each], np.int64)

    def prior(self, train: Sequence[int]) -> Array:
        """Expected relative size of the coefficients (m,) for a training set."""
        largest = self.largest[list(train)].max(axis=0, initial=0.0)
        full = np.append(np.where(largest > 0, largest, 1.0), 1.0)
        return np.array([c.prior_K / full[c.source] ** c.power for c in self.each])

    @classmethod
    def of(cls, design: Design) -> Columns:
        scaled = [c for c, unit in enumerate(design.input_units) if unit not in _KELVIN]
        drivers = design.drivers if design.driver_names else np.empty((len(design.time_s), 0))
        held = np.nan_to_num(np.abs(np.column_stack([design.x[:, scaled], drivers])))  # what has a full scale
        largest = np.array([held[design.rows(k)].max(axis=0, initial=0.0) for k in range(design.n_batches)])
        each = (*_inputs(design, scaled), *_drivers(design, drivers, len(scaled)), *_starts(design))
        x = np.column_stack([c.values for c in each])
        x -= x[design.offsets[design.group]]
        return cls(x, each, largest.reshape(design.n_batches, held.shape[1]))


def columns_program(b: Builder, inputs: Sequence[str], names: Sequence[str]) -> int:
    """The columns `Columns.of` as operations, but for their level at the start; `names` are those that were fitted."""
    drivers = [name for name, spec in b.known.items() if spec.role == "driver"]
    x, held = b.features(inputs), b.channels(drivers, required=False) if drivers else -1
    parts = [b.lags(x, _LAGS_S, 1.0)]
    powers = [(d, power) for d, name in enumerate(drivers) for power in _powers(b.known[name].unit)]
    if powers:
        signals = b.pick(held, [d for d, _ in powers])
        load = b.add("power", [signals], len(powers), exponents=[power for _, power in powers])
        at = np.arange(len(_LAGS_MIN) * len(powers)).reshape(len(_LAGS_MIN), len(powers))
        parts.append(b.pick(b.lags(load, _LAGS_S, 0.0), at.T.ravel().tolist()))
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


def _inputs(design: Design, scaled: Sequence[int]) -> list[Column]:
    source = {c: i for i, c in enumerate(scaled)}
    lags = lag_responses(design, bridged(design, design.x), [(0.0, tau_s) for tau_s in _LAGS_S], at_rest=False)
    return [
        Column(
            f"{name} after {lag_min:g} min",
            lags[:, i, c],
            _FULL_SCALE_K if c in source else 1.0,
            source.get(c, -1),
            reach=PROMPT if lag_min <= _PROMPT_MIN else UNDRIVEN,
        )
        for i, lag_min in enumerate(_LAGS_MIN)
        for c, name in enumerate(design.inputs)
    ]


def _drivers(design: Design, drivers: Array, first: int) -> list[Column]:
    """Of the drivers (n, d), whose full scales are those from `first` on."""
    powers = [(d, power) for d, unit in enumerate(design.driver_units) for power in _powers(unit)]
    loads = np.abs(bridged(design, drivers))[:, [d for d, _ in powers]] ** np.array([float(m) for _, m in powers])
    lags = lag_responses(design, loads, [(0.0, tau_s) for tau_s in _LAGS_S])
    return [
        Column(f"{label} after {lag_min:g} min", lags[:, i, c], _FULL_SCALE_K, first + d, power, DRIVEN)
        for c, (d, power) in enumerate(powers)
        for label in [f"{design.driver_names[d]}^{power}" if power > 1 else design.driver_names[d]]
        for i, lag_min in enumerate(_LAGS_MIN)
    ]


def _powers(unit: str) -> tuple[int, ...]:
    """Friction and windage grow with speed and its square; a feed acts through the distance travelled."""
    return (1, 2) if unit == "rpm" else (1,)


def _starts(design: Design) -> list[Column]:
    """Columns of the state at the start; beyond the clock they need the batches themselves."""
    out = [Column(f"clock, gone in {g:g} min", _gone(design, g), _FULL_SCALE_K) for g in _CLOCK_GONE_MIN]
    channels = list(dict.fromkeys(name.partition("@")[0] for name in design.inputs))
    if not design.batches:
        return out
    thermal = [c for c in channels if design.batches[0].channels[c].role in THERMAL]
    if not thermal:
        return out
    start_degC = np.array([[first_finite(b.masked(c)) for c in thermal] for b in design.batches])
    level_degC = np.median(start_degC, axis=1)
    for g in _GONE_MIN:
        gone = _gone(design, g)
        out.append(Column(f"start level, gone in {g:g} min", (level_degC - _REFERENCE_DEGC)[design.group] * gone))
        if len(thermal) > 1:
            away_K = (start_degC - level_degC[:, None])[design.group]
            out += [Column(f"{c} at start, gone in {g:g} min", away_K[:, i] * gone) for i, c in enumerate(thermal)]
    return out


def _gone(design: Design, gone_min: float) -> Array:
    since_s = design.time_s - design.time_s[design.offsets[design.group]]
    return np.asarray(-np.expm1(-since_s / (60 * gone_min)))


@dataclass(frozen=True)
class _Setting:
    """Prior of the columns, their reach, and steadiness of the residual."""

    level: float
    reach: int
    steady: float

    def variance(self, columns: Columns, prior: Array) -> Array:
        return np.where(columns.reach > self.reach, 0.0, self.level * self.steady * prior**2)


_SETTINGS = tuple(
    _Setting(level, reach, steady) for level in _LEVELS for reach in (PROMPT, UNDRIVEN, DRIVEN) for steady in _STEADY
)
_USUAL_SETTING = _Setting(10.0, DRIVEN, 1.0)


class LagDictionary(Family):
    """error_um = x(t) · β over a dictionary of delayed inputs, drivers and start states, β by pooling batches.

    Columns: each input as it is and behind lags of 10 min to 8 h, each driver (a speed also squared) likewise, how the
    machine was at the start, and the clock. A batch's error is x · β and a drift of its own that no column explains,
    so that the fit is generalised least squares with a ridge prior (`models.numerics.batch_process`). The prediction is
    0 at the first row.

    Eighteen settings (three levels of the prior; inputs of now, or also slow ones and the start, or also drivers; a
    drift that wanders or is mostly constant) are averaged with weights S^−10, S the mean residual standard deviation of
    the training batches left out one by one (in the manner of pseudo-Bayesian model averaging, Geisser and Eddy
    1979): no single number decides where many settings serve equally. A batch that leaves six times the median of the
    others is mistrusted, at most one in four: its drift variance is a hundredfold and it has no vote. Fewer than 3
    batches take the usual setting.

    `fitted`: columns, coef_um (m,) per unit of each column, setting_weights, mistrusted batches, and spread_um2 (2,):
    the mean square left out just after the start and its growth per hour, widened as Student's t where batches are
    few, for `sd_um`.

    Delays, settings and sharpness are constants that were tuned on the recordings of a lathe and a spindle and on the
    simulated year, so that scores there are slightly optimistic.
    """

    key = "lag_dictionary"
    summary = "dictionary of lags of temperatures, drivers and the start, batches pooled with a drift of their own"
    source = "generalised least squares with random effects, Henderson (1975); weights after Geisser and Eddy (1979)"
    closed_form = False
    has_sd = True
    rank = 30

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """All folds; those that leave out one batch of the same set share every inverse.

        Raises:
            InputError: no inputs, or fewer than 4 windows of 10 min with usable rows in a fold.
        """
        columns = Columns.of(design)
        everything = tuple(sorted({k for fold in folds for k in fold}))
        windows = Windows.of(design, columns.x, everything)
        for fold in folds:
            if not design.inputs:
                raise InputError(f"{self.key}: no inputs given for {design.target or 'the error'}; name a channel")
            got = int(np.isin(windows.batch, list(fold)).sum())
            if got < _FEWEST_WINDOWS:
                raise too_few_rows(self.key, design, fold, got, _FEWEST_WINDOWS)
        whole = _Pooling(columns, windows)
        left = [set(everything) - set(fold) for fold in folds]
        learned = []
        for fold, out in zip(folds, left, strict=True):
            if len(out) == 1 and len(everything) > _FEWEST_BATCHES and out <= set(windows.ids.tolist()):
                learned.append(whole.learn(next(iter(out))))
            else:
                learned.append(_Pooling(columns, windows.only(fold)).learn(None))
        return [
            self._learned(design, {
                "columns": list(columns.names), **pooled,
                "mistrusted": [design.batch_ids[k] for k in pooled["mistrusted"]],
                "n_rows": int(design.usable[np.isin(design.group, list(fold))].sum()),
            })
            for fold, pooled in zip(folds, learned, strict=True)
        ]  # fmt: skip

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Copies share the columns; NaN at a row where an input is missing.

        Raises:
            InputError: the design lacks the drivers or whole batches that the model was fitted with.
        """
        columns = Columns.of(design)
        for model in fitted:
            lost = [name for name in model.fitted["columns"] if name not in columns.names]
            if lost or len(columns.names) != len(model.fitted["columns"]):
                raise InputError(
                    f"{self.key}: the rows have {len(columns.names)} columns, the model was fitted with "
                    f"{len(model.fitted['columns'])}, e.g. {(lost or columns.names)[0]!r}; give whole batches with the "
                    "same drivers"
                )
        predicted = columns.x @ np.column_stack([model.fitted["coef_um"] for model in fitted])
        predicted[~np.isfinite(design.x).all(axis=1)] = np.nan
        return by_batch(design, predicted, wanted)

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,): what training batches left when they were left out, by the hour."""
        start, growth = self.fitted["spread_um2"]
        out = []
        for k in batches:
            time_h = (design.time_s[design.rows(k)] - design.time_s[design.rows(k)][:1]) / 3600.0
            out.append(np.sqrt(start + growth * time_h))
        return out

    def operations(self, b: Builder) -> Sequence[int]:
        x = columns_program(b, self.inputs, self.fitted["columns"])
        return [b.affine(x, self.fitted["coef_um"][None])]

    def n_parameters(self) -> int:
        """Coefficients, setting weights and the two numbers of the spread."""
        return sum(len(self.fitted[name]) for name in ("coef_um", "setting_weights", "spread_um2"))


@dataclass(frozen=True)
class _Pooling:
    """Training of one set of batches, or of that set without one of them; processes are kept for the next fold."""

    columns: Columns
    windows: Windows

    @cached_property
    def _processes(self) -> dict[tuple[_Setting, bytes, tuple[int, ...]], BatchProcess]:
        return {}

    def _process(self, setting: _Setting, prior: Array, mistrusted: tuple[int, ...]) -> BatchProcess:
        key = (setting, prior.tobytes(), mistrusted)
        if key not in self._processes:
            variance = setting.variance(self.columns, prior)
            self._processes[key] = BatchProcess.of(self.windows, variance, setting.steady, mistrusted)
        return self._processes[key]

    def learn(self, without: int | None) -> Plain:
        """From all batches of the windows but one, or from all."""
        ids = self.windows.ids
        rest = np.flatnonzero(ids != without)
        prior = self.columns.prior(ids[rest].tolist())
        if len(rest) < _FEWEST_BATCHES:
            usual = self._process(_USUAL_SETTING, prior, ())
            left_um = self.windows.y_um - self.windows.x @ usual.gains()
            # No other batch to try: the mean square residual on its own windows, and as much an hour.
            spread_um2, coef_um = np.full(2, np.mean(left_um**2)), usual.gains(self._place(without))
            weights = np.array([float(s == _USUAL_SETTING) for s in _SETTINGS])
            return {"coef_um": coef_um, "spread_um2": spread_um2, "mistrusted": (), "setting_weights": weights}
        mistrusted = self._mistrusted(prior, rest, without)
        voters = rest[~np.isin(ids[rest], mistrusted)]
        processes = [self._process(setting, prior, mistrusted) for setting in _SETTINGS]
        left_um = np.array([process.left_um(self._place(without)) for process in processes])
        S_mean_um = np.maximum([self._S_um(left)[voters].mean() for left in left_um], np.finfo(float).tiny)
        weights = (S_mean_um.min() / S_mean_um) ** _SHARPNESS
        weights /= weights.sum()
        coef_um = weights @ np.array([process.gains(self._place(without)) for process in processes])
        widened = (stdtrit(len(voters) - 1, 0.95) / SIDE_OF_90) ** 2
        spread_um2 = widened * self._spread_um2(np.tensordot(weights, left_um, 1), rest)
        return {"coef_um": coef_um, "spread_um2": spread_um2, "mistrusted": mistrusted, "setting_weights": weights}

    def _mistrusted(self, prior: Array, rest: NDArray[np.int64], without: int | None) -> tuple[int, ...]:
        """Outlying batches, one after the other, each against the others as they are without its pull."""
        odd: list[int] = []
        while len(odd) < len(rest) // _ONE_ODD_IN:
            S_um = self._S_um_with(prior, odd, without)
            others = np.setdiff1d(rest, odd)
            worst = int(others[np.argmax(S_um[others])])
            others = np.setdiff1d(others, [worst])
            if S_um[worst] <= _ODD * np.median(self._S_um_with(prior, [*odd, worst], without)[others]):
                break
            odd.append(worst)
        return tuple(sorted(int(k) for k in self.windows.ids[odd]))

    def _S_um_with(self, prior: Array, odd: list[int], without: int | None) -> Array:
        mistrusted = tuple(sorted(int(k) for k in self.windows.ids[odd]))
        return self._S_um(self._process(_USUAL_SETTING, prior, mistrusted).left_um(self._place(without)))

    def _place(self, batch: int | None) -> int | None:
        return None if batch is None else int(np.searchsorted(self.windows.ids, batch))

    def _S_um(self, left_um: Array) -> Array:
        return np.asarray(np.sqrt((left_um**2).sum(axis=1) / np.maximum(self.windows.counts - 1, 1)))

    def _spread_um2(self, left_um: Array, batches: NDArray[np.int64]) -> Array:
        """Mean square left out as start + growth · hours, neither negative, over all batches, mistrusted ones too."""
        w = self.windows
        inside = np.isin(w.batch, w.ids[batches])
        left = np.concatenate([row[:n] for row, n in zip(left_um, w.counts, strict=True)])[inside]
        terms = np.column_stack([np.ones(inside.sum()), w.time_h[inside]])
        return np.asarray(nnls(terms, left**2)[0])
