"""Family: calibrated twin plus a regression of its residual on deviations of the measured temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Self

import numpy as np

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import Family, Plain
from models.gaussian_process import GaussianProcess
from models.ridge import Ridge
from models.solvers.batches import by_batch
from models.solvers.twin_folds import TwinRun
from models.twin import Twin, run_of
from twin.network import Network

_RESIDUALS = ("ridge", "gp")
_MARK = "residual."  # of the regression's learned numbers among the twin's


class TwinResidual(Twin):
    """error_um = twin + regression of the twin's residual on the selected inputs.

    An input that is a sensor of the twin counts as its rise less the rise that the twin expects (`inputs_as`
    "unexpected"; "rises": as the other families see it); other inputs are taken as they are. The regression is ridge,
    its penalty chosen inside the training batches, or `residual` "gp", a Gaussian process. It learns from residuals
    that a twin without the batch leaves (the calibration's linearised step without each batch in turn, simulated in
    full): residuals of a twin that saw the batch would be too small. A single training batch is held against the
    machine file's values.
    """

    key = "twin_residual"
    summary = "physics twin plus a regression of its residual on the sensors"
    source = "Kennedy and O'Hagan (2001), eq. 4, a discrepancy added to a calibrated model; Hoerl and Kennard (1970)"
    uses_inputs = True
    closed_form = False
    rank = 35

    def __init__(
        self, residual: str = "ridge", inputs_as: str = "unexpected", every_s: float = 300.0, start: str = "usual"
    ) -> None:
        super().__init__(every_s, (), start)
        if residual not in _RESIDUALS:
            raise InputError(f"family {self.key}: residual is {residual!r}, expected {' or '.join(_RESIDUALS)}")
        if inputs_as not in ("unexpected", "rises"):
            raise InputError(f"family {self.key}: inputs_as is {inputs_as!r}, expected 'unexpected' or 'rises'")
        self.residual, self.inputs_as = residual, inputs_as

    def options(self) -> Plain:
        return {k: v for k, v in super().options().items() if k != "channels"}

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold; folds, inputs and error channels share the twin's work.

        Raises:
            InputError: as `Twin.fit_folds`, or no inputs.
        """
        out = []
        for twin, fold in zip(super().fit_folds(design, folds), folds, strict=True):
            regression = self._regression().fit_design(self._left_out(design, fold), fold)
            learned = {_MARK + name: value for name, value in regression.fitted.items()}
            out.append(self._learned(design, {**twin.fitted, **learned}))
        return out

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row where an input is missing, or where a batch lacks a driver or surrounding."""
        some = _of_batches(design, batches)
        total = self._total(some, TwinRun.of(self.network, some.batches), [self])[:, 0]
        return [total[some.rows(k)] for k in range(some.n_batches)]

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        return by_batch(design, self._total(design, run_of(design, fitted[0].fitted["machine"]), fitted), wanted)

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value about the prediction, for `residual` "gp".

        Raises:
            InputError: another regression, which has none.
        """
        regression = self._fitted_regression()
        if not isinstance(regression, GaussianProcess):
            raise InputError(f"family {self.key}: residual {self.residual!r} has no predictive sd; choose 'gp'")
        some = _of_batches(design, batches)
        seen = self._simulated(TwinRun.of(self.network, some.batches), [self])[1][0]
        return regression.sd_um(self._seen(some, self.network, seen), range(some.n_batches))

    def n_parameters(self) -> int:
        """The twin's and the regression's."""
        return super().n_parameters() + self._fitted_regression().n_parameters() if self.fitted else 0

    def _total(self, design: Design, run: TwinRun, fitted: Sequence[Self]) -> Array:
        """Predictions (n, F) on all rows of a design, of F fitted copies with one machine."""
        twins, seen = self._simulated(run, fitted)
        out = []
        for f, twin, own in zip(fitted, twins, seen, strict=True):
            rest = f._fitted_regression().predict_design(f._seen(design, run.network, own), range(design.n_batches))
            out.append(twin + np.concatenate(rest))
        return np.column_stack(out)

    def _left_out(self, design: Design, fold: Sequence[int]) -> Design:
        """The design with the twin's left-out residuals as target and the inputs less its readings, in the fold."""
        work = self._calibrations(design)
        y, seen = np.full(len(design.y_um), np.nan), np.full((len(design.y_um), len(work.network.readings)), np.nan)
        at = [e.channel for e in work.network.errors].index(design.target)
        for k, (errors, readings) in work.left_out(fold, self.start == "usual").items():
            rows = design.rows(k)
            y[rows] = design.y_um[rows] - (errors[:, at] - errors[_first(design.y_um[rows]), at])
            seen[rows] = readings
        return replace(self._seen(design, work.network, seen), y_um=y)

    def _seen(self, design: Design, network: Network, readings: Array) -> Design:
        """The design with its sensors' rises less those of the twin's readings (n, sensors)."""
        x = design.x.copy()
        sensors = {r.channel: j for j, r in enumerate(network.readings)}
        for c, name in enumerate(design.inputs):
            if self.inputs_as == "unexpected" and name in sensors:
                for k in range(design.n_batches):
                    rows = design.rows(k)
                    own = readings[rows, sensors[name]]
                    x[rows, c] -= own - own[_first(x[rows, c])]
        return replace(design, x=x, _parent=None, _columns=None)

    def _regression(self) -> Family:
        regression: Family = Ridge() if self.residual == "ridge" else GaussianProcess()
        return regression if self.zero_start else regression.as_published()

    def _fitted_regression(self) -> Family:
        out = self._regression()
        out.inputs, out.target = self.inputs, self.target
        out.fitted = {k.removeprefix(_MARK): v for k, v in self.fitted.items() if k.startswith(_MARK)}
        return out


def _first(values: Array) -> int:
    """Number of the first value that is usable, to which rises and errors refer."""
    return int(np.argmax(np.isfinite(values)))


def _of_batches(design: Design, batches: Sequence[int]) -> Design:
    """The same inputs of some batches, without a target."""
    return Design.build([design.batches[k] for k in batches], design.inputs, None, design.machine)
