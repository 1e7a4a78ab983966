"""Family: distributed lags of the inputs (Koyck, Almon or free)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from data.arrays import Array
from data.errors import InputError, closest
from features.design import Design
from models.base import Family
from models.linear import Blocks, Task
from models.program import Builder
from models.solvers.batches import by_batch, fold_masks, steps_s
from models.solvers.kernels import unit_scale
from models.solvers.lags import (
    CRITERIA,
    LagRegression,
    Response,
    Shape,
    effective_rows,
    free_shapes,
    intercepts_um,
    koyck_shapes,
    lag_responses,
    polynomial_shapes,
)

LAGS = ("koyck", "almon", "free")
KOYCK_TAUS_S = tuple(60.0 * t for t in (10, 20, 40, 80, 160, 320, 640))
_LEAST_ROWS = 4


class DistributedLag(Family):
    """`y_t = Σ_l Σ_i β_il x_i(t − l)` over inputs i and lags l, free-running: inputs only, never an earlier error.

    `lags` gives the form of the β of an input:

    - `koyck`: β_i0 free, then geometric, `β_il ∝ λ^l` without end: the input and its first-order lag. The decay, the
      same for all inputs, is one of `KOYCK_TAUS_S` (10 min … 11 h), or there is no lag at all;
    - `almon`: lags 0 … q on a polynomial of `degree` in l;
    - `free`: lags 0 … q, every β free.

    Lags are `lag_min` minutes apart (at least a step), whatever the sampling step, q at most `max_lags`. Before a batch
    starts inputs have their first value (0 for a rise), drivers rest. A ridge penalty, k times the mean variance
    of the columns, keeps lags of collinear sensors apart. Order or decay, and k, are chosen by `order_by`: `forward`
    or `leave_batch_out` inside the training batches (`models.linear.Tuned`), `aic` or `bic`. Residuals of a thermal
    run are autocorrelated: the criteria count `effective_rows`, n (1 − ρ)/(1 + ρ) with ρ their lag-one autocorrelation.

    Source: S. Almon, Econometrica 33 (1965); L. Koyck, Distributed lags and investment analysis (1954);
    effective rows: Bartlett (1935); criteria: Akaike (1974), Schwarz (1978).
    """

    key = "distributed_lag"
    summary = "distributed lag: temperatures of now and before, geometric, polynomial or free"
    source = "Koyck 1954; Almon 1965"
    rowwise = False
    rank = 25

    def __init__(
        self,
        lags: str = "koyck",
        lag_min: float = 30.0,
        max_lags: int = 6,
        degree: int = 3,
        order_by: str = "leave_batch_out",
    ) -> None:
        super().__init__()
        for name, got, allowed in (("lags", lags, LAGS), ("order_by", order_by, CRITERIA)):
            if got not in allowed:
                raise InputError(f"distributed_lag: unknown {name} {got!r}: {closest(got, allowed)}")
        if not (lag_min > 0 and max_lags >= 0 and degree >= 1):
            raise InputError(
                f"distributed_lag: lag_min {lag_min}, max_lags {max_lags}, degree {degree}; expected lag_min above 0, "
                "max_lags at least 0 and degree at least 1"
            )
        self.lags, self.lag_min, self.max_lags = lags, float(lag_min), int(max_lags)
        self.degree, self.order_by = int(degree), order_by

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """All folds from the per-batch sums of the lagged inputs.

        Raises:
            InputError: no inputs, or fewer than 4 usable rows in a fold.
        """
        if not folds:
            return []
        responses, shapes = self._tried(design)
        columns = self.started(_columns(design, responses))
        moments = columns.moments
        count = moments.count if design.inputs else np.zeros(design.n_batches)
        masks = fold_masks(self.key, design, folds, count, _LEAST_ROWS)
        blocks = Blocks.of(moments)
        task = Task(columns, masks, blocks, blocks.pool(masks, False), False)
        coef, learned = LagRegression(shapes, self.order_by).solve(task)
        rho, rows = effective_rows(task, coef)
        intercept_um = intercepts_um(task, coef)
        weights = coef.reshape(len(folds), len(responses), -1) / unit_scale(design)
        out = []
        for f in range(len(folds)):
            used = list(shapes[learned["shape"][f]].responses)
            fitted = {
                "weights_um_per_K": weights[f, used],
                "delays_s": np.array([responses[i][0] for i in used]),
                "taus_s": np.array([responses[i][1] for i in used]),
                "intercept_um": float(intercept_um[f]),
                "k": float(learned["k"][f]),
                "n_rows": int(task.pool.count[f]),
                "residual_autocorrelation": float(rho[f]),
                "effective_rows": float(rows[f]),
            }
            out.append(self._learned(design, fitted))
        return out

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Copies share the responses of the inputs; inputs missing for a while are bridged by the last value."""
        own = [list(zip(m.fitted["delays_s"].tolist(), m.fitted["taus_s"].tolist(), strict=True)) for m in fitted]
        place = {response: i for i, response in enumerate(dict.fromkeys(r for some in own for r in some))}
        weights = np.zeros((len(fitted), len(place), len(design.inputs)))
        for f, some in enumerate(own):
            weights[f, [place[r] for r in some]] = fitted[f].fitted["weights_um_per_K"]
        x = lag_responses(design, list(place)).reshape(len(design.time_s), -1)
        predicted = x @ weights.reshape(len(fitted), -1).T + np.array([m.fitted["intercept_um"] for m in fitted])
        return by_batch(design, predicted, wanted)

    def operations(self, b: Builder) -> Sequence[int]:
        x = b.features(self.inputs, required=False)
        begin = np.array([float(b.thermal(name.partition("@")[0])) for name in self.inputs])
        f, parts = self.fitted, []
        for delay_s, tau_s in zip(f["delays_s"].tolist(), f["taus_s"].tolist(), strict=True):
            parts.append(b.delay(b.lag(x, tau_s, begin), delay_s, begin))
        return [b.affine(b.join(*parts), f["weights_um_per_K"].reshape(1, -1), f["intercept_um"])]

    def n_parameters(self) -> int:
        """Coefficients, the order or decay, and the intercept where the level is free."""
        return int(self.fitted["weights_um_per_K"].size) + 1 + (not self.zero_start)

    def _tried(self, design: Design) -> tuple[list[Response], list[Shape]]:
        if self.lags == "koyck":
            return [(0.0, 0.0), *((0.0, tau_s) for tau_s in KOYCK_TAUS_S)], koyck_shapes(len(KOYCK_TAUS_S))
        spacing_s = float(np.nanmax([60.0 * self.lag_min, *steps_s(design)]))
        responses = [(spacing_s * lag, 0.0) for lag in range(self.max_lags + 1)]
        if self.lags == "free":
            return responses, free_shapes(self.max_lags)
        return responses, polynomial_shapes(self.max_lags, self.degree)


def _columns(design: Design, responses: Sequence[Response]) -> Design:
    """The responses of all inputs, in their scale, as the inputs of a design of the same batches."""
    x = lag_responses(design, responses) / unit_scale(design)
    names = tuple(f"{name}@{delay_s:g}s+{tau_s:g}s" for delay_s, tau_s in responses for name in design.inputs)
    y_um = np.where(design.usable, design.y_um, np.nan)
    return Design(names, design.target, design.batch_ids, x.reshape(len(x), -1), y_um, design.time_s, design.offsets,
                  design.step_s, batches=design.batches)  # fmt: skip
