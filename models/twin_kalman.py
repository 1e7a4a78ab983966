"""Family: calibrated twin with a Kalman filter on the selected sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from data.arrays import Array
from data.batch import Batch
from data.errors import InputError
from features.design import Design
from models.base import Family
from models.metrics import residual_std_um
from models.ridge import Ridge
from models.solvers.batches import bridged
from models.solvers.twin_folds import TwinRun
from models.twin import Twin, run_of
from twin.kalman import Doubt, Filtered, filtered_each
from twin.network import Network
from twin.simulation.inputs import Inputs
from twin.simulation.start import start_of

HEAT_W = (3.0, 10.0, 30.0)
_RESIDUALS = ("ridge", "none")
_MARK, _COEF = "residual.", "coef_um_per_K"  # of the regression's learned numbers among the twin's
_CHOSEN_ON = 6  # training batches that the noise of the heat is chosen on


class TwinKalman(Twin):
    """The twin of `models.twin`, corrected row by row by those selected inputs that are its sensors.

    They are read as temperatures, not as rises; an input that is no sensor of the twin is ignored, and without
    any the twin runs free. A row uses the readings up to it. The start's scatter is that of the training batches;
    each heat has a factor of its own in every batch (standard deviation `heat_spread`); the white noise of the bodies'
    heat is the one of `HEAT_W` of least mean S on up to six of the training batches. Readings are used every `every_s`
    seconds, as in the calibration. To that a ridge regression on the inputs is added (`residual` "ridge"; "none":
    without), learned from what filters leave that were calibrated without the batch in turn: the filter corrects
    temperatures, and never learns that a gain from them to the error is wrong. `fitted` adds heat_W and the regression.
    """

    key = "twin_kalman"
    summary = "physics twin that assimilates the sensors by a Kalman filter, plus a regression of its residual"
    source = "Kalman (1960); Gelb (1974), sec. 6.1, linearised about the simulation"
    uses_inputs = True
    closed_form = False
    on_request = True
    rank = 40

    def __init__(
        self,
        heat_spread: float = 0.15,
        every_s: float = 300.0,
        channels: tuple[str, ...] = (),
        start: str = "usual",
        residual: str = "ridge",
    ) -> None:
        super().__init__(every_s, channels, start)
        if residual not in _RESIDUALS:
            raise InputError(f"family {self.key}: residual is {residual!r}, expected {' or '.join(_RESIDUALS)}")
        if not heat_spread >= 0:
            raise InputError(f"family {self.key}: heat_spread is {heat_spread!r}, expected 0 or more, e.g. 0.15")
        self.heat_spread, self.residual = float(heat_spread), residual

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold; folds, inputs and error channels share the twin's work. Raises: as `Twin`."""
        every = super().fit_folds(design, folds)
        run = run_of(design, every[0].fitted["machine"]) if every else None
        out = []
        for fitted, fold in zip(every, folds, strict=True):
            assert run is not None
            chosen = list(fold)[:: -(-len(fold) // _CHOSEN_ON)]
            y_um = [design.y_um[design.rows(k)] for k in chosen]
            tried = fitted._errors_um(run.only(chosen), HEAT_W)
            scores = [_mean_S_um(y_um, errors) for errors in tried]
            best = HEAT_W[int(np.nanargmin(scores))] if np.isfinite(scores).any() else HEAT_W[1]
            filter_alone = self._learned(design, {**fitted.fitted, "heat_W": best})
            out.append(filter_alone._with_regression(design, fold))
        return out

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN where a batch lacks a driver or surrounding; a row without readings is predicted from the rows before."""
        run = TwinRun.of(self.network, [design.batches[k] for k in batches])
        rest_um = self._rest_um(design, batches)
        return [e + rest for e, rest in zip(self._errors_um(run, [self.fitted["heat_W"]])[0], rest_um, strict=True)]

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        run = run_of(design, fitted[0].fitted["machine"])
        out = []
        for f, batches in zip(fitted, wanted, strict=True):
            errors = f._errors_um(run.only(batches), [f.fitted["heat_W"]])[0]
            out.append([e + rest for e, rest in zip(errors, f._rest_um(design, batches), strict=True)])
        return out

    def filtered(self, batches: Sequence[Batch]) -> Filtered | None:
        """All that the filter knows of batches that can be simulated; None where there is none."""
        found = self._filtered(TwinRun.of(self.network, batches), [self.fitted["heat_W"]])
        return found[0] if found else None

    def n_parameters(self) -> int:
        if not self.fitted:
            return 0
        return super().n_parameters() + 1 + sum(np.size(v) for k, v in self.fitted.items() if k == _MARK + _COEF)

    def _with_regression(self, design: Design, fold: Sequence[int]) -> Self:
        """Of this filter, with the regression of what filters leave that lack the batch in turn."""
        if self.residual == "none" or not design.inputs:
            return self
        work = self._calibrations(design)
        at = [e.channel for e in work.network.errors].index(design.target)
        y_um = np.full(len(design.y_um), np.nan)
        for k, (values, start_K) in work.of(fold).left_out.items():
            thin, inputs = work.thinned(k)
            stride = round(thin.step_s / design.batches[k].step_s) if thin.n_rows > 1 else 1
            rows = np.arange(design.offsets[k], design.offsets[k + 1], stride)
            usual_K = start_K if self.start == "usual" else 0.0
            start_degC = start_of(work.network, values, inputs, settled=True) + usual_K
            readings = self._readings(work.network, [thin], inputs)
            (found,) = self._filters(work.network, values, inputs, readings, start_degC, [self.fitted["heat_W"]])
            error_um = found.errors[0, : thin.n_rows, at]
            recorded_um = design.y_um[rows]
            y_um[rows] = recorded_um - (error_um - error_um[np.argmax(np.isfinite(recorded_um))])
        learned = self._regression().fit_design(replace(_held(design), y_um=y_um), fold)
        return self._learned(design, {**self.fitted, **{_MARK + name: v for name, v in learned.fitted.items()}})

    def _regression(self) -> Family:
        return Ridge() if self.zero_start else Ridge().as_published()

    def _rest_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """What the regression adds (n_k,) to the filter; an input that is missing for a while holds its last value.

        Nothing in a batch that lacks an input wholly: the filter goes without that sensor.
        """
        learned = {k.removeprefix(_MARK): v for k, v in self.fitted.items() if k.startswith(_MARK)}
        if not learned:
            return [np.zeros(design.rows(k).stop - design.rows(k).start) for k in batches]
        regression = self._regression()
        regression.inputs, regression.target, regression.fitted = self.inputs, self.target, learned
        return [np.nan_to_num(rest_um) for rest_um in regression.predict_design(_held(design), batches)]

    def _errors_um(self, run: TwinRun, heat_W: Sequence[float]) -> list[list[Array]]:
        """Per noise of the heat the error (n_k,) of every batch of a run."""
        at = [e.channel for e in run.network.errors].index(self.target)
        found = self._filtered(run, heat_W)
        return [run.by_batch(f.errors[..., at]) for f in found] or [run.by_batch(None)] * len(heat_W)

    def _filtered(self, run: TwinRun, heat_W: Sequence[float]) -> list[Filtered]:
        """What the filter knows at each noise of the heat; empty where no batch can be simulated."""
        if run.inputs is None:
            return []
        values = self.values()
        readings = self._readings(run.network, [run.batches[k] for k in run.used], run.inputs)
        start_degC = run.start_degC(values, self._usual_K())
        return self._filters(run.network, values, run.inputs, readings, start_degC, heat_W)

    def _filters(
        self,
        network: Network,
        values: Array,
        inputs: Inputs,
        readings: Array,
        start_degC: Array,
        heat_W: Sequence[float],
    ) -> list[Filtered]:
        start_cov_K2 = np.asarray(self.fitted["start_cov_K2"], float)
        doubts = [Doubt(start_cov_K2, self.heat_spread, watts) for watts in heat_W]
        time_s = inputs.time_s[0, :: inputs.every]
        thin = max(1, round(self.every_s / (time_s[1] - time_s[0]))) if len(time_s) > 1 else 1
        return filtered_each(network, values, inputs, readings, doubts, start_degC, thin)

    def _readings(self, network: Network, batches: Sequence[Batch], inputs: Inputs) -> Array:
        """What the selected sensors show at the rows (B, K, sensors), NaN for the others."""
        sensors = [r.channel for r in network.readings]
        out = np.full((len(batches), len(inputs.time_s[0, :: inputs.every]), len(sensors)), np.nan)
        for i, batch in enumerate(batches):
            for name in set(self.inputs) & set(sensors) & set(batch.table.columns):
                out[i, : batch.n_rows, sensors.index(name)] = batch.masked(name)
        return out


def _held(design: Design) -> Design:
    """The design with holes of the inputs held."""
    return replace(design, x=bridged(design, design.x), _parent=None, _columns=None)


def _mean_S_um(recorded_um: Sequence[Array], predicted_um: Sequence[Array]) -> float:
    """Mean S over batches; NaN where none has two rows."""
    S_um = np.array([residual_std_um(y - p) for y, p in zip(recorded_um, predicted_um, strict=True)])
    return float(np.nanmean(S_um)) if np.isfinite(S_um).any() else float("nan")
