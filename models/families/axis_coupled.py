"""Family: offset and slope along a feed axis, the straight line that controls can compensate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.batch import Channel
from data.errors import InputError
from features.design import Design
from features.selectors.left_out import Blocks, LeftOut
from models.base import Family
from models.numerics.batches import fold_masks
from models.program import Builder, Program

_ROUNDING = 1e-6  # of the uncompensated error
# Places of P0 that are tried, as shares of the travel from its low end; of equal ones the first.
_BEYOND = (0.0, 1.0, 0.25, 0.5, 0.75, -0.25, -0.5, 1.25, 1.5)


@dataclass(frozen=True)
class Chosen:
    """One training set's model: terms (term i < p is offset by input i, p + i slope), coef of each, and how it came."""

    terms: tuple[int, ...]
    coef: Array
    fixed_end_mm: float
    inner_S_um: float
    n_rows: int


def since_first_reading(x: Array, position_mm: Array) -> Array:
    """One batch's inputs (n, p) less their first usable value at or after its first row with a position, (n, p)."""
    out = x.copy()
    known = np.flatnonzero(np.isfinite(position_mm))
    if len(known):
        later = np.isfinite(x[known[0] :])
        first = known[0] + later.argmax(axis=0)
        out -= np.where(later.any(axis=0), x[first, np.arange(x.shape[1])], 0.0)
    return out


def expanded(design: Design) -> Design:
    """The design with 2 p inputs, x_i and P x_i, rises counted from each batch's first reading; made once a root.

    Its `started` counts the terms from the first sweep at the same position, as the error is zeroed.
    """
    root = design.root
    whole = root.__dict__.get("_axis_terms")
    if not isinstance(whole, Design):
        position_mm = root.position_mm(root.along)
        parts = [since_first_reading(root.x[root.rows(k)], position_mm[root.rows(k)]) for k in range(root.n_batches)]
        rise = np.concatenate([np.empty((0, len(root.inputs))), *parts])
        names = (*root.inputs, *map(_slope_name, root.inputs))
        x = np.hstack([rise, position_mm[:, None] * rise])
        whole = Design(names, root.target, root.batch_ids, x, root.y_um, root.time_s, root.offsets, root.step_s,
                       batches=root.batches)  # fmt: skip
        root.__dict__["_axis_terms"] = whole
    return whole.subset((*design.inputs, *map(_slope_name, design.inputs)))


def _slope_name(name: str) -> str:
    return f"P·{name}"


def choose_terms(blocks: Blocks, ends_mm: Array, max_terms: int, worth: float) -> Chosen:
    """The model of a training set, of whose blocks sums about zero are given, with P0 among its candidates (C,).

    The score is the mean over the blocks of S in µm with that block left out of the fit. Of the P0 whose scores are
    within the share `worth` of the least, the one that needs the fewest terms is taken, then the first.
    """
    found = [_best_terms(blocks, float(end_mm), max_terms, worth) for end_mm in ends_mm]
    limit_um = (1.0 + worth) * min(m.inner_S_um for m in found)
    return min((m for m in found if m.inner_S_um <= limit_um), key=lambda m: len(m.terms))


def _best_terms(blocks: Blocks, end_mm: float, max_terms: int, worth: float) -> Chosen:
    """The model for one P0.

    The search begins with the best pair of one offset and one slope, goes on with the best term more to the end (one
    alone may be worth nothing where another is missing), takes the best it met and drops what there is not worth it.
    """
    p, zz = blocks.zz.shape[1] // 2, blocks.zz.copy()
    zz[:, 1 + p :] -= end_mm * zz[:, 1 : 1 + p]  # (P − P0) x_i in the place of P x_i
    zz[:, :, 1 + p :] -= end_mm * zz[:, :, 1 : 1 + p]
    state = nothing = LeftOut.of_blocks(Blocks(blocks.count, np.zeros_like(blocks.sum_z), zz))
    terms, best = list[int](), float(nothing.error()[0])
    floor = _ROUNDING * best  # below, scores differ by rounding alone
    pairs = np.maximum(nothing.error_with_two()[0, :p, p:], floor)
    offset, slope = np.divmod(int(pairs.argmin()), p)
    path, comes, error = list[int](), [int(offset), p + int(slope)], float(pairs.min())
    while True:
        path += comes
        for j in comes:
            state = state.taking(np.zeros(1, np.int64), np.array([j]))
        if error < best:
            terms, best = path.copy(), error
        if len(path) >= min(max_terms, 2 * p):
            break
        more = np.maximum(state.error_with()[0], floor)
        more[path] = np.inf
        comes, error = [int(more.argmin())], float(more.min())
    while terms:
        without = np.maximum(_errors_without_each(nothing, terms), floor)
        if best < (1.0 - worth) * without.min():
            break
        best = float(without.min())
        del terms[int(without.argmin())]
    whole, at = zz.sum(axis=0), np.array(terms, np.int64) + 1
    size = np.sqrt(np.diag(whole)[at])
    coef = np.linalg.solve(whole[np.ix_(at, at)] / np.outer(size, size), whole[at, 0] / size) / size
    n_rows = blocks.count.sum()
    return Chosen(tuple(terms), coef, end_mm, best * float(np.sqrt(whole[0, 0] / n_rows)), int(n_rows))


def _errors_without_each(nothing: LeftOut, terms: Sequence[int]) -> Array:
    """Left-out error of the model with all of the terms but one, for each of them (m,)."""
    m, at = len(terms), [0, *(t + 1 for t in terms)]
    learned, left = (np.repeat(v[..., at, :][..., at], m, axis=0) for v in (nothing.learned, nothing.left))
    state = LeftOut(learned, left, nothing.rows)
    for others in np.array([np.delete(np.arange(m), j) for j in range(m)]).T:
        state = state.taking(np.arange(m), others)
    return state.error()


_LEAST_ROWS = 4


class AxisCoupled(Family):
    """error_um = K0 + tan β · (P − P0), K0 = Σ β_i x_i and tan β = Σ c_j x_j in the rises of the chosen inputs.

    Published (see source): ``K0 = β0 + β1 (T_amb − 20) + β2 dT_spindle``, ``tan β = c0 + c1 (T_amb − 20) + c2 dT_nut``.
    The recorded error is zeroed at every position, E(P, t) − E(P, 0), so what does not change since the first sweep is
    gone from it: β0, c0 and the reference temperature cannot be seen and are not fitted, and every temperature enters
    as its rise since the batch's first reading; what the line is during the first sweep is subtracted from it. A
    control adds the line to what was true when its zero was set.

    Which inputs drive the offset and which the slope is chosen inside the training batches by the mean left-out S: the
    best pair of an offset and a slope first, then the best term more up to `max_terms`; of the best of these models
    those terms go again that lower the score by less than the share `worth`. P0 is where the
    screw is held: `fixed_end_mm`, else the machine file's `fixed_end`, else chosen likewise among the ends of the
    travel, its quarters, and quarters up to half a travel beyond. An input that drives both leaves P0 arbitrary.

    `fitted`: along (the position channel), fixed_end_mm, offset_inputs and offset_um_per_K (o,), slope_inputs and
    slope_um_per_mm_K (s,) (per K, or the input's own unit), inner_S_um, n_rows. NaN is predicted where the position
    is not known.
    """

    key = "axis_coupled"
    summary = (
        "offset by the spindle and slope by the screw along an axis, terms by leave-batch-out in the training batches"
    )
    source = "coupled-lathe study: fuzzy clustering, correlation, MLR for spindle offset and screw slope"
    needs_position = True
    rank = 13

    def __init__(self, fixed_end_mm: float | None = None, max_terms: int = 8, worth: float = 0.01) -> None:
        super().__init__()
        if max_terms < 2 or not 0 <= worth < 1:
            raise InputError(
                f"axis_coupled: max_terms {max_terms}, worth {worth}; expected at least 2 terms and 0 <= worth < 1"
            )
        self.fixed_end_mm, self.max_terms, self.worth = fixed_end_mm, max_terms, worth

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
        terms = expanded(design)  # its sums are taken about zero
        terms = terms.started if self.zero_start else replace(terms, about_start=True, _columns=None, _parent=None)
        masks = fold_masks(self.key, design, folds, terms.moments.count, _LEAST_ROWS)
        out = []
        for mask, ends_mm in zip(masks, self._ends_mm(design, masks), strict=True):
            few = mask.sum() < 3  # then contiguous quarters of the batches are left out, as in other families
            sums = terms.quarters if few else terms.moments
            inside = np.repeat(mask, 4 if few else 1) & (sums.count > 0)
            blocks = Blocks.of_moments(sums, np.flatnonzero(inside), np.arange(len(terms.inputs)))
            chosen = choose_terms(blocks, ends_mm, self.max_terms, self.worth)
            out.append(self._learned(design, self._plain(design, chosen)))
        return out

    def _ends_mm(self, design: Design, masks: NDArray[np.bool_]) -> Array:
        """Candidates of P0 for each training set, masks (F, K): (F, 1) where it is given, else (F, C)."""
        part = None if design.machine is None else design.machine.channels.get(design.along)
        told_mm = self.fixed_end_mm if self.fixed_end_mm is not None or part is None else part.fixed_end
        if told_mm is not None:
            return np.full((len(masks), 1), float(told_mm))
        position_mm = design.position_mm(design.along)
        read = np.isfinite(position_mm) & np.isfinite(design.y_um)
        low_mm, high_mm = np.full(design.n_batches, np.inf), np.full(design.n_batches, -np.inf)
        np.minimum.at(low_mm, design.group[read], position_mm[read])
        np.maximum.at(high_mm, design.group[read], position_mm[read])
        low_mm, high_mm = np.where(masks, low_mm, np.inf).min(axis=1), np.where(masks, high_mm, -np.inf).max(axis=1)
        return low_mm[:, None] + np.maximum(high_mm - low_mm, 1.0)[:, None] * np.array(_BEYOND)

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

    def program(self, channels: Mapping[str, Channel], step_s: float) -> Program:
        """Outputs K0 in µm and tan β in µm/mm, each 0 in the first row: the error at P is K0 + tan β (P − P0)."""
        b, f = Builder(channels, step_s), self.fitted
        x = b.since_first(b.features(self.inputs))
        place = {name: c for c, name in enumerate(self.inputs)}
        outputs = []
        for names, coef in ((f["offset_inputs"], f["offset_um_per_K"]), (f["slope_inputs"], f["slope_um_per_mm_K"])):
            weights = np.zeros((1, len(self.inputs)))
            weights[0, [place[n] for n in names]] = coef
            outputs.append(b.affine(x, weights))
        return b.program(outputs, False, f["along"], float(f["fixed_end_mm"]))

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
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
