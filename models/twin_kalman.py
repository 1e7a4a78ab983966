"""Family: calibrated twin with a Kalman filter on the selected sensors."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Self

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from features.design import Design
from models.solvers.twin_folds import TwinRun
from models.twin import Twin, run_of
from twin.kalman import Doubt, Filtered, filtered

HEAT_W = (3.0, 10.0, 30.0)
_CHOSEN_ON = 6  # training batches that the noise of the heat is chosen on


class TwinKalman(Twin):
    """The twin of `models.twin`, corrected row by row by those selected inputs that are its sensors.

    They are read as temperatures, not as rises; an input that is no sensor of the twin is ignored, and without
    any the twin runs free. A row uses the readings up to it. The start's scatter is that of the training batches;
    each heat has a factor of its own in every batch (standard deviation `heat_spread`); the white noise of the bodies'
    heat is the one of `HEAT_W` of least mean S on up to six of the training batches. `fitted` adds heat_W.
    """

    key = "twin_kalman"
    summary = "physics twin that assimilates the sensors by a Kalman filter"
    source = "Kalman (1960); Gelb (1974), sec. 6.1, linearised about the simulation"
    uses_inputs = True
    closed_form = False
    effort = "on_request"
    rank = 40

    def __init__(
        self, heat_spread: float = 0.15, every_s: float = 300.0, channels: tuple[str, ...] = (), start: str = "usual"
    ) -> None:
        super().__init__(every_s, channels, start)
        if not heat_spread >= 0:
            raise InputError(f"family {self.key}: heat_spread is {heat_spread!r}, expected 0 or more, e.g. 0.15")
        self.heat_spread = float(heat_spread)

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold; folds, inputs and error channels share the twin's work. Raises: as `Twin`."""
        out = []
        for fitted, fold in zip(super().fit_folds(design, folds), folds, strict=True):
            chosen = list(fold)[:: -(-len(fold) // _CHOSEN_ON)]
            run = run_of(design, fitted.fitted["machine"]).only(chosen)
            y = [design.y_um[design.rows(k)] for k in chosen]
            scores = [fitted._with(heat_W)._mean_S_um(run, y) for heat_W in HEAT_W]
            out.append(fitted._with(HEAT_W[int(np.nanargmin(scores))] if np.isfinite(scores).any() else HEAT_W[1]))
        return out

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN where a batch lacks a driver or surrounding; a row without readings is predicted from the rows before."""
        run = TwinRun.of(self.network, [design.batches[k] for k in batches])
        return self._error_um(run)

    def predict_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        run = run_of(design, fitted[0].fitted["machine"])
        every = [f._error_um(run) for f in fitted]
        return [[errors[k] for k in batches] for errors, batches in zip(every, wanted, strict=True)]

    def filtered(self, batches: Sequence[Batch]) -> Filtered | None:
        """All that the filter knows of batches that can be simulated; None where there is none."""
        return self._filtered(TwinRun.of(self.network, batches))

    def n_parameters(self) -> int:
        return super().n_parameters() + 1 if self.fitted else 0

    def _with(self, heat_W: float) -> Self:
        other = copy.copy(self)
        other.fitted = {**self.fitted, "heat_W": heat_W}
        return other

    def _mean_S_um(self, run: TwinRun, y_um: Sequence[Array]) -> float:
        S: list[float] = []
        for y, predicted in zip(y_um, self._error_um(run), strict=True):
            e = (y - predicted)[np.isfinite(y - predicted)]
            S.append(float(np.sqrt(e @ e / (len(e) - 1))) if len(e) > 1 else float("nan"))
        return float(np.nanmean(S)) if np.isfinite(S).any() else float("nan")

    def _error_um(self, run: TwinRun) -> list[Array]:
        done = self._filtered(run)
        at = [e.channel for e in run.network.errors].index(self.target)
        return run.by_batch(None if done is None else done.errors[..., at])

    def _filtered(self, run: TwinRun) -> Filtered | None:
        if run.inputs is None:
            return None
        values, start_K = self.values(), self._usual_K()
        doubt = Doubt(np.asarray(self.fitted["start_cov_K2"], float), self.heat_spread, self.fitted["heat_W"])
        return filtered(run.network, values, run.inputs, self._readings(run), doubt, run.start_degC(values, start_K))

    def _readings(self, run: TwinRun) -> Array:
        """What the selected sensors show at the rows (used batches, K, sensors), NaN for the others."""
        assert run.inputs is not None
        sensors = [r.channel for r in run.network.readings]
        out = np.full((len(run.used), len(run.inputs.time_s[0, :: run.inputs.every]), len(sensors)), np.nan)
        for i, k in enumerate(run.used):
            batch = run.batches[k]
            for name in set(self.inputs) & set(sensors) & set(batch.table.columns):
                out[i, : batch.n_rows, sensors.index(name)] = batch.masked(name)
        return out
