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
from models.families.twin import error_of, run_of
from models.families.twin_residual import CorrectedTwin, left_um
from models.metrics import residual_std_um
from models.numerics.batches import bridged
from models.numerics.twin_folds import TwinRun
from twin.kalman import Doubt, Filtered, filtered_each
from twin.network import Network
from twin.simulation.inputs import Inputs
from twin.simulation.start import start_of

HEAT_W = (3.0, 10.0, 30.0)
_CHOSEN_ON = 6  # training batches that the noise of the heat is chosen on


class TwinKalman(CorrectedTwin):
    """The twin of `models.families.twin`, corrected row by row by those selected inputs that are its sensors.

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
    residuals = ("ridge", "none")

    def __init__(
        self,
        heat_spread: float = 0.15,
        every_s: float = 300.0,
        channels: tuple[str, ...] = (),
        start: str = "usual",
        residual: str = "ridge",
    ) -> None:
        super().__init__(every_s, channels, start)
        self._known(residual)
        if not heat_spread >= 0:
            raise InputError(f"family {self.key}: heat_spread is {heat_spread!r}, expected 0 or more, e.g. 0.15")
        self.heat_spread, self.residual = float(heat_spread), residual

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold; folds, inputs and error channels share the twin's work. Raises: as `Twin`."""
        out = []
        for fitted, fold in zip(super().fit_folds(design, folds), folds, strict=True):
            run = run_of(design, fitted.fitted["machine"])
            chosen = list(fold)[:: -(-len(fold) // _CHOSEN_ON)]
            y_um = [design.y_um[design.rows(k)] for k in chosen]
            scores = [_mean_S_um(y_um, errors) for errors in fitted._errors_um(run.only(chosen), HEAT_W)]
            best = HEAT_W[int(np.nanargmin(scores))] if np.isfinite(scores).any() else HEAT_W[1]
            model = self._learned(design, {**fitted.fitted, "heat_W": best})
            if self.residual != "none" and design.inputs:
                model = model._corrected(_held(design), model._left_out_um(design, fold), fold)
            out.append(model)
        return out

    def _outputs(
        self, design: Design, run: TwinRun, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """NaN where a batch lacks a driver or surrounding; a row without readings is predicted from the rows before.

        An input of the regression that is missing for a while holds its last value; a batch that lacks one wholly gets
        the filter alone.
        """
        out = []
        for f, batches in zip(fitted, wanted, strict=True):
            errors_um, regression = f._errors_um(run.only(batches), [f.fitted["heat_W"]])[0], f._regression()
            if regression.fitted:
                rest_um = regression.predict_design(_held(design), batches)
                errors_um = [e + np.nan_to_num(rest) for e, rest in zip(errors_um, rest_um, strict=True)]
            out.append(errors_um)
        return out

    def n_parameters(self) -> int:
        if not self.fitted:
            return 0
        return super().n_parameters() + 1 + np.size(self._regression().fitted.get("coef_um_per_K", ()))

    def _left_out_um(self, design: Design, fold: Sequence[int]) -> Array:
        """What filters leave (n,) that lack the batch in turn, on the rows that are calibrated on; NaN elsewhere."""
        work = self._calibrations(design)
        at = error_of(work.network, design.target)
        y_um = np.full(len(design.y_um), np.nan)
        for k, (values, start_K) in work.of(fold).left_out.items():
            thin, inputs = work.thinned(k)
            stride = round(thin.step_s / design.batches[k].step_s) if thin.n_rows > 1 else 1
            rows = np.arange(design.offsets[k], design.offsets[k + 1], stride)
            usual_K = start_K if self.start == "usual" else 0.0
            start_degC = start_of(work.network, values, inputs, steady=True) + usual_K
            (found,) = self._filters([thin], work.network, values, inputs, start_degC, [self.fitted["heat_W"]])
            y_um[rows] = left_um(design.y_um[rows], found.errors[0, : thin.n_rows, at])
        return y_um

    def _errors_um(self, run: TwinRun, heat_W: Sequence[float]) -> list[list[Array]]:
        """Per noise of the heat the error (n_k,) of every batch of a run."""
        if run.inputs is None:
            return [run.by_batch(None)] * len(heat_W)
        at, values = error_of(run.network, self.target), self.values()
        batches, start_degC = [run.batches[k] for k in run.used], run.start_degC(values, self._usual_K())
        found = self._filters(batches, run.network, values, run.inputs, start_degC, heat_W)
        return [run.by_batch(f.errors[..., at]) for f in found]

    def _filters(
        self,
        batches: Sequence[Batch],
        network: Network,
        values: Array,
        inputs: Inputs,
        start_degC: Array,
        heat_W: Sequence[float],
    ) -> list[Filtered]:
        """By noise of the heat what the filter knows of the batches from what the selected sensors show."""
        time_s = inputs.time_s[0, :: inputs.every]
        sensors = [r.channel for r in network.readings]
        readings = np.full((len(batches), len(time_s), len(sensors)), np.nan)
        for i, batch in enumerate(batches):
            for name in set(self.inputs) & set(sensors) & set(batch.table.columns):
                readings[i, : batch.n_rows, sensors.index(name)] = batch.masked(name)
        start_cov_K2 = np.asarray(self.fitted["start_cov_K2"], float)
        doubts = [Doubt(start_cov_K2, self.heat_spread, watts) for watts in heat_W]
        thin = max(1, round(self.every_s / (time_s[1] - time_s[0]))) if len(time_s) > 1 else 1
        return filtered_each(network, values, inputs, readings, doubts, start_degC, thin)


def _held(design: Design) -> Design:
    """The design with holes of the inputs held."""
    return replace(design, x=bridged(design, design.x), _parent=None, _columns=None)


def _mean_S_um(recorded_um: Sequence[Array], predicted_um: Sequence[Array]) -> float:
    """Mean S over batches; NaN where none has two rows."""
    S_um = np.array([residual_std_um(y - p) for y, p in zip(recorded_um, predicted_um, strict=True)])
    return float(np.nanmean(S_um)) if np.isfinite(S_um).any() else float("nan")
