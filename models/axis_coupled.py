"""Spindle and feed axis together: an offset and a slope along the axis, the straight line that controls accept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from data.errors import InputError
from features.design import Design
from models.base import Array, Family
from models.batchwise import too_few_rows
from models.parts.axis_terms import Chosen, RawSums, choose_terms, expanded, fixed_ends_mm, since_first_reading

_LEAST_ROWS = 4


class AxisCoupled(Family):
    """error_um = K0 + tan β · (P − P0), K0 = Σ β_i x_i and tan β = Σ c_j x_j in the rises of the chosen inputs.

    Published (see source): ``K0 = β0 + β1 (T_amb − 20) + β2 dT_spindle``, ``tan β = c0 + c1 (T_amb − 20) + c2 dT_nut``.
    The recorded error is zeroed at every position, E(P, t) − E(P, 0), so what does not change since the first sweep is
    gone from it: β0, c0 and the reference temperature cannot be seen and are not fitted, and every temperature enters
    as its rise since the batch's first reading. A control adds the line to what was true when its zero was set.

    Which inputs drive the offset and which the slope is chosen inside the training batches by the mean left-out S: the
    best pair of an offset and a slope first, then the best term more up to `max_terms`; of the best of these models
    those terms go again that lower the score by less than the share `worth`. P0 is where the
    screw is held: `fixed_end_mm`, else the machine file's `fixed_end`, else chosen likewise among the ends of the
    travel, its quarters, and quarters up to half a travel beyond. An input that drives both leaves P0 open: then it is
    a matter of writing.

    `fitted`: along (the position channel), fixed_end_mm, offset_inputs and offset_um_per_K (o,), slope_inputs and
    slope_um_per_mm_K (s,) (per K, or the input's own unit), inner_S_um, n_rows. NaN is predicted where the position
    is not known.
    """

    key = "axis_coupled"
    words = (
        "offset by the spindle and slope by the screw along an axis, terms by leave-batch-out in the training batches"
    )
    source = "coupled-lathe study: fuzzy clustering, correlation, MLR for spindle offset and screw slope"
    effort = "quick"
    rowwise = False
    needs_position = True
    rank = 13

    def __init__(self, fixed_end_mm: float | None = None, max_terms: int = 8, worth: float = 0.01) -> None:
        super().__init__()
        if max_terms < 2 or not 0 <= worth < 1:
            raise InputError(
                f"axis_coupled: max_terms {max_terms}, worth {worth}; expected at least 2 terms and 0 <= worth < 1"
            )
        self.fixed_end_mm, self.max_terms, self.worth = fixed_end_mm, max_terms, worth

    def fit_design(self, design: Design, train: Sequence[int]) -> Self:
        return self.fit_folds(design, [train])[0]

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold, all at once from per-batch sums of the inputs and of position times input.

        Raises:
            InputError: a target that is not measured along an axis, no inputs, or fewer than 4 readings in a fold.
        """
        if not design.along:
            raise InputError(
                f"axis_coupled: {design.target or 'the target'} is not measured along an axis; give that channel a "
                "position: in the machine file, or choose another family"
            )
        if not design.inputs:
            raise InputError(f"axis_coupled: no inputs given for {design.target}; name at least one channel")
        terms = expanded(design)
        batches = RawSums.of(terms.moments)
        masks = np.zeros((len(folds), design.n_batches), bool)
        for f, fold in enumerate(folds):
            masks[f, list(fold)] = True
            n_rows = int(batches.count[masks[f]].sum())
            if n_rows < _LEAST_ROWS:
                raise too_few_rows(self.key, design, fold, n_rows, _LEAST_ROWS)
        masks &= batches.count > 0
        ends_mm = self._ends_mm(design, masks)
        few = masks.sum(axis=1) < 3  # then contiguous quarters of the batches are left out, as in other families
        chosen: dict[int, Chosen] = {}
        for which, blocks, n in ((~few, batches, 1), (few, RawSums.of(terms.quarters) if few.any() else batches, 4)):
            if which.any():
                sets = np.repeat(masks[which], n, axis=1) & (blocks.count > 0)
                found = choose_terms(blocks, sets, ends_mm[which], self.max_terms, self.worth)
                chosen |= dict(zip(np.flatnonzero(which).tolist(), found, strict=True))
        return [self._learned(design, self._plain(design, chosen[f])) for f in range(len(folds))]

    def _ends_mm(self, design: Design, masks: NDArray[np.bool_]) -> Array:
        """Candidates of P0 for each training set, masks (F, K): (F, 1) where it is told, else (F, C)."""
        part = None if design.machine is None else design.machine.channels.get(design.along)
        told_mm = self.fixed_end_mm if self.fixed_end_mm is not None or part is None else part.fixed_end
        if told_mm is not None:
            return np.full((len(masks), 1), float(told_mm))
        position_mm = design.position_mm(design.along)
        read = np.isfinite(position_mm) & np.isfinite(design.y_um)
        low_mm, high_mm = np.full(design.n_batches, np.inf), np.full(design.n_batches, -np.inf)
        np.minimum.at(low_mm, design.group[read], position_mm[read])
        np.maximum.at(high_mm, design.group[read], position_mm[read])
        return fixed_ends_mm(np.where(masks, low_mm, np.inf).min(axis=1), np.where(masks, high_mm, -np.inf).max(axis=1))

    def _plain(self, design: Design, chosen: Chosen) -> dict[str, Any]:
        p = len(design.inputs)
        offset = [k for k, t in enumerate(chosen.terms) if t < p]
        slope = [k for k, t in enumerate(chosen.terms) if t >= p]
        return {
            "along": design.along,
            "fixed_end_mm": chosen.fixed_end_mm,
            "offset_inputs": [design.inputs[chosen.terms[k]] for k in offset],
            "offset_um_per_K": chosen.coef[offset],
            "slope_inputs": [design.inputs[chosen.terms[k] - p] for k in slope],
            "slope_um_per_mm_K": chosen.coef[slope],
            "inner_S_um": chosen.inner_S_um,
            "n_rows": chosen.n_rows,
        }

    def line(self, design: Design, batch: int) -> tuple[Array, Array]:
        """K0 in µm and tan β in µm/mm on every row of a batch, each (n,): the error at P is K0 + tan β (P − P0)."""
        rows = design.rows(batch)
        rise = since_first_reading(design.x[rows], design.position_mm(self.fitted["along"])[rows])
        place = {name: c for c, name in enumerate(design.inputs)}
        offset, slope = ([place[i] for i in self.fitted[part]] for part in ("offset_inputs", "slope_inputs"))
        return rise[:, offset] @ self.fitted["offset_um_per_K"], rise[:, slope] @ self.fitted["slope_um_per_mm_K"]

    def predict_design(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row without a position, or where a chosen input is missing."""
        out = []
        for k in batches:
            offset_um, slope_um_per_mm = self.line(design, k)
            position_mm = design.position_mm(self.fitted["along"])[design.rows(k)]
            out.append(offset_um + slope_um_per_mm * (position_mm - self.fitted["fixed_end_mm"]))
        return out

    def n_parameters(self) -> int:
        """Coefficients of the chosen terms."""
        return sum(np.size(self.fitted.get(name, ())) for name in ("offset_um_per_K", "slope_um_per_mm_K"))
