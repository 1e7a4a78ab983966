"""Family: support vector regression with an RBF kernel."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Self

import numpy as np

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import inner_groups
from models.numerics.batches import too_few_rows
from models.numerics.kernels import KernelExpansion, Rows, evenly, kernel, unit_scale

_LEAST_ROWS_PER_BATCH = 3
_GROUPS = 3  # that the training batches are left out in, when the setting is chosen
_STEPS_CHOICE, _STEPS_FIT = 2_000, 2_000_000  # of libsvm: a setting that needs more is judged unconverged


class SVR(KernelExpansion):
    """ε-insensitive support vector regression, `k(u, v) = exp(−|u − v|²/(2 p σ²))`, by libsvm through scikit-learn.

    u are the p inputs over a fixed scale per unit, as in lssvm; the error is standardised by the training rows. Outside
    the trained seasons the kernel dies out and the model falls back to its bias. Batches are decimated evenly, to at
    most `max_rows` together. σ from `sigmas`, C from `costs` over the number of rows, and then ε (in standard
    deviations of the error) from `epsilons`, the first of which is used until then: least mean RMS over left-out groups
    of whole training batches (every third; contiguous quarters of one or two batches), on half the rows. `fitted` has
    rows, setting and score, and the support rows: a trained model predicts without scikit-learn.

    Source: V. Vapnik, The nature of statistical learning theory (1995), ch. 6; C.-C. Chang and C.-J. Lin, LIBSVM: a
    library for support vector machines (2011).
    """

    key = "svr"
    summary = "support vector regression, RBF kernel"
    source = "Vapnik 1995; Chang and Lin 2011"
    rank = 62
    linear = False

    def __init__(
        self,
        max_rows: int = 240,
        sigmas: Sequence[float] = (1.0, 3.0, 10.0),
        costs: Sequence[float] = (3e3, 3e4, 3e5),
        epsilons: Sequence[float] = (0.05, 0.02, 0.1),
    ) -> None:
        super().__init__()
        self.max_rows = int(max_rows)
        self.sigmas, self.costs = [float(s) for s in sigmas], [float(c) for c in costs]
        self.epsilons = [float(e) for e in epsilons]
        if not all(v and min(v) > 0 for v in (self.sigmas, self.costs, self.epsilons)) or max_rows < 2:
            raise InputError(
                f"svr: max_rows {max_rows}, sigmas {self.sigmas}, costs {self.costs}, epsilons {self.epsilons}; "
                "expected at least 2 rows and values above 0"
            )

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        """Raises InputError: fewer than 2 usable rows."""
        design = self.started(design)  # the weights sum to 0, so that k may replace the kernel from the start
        rows = self._kept(design, train, self.max_rows)
        if len(rows) < 2:
            raise too_few_rows(self.key, design, train, len(rows), 2)
        scale = unit_scale(design)
        sigma, cost, epsilon, inner_rms_um = self._chosen(design, self._kept(design, train, self.max_rows // 2), scale)
        u = design.x[rows] / scale
        support, alpha, bias = _fitted(kernel(u, u, sigma, False), design.y_um[rows], cost, epsilon, _STEPS_FIT)
        fitted = {
            "support": u[support],
            "alpha": alpha,
            "bias": bias,
            "sigma": sigma,
            "C": cost / len(rows),
            "epsilon": epsilon,
            "scale": scale,
            "n_rows": len(rows),
            "n_usable_rows": int(np.isin(design.group[design.usable], list(train)).sum()),
            "inner_rms_um": inner_rms_um,
        }
        return self._learned(design, fitted)

    def _kept(self, design: Design, train: Sequence[int], most: int) -> Rows:
        return evenly(design, train, max(_LEAST_ROWS_PER_BATCH, most // max(1, len(train))))

    def _chosen(self, design: Design, rows: Rows, scale: Array) -> tuple[float, float, float, float]:
        """σ, cost, ε and their left-out RMS in µm."""
        u, y_um = design.x[rows] / scale, design.y_um[rows]
        group = inner_groups(design.group[rows]) % _GROUPS
        omega = {sigma: kernel(u, u, sigma, False) for sigma in self.sigmas}

        def score(sigma: float, cost: float, epsilon: float) -> tuple[float, float, float, float]:
            rms_um = []
            for left in (group == g for g in np.unique(group)):
                inside = omega[sigma][:, ~left]
                support, alpha, bias = _fitted(inside[~left], y_um[~left], cost, epsilon, _STEPS_CHOICE)
                rms_um.append(np.sqrt(np.mean((y_um[left] - inside[left][:, support] @ alpha - bias) ** 2)))
            return float(np.mean(rms_um)), sigma, cost, epsilon

        best = min(score(sigma, cost, self.epsilons[0]) for sigma in self.sigmas for cost in self.costs)
        best = min([best, *(score(best[1], best[2], epsilon) for epsilon in self.epsilons[1:])])
        return best[1], best[2], best[3], best[0]


def _fitted(omega: Array, y_um: Array, cost: float, epsilon: float, steps: int) -> tuple[Rows, Array, float]:
    """The support rows, their weights and the bias in µm, for the kernel matrix and C = cost/n."""
    from sklearn import config_context, svm  # here alone: a trained model predicts without it

    mean_um, spread_um = float(y_um.mean()), float(y_um.std()) or 1.0
    machine = svm.SVR(kernel="precomputed", C=cost / len(y_um), epsilon=epsilon, max_iter=steps)
    with config_context(assume_finite=True, skip_parameter_validation=True), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the most steps
        machine.fit(omega, (y_um - mean_um) / spread_um)
    support = machine.support_.astype(np.int64)
    return support, spread_um * machine.dual_coef_[0], mean_um + spread_um * float(machine.intercept_[0])
