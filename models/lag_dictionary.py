"""Lag dictionary: inputs, drivers and the start of a run at many delays; every batch drifts on its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError
from features.design import Design
from models.base import Array, Family
from models.batch_process import BatchProcess, Windows
from models.batchwise import by_batch, too_few_rows
from models.lag_dictionary_columns import Columns

_LEVELS = tuple(10.0**e for e in range(-2, 5))  # µm² per K², in units of the drift's variance after an hour
_USUAL = 10.0
_SHARPNESS = 10.0  # a setting that leaves 10 % more counts e^-1 as much
_ODD = 6.0  # a batch is mistrusted where others leave so many times the median
_FEWEST_BATCHES = 3
_FEWEST_WINDOWS = 4


@dataclass(frozen=True)
class _Setting:
    """How freely the columns may act, and whether drivers are among them."""

    level: float
    drivers: bool

    def variance(self, prior: Array, from_driver: NDArray[np.bool_]) -> Array:
        return np.where(from_driver & (not self.drivers), 0.0, self.level * prior**2)


_SETTINGS = tuple(_Setting(level, drivers) for level in _LEVELS for drivers in (True, False))
_USUAL_SETTING = _Setting(_USUAL, drivers=True)


class LagDictionary(Family):
    """error_um = x(t) · β over a dictionary of delayed inputs, drivers and start states, β by pooling batches.

    Columns (`models.lag_dictionary_columns`): each input as it is and behind lags of 10 min to 8 h, each driver (a
    speed also squared) likewise, how the machine stood at the start, and the clock. A batch's error is x · β and a
    drift of its own that no column explains, so that the fit is generalised least squares with a ridge prior
    (`models.batch_process`). The prediction is 0 at the first row.

    Fourteen settings (seven levels of the prior, with and without drivers) are averaged with weights S^−10, S the mean
    residual standard deviation of the training batches left out one by one (in the manner of pseudo-Bayesian model
    averaging, Geisser and Eddy 1979). Of 3 batches or more, one that leaves six times the median is mistrusted: its
    drift variance is a hundredfold and it has no vote. Fewer than 3 batches take the usual setting.

    `fitted`: columns, coef_um (m,) per unit of each column, mistrusted batches, and spread_um2 (2,): the mean square
    left out just after the start and its growth per hour, which `sd_um` tells. Structure (delays, noise, sharpness) was
    fixed once on three machines' recordings, all scores within 5 % of each other; nothing of it is fitted.
    """

    key = "lag_dictionary"
    words = "dictionary of lags of temperatures, drivers and the start, batches pooled with a drift of their own"
    source = "generalised least squares with random effects, Henderson (1975); weights after Geisser and Eddy (1979)"
    closed_form = False
    rowwise = False
    tells_sd = True
    rank = 30

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        return self.fit_folds(design, [train])[0]

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
                "columns": list(columns.names), "coef_um": pooled.coef_um, "spread_um2": pooled.spread_um2,
                "mistrusted": [design.batch_ids[k] for k in pooled.mistrusted],
                "setting_weights": pooled.weights,
                "n_rows": int(design.usable[np.isin(design.group, list(fold))].sum()),
            })
            for fold, pooled in zip(folds, learned, strict=True)
        ]  # fmt: skip

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row where an input is missing.

        Raises:
            InputError: the design lacks the drivers or whole batches that the model was fitted with.
        """
        return self.predict_folds(design, [self], [batches])[0]

    def predict_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Copies share the columns."""
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

    def n_parameters(self) -> int:
        """Coefficients, setting weights and the two numbers of the spread."""
        return sum(len(self.fitted[name]) for name in ("coef_um", "setting_weights", "spread_um2"))


@dataclass(frozen=True)
class _Pooled:
    coef_um: Array
    weights: Array
    mistrusted: tuple[int, ...]
    spread_um2: Array


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
            variance = setting.variance(prior, self.columns.from_driver)
            self._processes[key] = BatchProcess(self.windows, variance, mistrusted)
        return self._processes[key]

    def learn(self, without: int | None) -> _Pooled:
        ids = self.windows.ids
        place = None if without is None else int(np.flatnonzero(ids == without)[0])
        rest = np.flatnonzero(ids != without) if without is not None else np.arange(len(ids))
        prior = self.columns.prior(ids[rest].tolist())
        if len(rest) < _FEWEST_BATCHES:
            process = self._process(_USUAL_SETTING, prior, ())
            spread = process.drift_variance() * np.array([2.0, 1.0])
            weights = np.array([float(s == _USUAL_SETTING) for s in _SETTINGS])
            return _Pooled(process.gains(place), weights, (), spread)
        S_um = self._S_um(self._process(_USUAL_SETTING, prior, ()), place)[rest]
        odd = rest[S_um > _ODD * np.median(S_um)]
        mistrusted = tuple(int(k) for k in ids[odd])
        processes = [self._process(setting, prior, mistrusted) for setting in _SETTINGS]
        voters = np.setdiff1d(rest, odd)
        left = np.array([self._S_um(process, place)[voters].mean() for process in processes])
        weights = (left.min() / np.maximum(left, np.finfo(float).tiny)) ** _SHARPNESS
        weights /= weights.sum()
        coef_um = sum(w * process.gains(place) for w, process in zip(weights, processes, strict=True))
        left_um = sum(w * self._left_um(process, place) for w, process in zip(weights, processes, strict=True))
        return _Pooled(np.asarray(coef_um), weights, mistrusted, self._spread_um2(np.asarray(left_um), rest))

    def _left_um(self, process: BatchProcess, place: int | None) -> Array:
        return process.alone_um if place is None else process.pairs_um[place]

    def _S_um(self, process: BatchProcess, place: int | None) -> Array:
        square = (self._left_um(process, place) ** 2).sum(axis=1)
        return np.asarray(np.sqrt(square / np.maximum(self.windows.counts - 1, 1)))

    def _spread_um2(self, left_um: Array, batches: NDArray[np.int64]) -> Array:
        """Mean square left out as start + growth · hours, neither negative, over all batches (N. B. odd ones too)."""
        from scipy.optimize import nnls

        time_h, left = [], []
        for i in batches:
            n = int(self.windows.counts[i])
            time_h.append(self.windows.time_h[self.windows.borders[i] :][:n])
            left.append(left_um[i, :n])
        hours = np.concatenate(time_h)
        start, growth = nnls(np.column_stack([np.ones_like(hours), hours]), np.concatenate(left) ** 2)[0]
        return np.array([start, growth])
