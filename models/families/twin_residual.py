"""Family: calibrated twin plus a regression of its residual on deviations of the measured temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import Family, Plain
from models.families.gaussian_process import GaussianProcess
from models.families.ridge import Ridge
from models.families.twin import Twin, error_of
from models.numerics.batches import by_batch, only
from models.numerics.twin_folds import TwinRun
from twin.network import Network

_MARK = "residual."  # of the regression's learned numbers among the twin's


class CorrectedTwin(Twin):
    """A twin and a regression, named by `residual`, of its residual in batches that it did not learn from."""

    residual: str
    residuals: ClassVar[tuple[str, ...]]  # that may be named

    def _known(self, residual: str) -> str:
        if residual not in self.residuals:
            raise InputError(f"family {self.key}: residual is {residual!r}, expected {' or '.join(self.residuals)}")
        return residual

    def _corrected(self, design: Design, y_um: Array, fold: Sequence[int]) -> Self:
        """This fitted twin with the regression of y_um (n,) on the design's inputs, fitted."""
        learned = self._regression().fit_design(replace(design, y_um=y_um, _parent=None, _columns=None), fold).fitted
        return self._learned(design, {**self.fitted, **{_MARK + name: value for name, value in learned.items()}})

    def _regression(self) -> Family:
        """With what it has learned; nothing yet of a twin that is not corrected."""
        regression: Family = GaussianProcess() if self.residual == "gp" else Ridge()
        out = regression if self.zero_start else regression.as_published()
        out.inputs, out.target = self.inputs, self.target
        out.fitted = {k.removeprefix(_MARK): v for k, v in self.fitted.items() if k.startswith(_MARK)}
        return out


def left_um(recorded_um: Array, predicted_um: Array) -> Array:
    """Residual (n,) of a prediction, both counted from the first recorded value."""
    return recorded_um - (predicted_um - predicted_um[first_place(recorded_um)])


def first_place(values: Array) -> int:
    """Number of the first value that is usable, to which rises and errors refer."""
    return int(np.argmax(np.isfinite(values)))


class TwinResidual(CorrectedTwin):
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
    residuals = ("ridge", "gp")

    def __init__(
        self, residual: str = "ridge", inputs_as: str = "unexpected", every_s: float = 300.0, start: str = "usual"
    ) -> None:
        super().__init__(every_s, (), start)
        self.residual = self._known(residual)
        if inputs_as not in ("unexpected", "rises"):
            raise InputError(f"family {self.key}: inputs_as is {inputs_as!r}, expected 'unexpected' or 'rises'")
        self.inputs_as = inputs_as

    def options(self) -> Plain:
        return {k: v for k, v in super().options().items() if k != "channels"}

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold; folds, inputs and error channels share the twin's work.

        Raises:
            InputError: as `Twin.fit_folds`, or no inputs.
        """
        twins = super().fit_folds(design, folds)
        return [twin._corrected(*self._left_out(design, fold), fold) for twin, fold in zip(twins, folds, strict=True)]

    def _outputs(
        self, design: Design, run: TwinRun, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """NaN at a row where an input is missing, or where a batch lacks a driver or surrounding."""
        total = []
        for f, twin, readings in zip(fitted, *self._simulated(run, fitted), strict=True):
            seen = f._seen(design, run.network, readings)
            total.append(twin + np.concatenate(f._regression().predict_design(seen, range(design.n_batches))))
        return by_batch(design, np.column_stack(total), wanted)

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value about the prediction, for `residual` "gp".

        Raises:
            InputError: another regression, which has none.
        """
        regression = self._regression()
        if not isinstance(regression, GaussianProcess):
            raise InputError(f"family {self.key}: residual {self.residual!r} has no predictive sd; choose 'gp'")
        some = only(design, batches)
        readings = self._simulated(TwinRun.of(self.network, some.batches), [self])[1][0]
        return regression.sd_um(self._seen(some, self.network, readings), range(some.n_batches))

    def n_parameters(self) -> int:
        """The twin's and the regression's."""
        return super().n_parameters() + self._regression().n_parameters() if self.fitted else 0

    def _left_out(self, design: Design, fold: Sequence[int]) -> tuple[Design, Array]:
        """The design with the inputs less the left-out twin's readings, and its residuals (n,), both in the fold."""
        work = self._calibrations(design)
        y_um, seen = np.full(len(design.y_um), np.nan), np.full((len(design.y_um), len(work.network.readings)), np.nan)
        at = error_of(work.network, design.target)
        for k, (errors, readings) in work.left_out(fold, self.start == "usual").items():
            rows = design.rows(k)
            y_um[rows] = left_um(design.y_um[rows], errors[:, at])
            seen[rows] = readings
        return self._seen(design, work.network, seen), y_um

    def _seen(self, design: Design, network: Network, readings: Array) -> Design:
        """The design with its sensors' rises less those of the twin's readings (n, sensors)."""
        x = design.x.copy()
        sensors = {r.channel: j for j, r in enumerate(network.readings)}
        for c, name in enumerate(design.inputs):
            if self.inputs_as == "unexpected" and name in sensors:
                for k in range(design.n_batches):
                    rows = design.rows(k)
                    own = readings[rows, sensors[name]]
                    x[rows, c] -= own - own[first_place(x[rows, c])]
        return replace(design, x=x, _parent=None, _columns=None)
