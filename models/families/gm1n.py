"""Family: grey model GM(1,N), free-running."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np
from scipy.signal import lfilter

from data.arrays import Array
from data.errors import InputError, closest
from features.design import Design
from features.grey import equations, least_squares
from models.base import Family, Plain
from models.numerics.batches import bridged, by_batch, padded, steps_s, too_few_rows, unpadded
from models.program import Builder

RESPONSES = ("difference", "whitening")
_A_HIGHEST = 2.0  # beyond it the recursion's pole (1 − a/2)/(1 + a/2) is negative: the prediction would zigzag


class GM1N(Family):
    """Grey model GM(1,N) of the error x1 and N − 1 inputs; (a, b) by least squares over all training batches.

    `x1⁰(k) + a z(k) = Σ b_i x_i¹(k)`, `z(k) = (x1¹(k) + x1¹(k−1))/2`, `¹` the cumulated sum (1-AGO), begun anew in
    every batch. A free run knows no measured error, so it starts from x1⁰(1) = 0: the errors are zeroed at the
    batch's first sample. Responses:

    - `difference`: `x̂1⁰(k) = (Σ b_i x_i¹(k) − a x̂1¹(k−1))/(1 + a/2)`, the fitted equation solved row by row;
    - `whitening`: `x̂1¹(k+1) = s(k+1)/a · (1 − exp(−a k))`, `s = Σ b_i x_i¹`, differenced. It is the published
      one, exact only for inputs whose cumulated sum stays constant.

    `recent_rows` fits to only so many of each batch's most recent usable rows, the published sequence length; their
    sums begin with the first of them, whose error is not 0, so that a is large where the error follows its inputs
    at once. None takes whole batches.

    a is kept in [step/`slowest_h`, 2]: below, the response has no end in sight (a near 0 divides, a < 0 explodes);
    above, it zigzags. Where least squares leaves that range, a is set to the bound, b is fitted anew, and `fitted`
    records it in `bound`. Directions of the scaled sums below 1e-4 of the strongest are dropped. Training uses usable
    rows; the sums bridge holes by the last input and by a straight line in the error. Predictions bridge missing
    inputs by the last one, and are NaN where a batch lacks one wholly.

    Source: J. Deng, Introduction to grey system theory, J. Grey System 1 (1989); with the recursive response,
    because the whitening response's premise of constant inputs never holds for rising temperatures.
    """

    key = "gm1n"
    summary = "grey model GM(1,N), free-running"
    source = "Deng 1989"
    rank = 30

    def __init__(self, response: str = "difference", slowest_h: float = 24.0, recent_rows: int | None = None) -> None:
        super().__init__()
        if response not in RESPONSES:
            raise InputError(f"family gm1n: unknown response {response!r}: {closest(response, RESPONSES)}")
        self.response = response
        if recent_rows is not None and recent_rows < 2:
            raise InputError(f"family gm1n: recent_rows {recent_rows}; expected at least 2 rows, or None for all")
        self.slowest_h = float(slowest_h)
        self.recent_rows = recent_rows

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """Every fold from the batches' triangular factors: each batch is read once, whatever the number of folds.

        Raises:
            InputError: too few usable rows, or training batches of different steps.
        """
        columns = len(design.inputs) + 2
        factors, counts = np.zeros((design.n_batches, columns, columns)), np.zeros(design.n_batches, int)
        used = sorted({k for fold in folds for k in fold})
        for k in used:
            rows = equations(design, k, self.recent_rows)
            counts[k] = len(rows)
            r = np.linalg.qr(rows, mode="r")
            factors[k, : len(r)] = r
        member = np.array([np.isin(used, list(fold)) for fold in folds], float)
        stacked = (member[:, :, None, None] * factors[used]).reshape(len(folds), -1, columns)
        triangles = np.linalg.qr(stacked, mode="r")
        steps = steps_s(design)
        out = []
        for f, fold in enumerate(folds):
            step_s = _common_step(design, fold, steps)
            got = int(counts[list(fold)].sum())
            if got < columns or not np.isfinite(step_s):
                raise too_few_rows(self.key, design, fold, got, columns)
            out.append(self._learned(design, self._solve(triangles[f], step_s) | {"n_rows": got}))
        return out

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """Error_um (n_k,) per copy and batch, from a zero error at its start.

        Raises:
            InputError: a batch of another step than the model learned from.
        """
        steps = steps_s(design)
        for k in sorted({k for batches in wanted for k in batches}):
            for m in fitted:
                learned_s = m.fitted["step_s"]
                if abs(steps[k] - learned_s) > 1e-3 * learned_s:
                    raise InputError(
                        f"family gm1n: batch {design.batch_ids[k]} has a step of {steps[k]:g} s, the model learned "
                        f"from {learned_s:g} s and its sums count rows; resample the batch to {learned_s:g} s"
                    )
        held = bridged(design, design.x)
        out = np.empty((len(design.time_s), len(fitted)))
        for f, m in enumerate(fitted):
            drive = padded(design, held @ m.fitted["b"])
            out[:, f] = unpadded(design, response(drive, m.fitted["a"], self.response))
        return by_batch(design, out, wanted)

    def operations(self, b: Builder) -> Sequence[int]:
        """A first-order lag of the drive, at the step that was learned from.

        Raises:
            InputError: another step, the other response, or an input that is not 0 at a batch's start: there the sums
                count its first value in the second row.
        """
        learned_s, a = float(self.fitted["step_s"]), float(self.fitted["a"])
        drives = [n for n in self.inputs if not b.thermal(n.partition("@")[0]) or n.endswith("@start")]
        if self.response != "difference" or drives or abs(b.step_s - learned_s) > 1e-3 * learned_s:
            raise InputError(
                f"family {self.key}: a program needs the response difference, inputs that are 0 at the start and the "
                f"step it learned from, {learned_s:g} s; got {self.response}, {', '.join(self.inputs)} and "
                f"{b.step_s:g} s"
            )
        c = 1.0 / (1.0 + a / 2.0)
        keep = (1.0 - a / 2.0) * c
        drive = b.affine(b.features(self.inputs, required=False), c / (1.0 - keep) * self.fitted["b"][None])
        return [b.add("lag", [drive], 1, keep=keep, begin=1.0)]

    def n_parameters(self) -> int:
        return 1 + len(self.inputs)

    def _solve(self, triangle: Array, step_s: float) -> Plain:
        """(a, b) from the R factor of [−z, X¹ | x1⁰], a inside its bounds."""
        fit = least_squares(triangle)
        lowest = min(step_s / (3600.0 * self.slowest_h), _A_HIGHEST)
        bound = "none" if lowest <= fit.a <= _A_HIGHEST else ("lowest" if fit.a < lowest else "highest")
        if bound != "none":
            fit = least_squares(triangle, a=float(np.clip(fit.a, lowest, _A_HIGHEST)))
        return {"a": fit.a, "b": fit.b, "step_s": step_s, "bound": bound, "condition": fit.condition}


def response(drive: Array, a: float, kind: str = "difference", first_um: float = 0.0) -> Array:
    """x̂1⁰ (K, n) from Σ b_i x_i⁰ (K, n), `first_um` in the first row, by either response."""
    if drive.shape[1] == 0:
        return drive.copy()
    if kind == "whitening":
        k = np.arange(drive.shape[1])
        cumulated = np.cumsum(drive, axis=1) / a * -np.expm1(-a * k) + first_um * np.exp(-a * k)
        return np.diff(cumulated, axis=1, prepend=0.0)
    # The recursion on sums, differenced: x⁰(k) = r x⁰(k−1) + c u(k), where u(1) counts in the second row.
    u = drive.copy()
    u[:, 0] = 0.0
    u[:, 1:2] += drive[:, :1] - a * first_um
    c = 1.0 / (1.0 + a / 2.0)
    out: Array = lfilter([c], [1.0, -(1.0 - a / 2.0) * c], u, axis=1)
    out[:, 0] = first_um
    return out


def _common_step(design: Design, train: Sequence[int], steps: Array) -> float:
    known = [k for k in train if np.isfinite(steps[k])]
    if not known:
        return float("nan")
    first = known[0]
    for k in known:
        if abs(steps[k] - steps[first]) > 1e-3 * steps[first]:
            raise InputError(
                f"family gm1n: batch {design.batch_ids[k]} has a step of {steps[k]:g} s, batch "
                f"{design.batch_ids[first]} of {steps[first]:g} s; its sums count rows: ingest both at one step"
            )
    return float(steps[first])
