"""Family: offset and slope along a feed axis, the straight line that controls can compensate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Index, Mask
from data.batch import Channel
from data.errors import InputError
from features.design import Design, Moments
from models.base import Family
from models.program import Builder, Program
from models.solvers.batches import fold_masks

_NEW = 1e-8  # a term is independent if at least this share of its square is not explained by the chosen terms
_ROUNDING = 1e-6  # of what no model leaves
_BEYOND = (
    0.0,
    1.0,
    0.25,
    0.5,
    0.75,
    -0.25,
    -0.5,
    1.25,
    1.5,
)  # of the travel, from its low end; of equal ones the first


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


@dataclass(frozen=True)
class RawSums:
    """Sums over B blocks of rows about zero: count (B,), xx (B, q, q), xy (B, q), yy (B,)."""

    count: Array
    xx: Array
    xy: Array
    yy: Array

    @classmethod
    def of(cls, m: Moments) -> RawSums:
        across = m.sum_x[:, :, None] * m.shift_x
        shift_xx = m.shift_x[:, None] * m.shift_x
        xx = m.xx + across + across.transpose(0, 2, 1) + m.count[:, None, None] * shift_xx
        xy = m.xy + m.sum_x * m.shift_y + m.shift_x * (m.sum_y + m.count * m.shift_y)[:, None]
        yy = m.yy + 2 * m.sum_y * m.shift_y + m.count * m.shift_y**2
        return cls(m.count, xx, xy, np.maximum(yy, 0.0))

    def total(self, masks: Mask) -> RawSums:
        """Sums over sets of blocks, masks (S, B)."""
        take = masks.astype(float)
        xx = (take @ self.xx.reshape(len(self.xx), -1)).reshape(len(masks), *self.xx.shape[1:])
        return RawSums(take @ self.count, xx, take @ self.xy, take @ self.yy)

    def at(self, which: Index | Mask) -> RawSums:
        """Some of the blocks."""
        return RawSums(self.count[which], self.xx[which], self.xy[which], self.yy[which])

    def less(self, other: RawSums) -> RawSums:
        """Block by block without the other's rows."""
        return RawSums(self.count - other.count, self.xx - other.xx, self.xy - other.xy, self.yy - other.yy)

    def from_end(self, fixed_end_mm: Array) -> RawSums:
        """With (P − P0) x_i in the place of P x_i, P0 (B,) in mm."""
        p = self.xy.shape[1] // 2
        turn = np.tile(np.eye(2 * p), (len(self.xy), 1, 1))
        turn[:, np.arange(p, 2 * p), np.arange(p)] = -fixed_end_mm[:, None]
        xx = turn @ self.xx @ turn.transpose(0, 2, 1)
        return RawSums(self.count, xx, (turn @ self.xy[:, :, None])[:, :, 0], self.yy)


def fixed_ends_mm(low_mm: Array, high_mm: Array) -> Array:
    """Candidates of P0 (S, 9) for travels from low to high (S,)."""
    travel_mm = np.maximum(high_mm - low_mm, 1.0)
    return low_mm[:, None] + travel_mm[:, None] * np.array(_BEYOND)


def choose_terms(blocks: RawSums, masks: Mask, ends_mm: Array, max_terms: int, worth: float) -> list[Chosen]:
    """The model of each training set, masks (S, B) over the blocks, with P0 among its candidates `ends_mm` (S, C).

    The score is the mean over a set's blocks of S in µm with that block left out of the fit. Of the P0 whose scores are
    within the share `worth` of the least, the one that needs the fewest terms is taken, then the first.
    """
    outer, left = np.nonzero(masks)
    whole = blocks.total(masks)
    found: list[list[Chosen]] = [[] for _ in masks]
    for end_mm in ends_mm.T:
        turned, tested = whole.from_end(end_mm), blocks.at(left).from_end(end_mm[outer])
        search = _Search(turned.at(outer).less(tested), tested, outer)
        for s, (terms, S_um) in enumerate(search.run(max_terms, worth)):
            t = np.array(terms, np.int64)
            coef = _solved(turned.xx[s][np.ix_(t, t)], turned.xy[s][t][:, None])[:, 0]
            found[s].append(Chosen(terms, coef, float(end_mm[s]), S_um, int(whole.count[s])))
    return [_simplest(of_set, worth) for of_set in found]


def _simplest(models: Sequence[Chosen], worth: float) -> Chosen:
    limit_um = (1.0 + worth) * min(m.inner_S_um for m in models)
    return min((m for m in models if m.inner_S_um <= limit_um), key=lambda m: len(m.terms))


class _Search:
    """Choice of terms for S training sets at once. `fit` and `tested` hold the sums of the fits and of the blocks left
    out of them (V,), `outer` the set of each, rising.

    It begins with the best pair of one offset and one slope, goes on with the best term more to the end (one alone may
    be worth nothing where another is missing), takes the best it met and drops what there is not worth it.
    """

    def __init__(self, fit: RawSums, tested: RawSums, outer: Index) -> None:
        self.fit, self.tested = fit, tested
        self.border = np.searchsorted(outer, np.arange(int(outer[-1]) + 2))
        self.floor_um = np.zeros(len(self.border) - 1)
        everything = np.arange(len(self.floor_um))
        self.nothing_um = self._scores(everything, np.zeros((len(everything), 0), np.int64))
        self.floor_um = _ROUNDING * self.nothing_um  # below, scores differ by rounding alone

    def run(self, max_terms: int, worth: float) -> list[tuple[tuple[int, ...], float]]:
        """Terms and score of each set."""
        sets = np.arange(len(self.floor_um))
        terms = [np.zeros(0, np.int64) for _ in sets]
        best = self.nothing_um.copy()
        going = sets
        path, S_um = self._best_pairs(sets)
        while True:
            for s in np.flatnonzero(S_um < best[going]):
                terms[going[s]], best[going[s]] = path[s], S_um[s]
            on = np.isfinite(S_um)  # else no term is left that is new
            going, path = going[on], path[on]
            if path.shape[1] >= min(max_terms, self.fit.xy.shape[1]) or not len(going):
                break
            more = self._with_one_more(going, path)
            path, S_um = np.column_stack([path, more.argmin(axis=1)]), more.min(axis=1)
        return [self._pruned(s, t, float(best[s]), 1.0 - worth) for s, t in enumerate(terms)]

    def _pruned(self, s: int, terms: Index, S_um: float, keep: float) -> tuple[tuple[int, ...], float]:
        """Without the terms that lower the score of set s to no less than the share `keep` of what it is without."""
        while len(terms):
            fewer = np.array([np.delete(terms, j) for j in range(len(terms))], np.int64)
            without = self._scores(np.full(len(fewer), s), fewer)
            least = int(without.argmin())
            if S_um < keep * without[least]:
                break
            terms, S_um = fewer[least], float(without[least])
        return tuple(terms.tolist()), S_um

    def _best_pairs(self, sets: Index) -> tuple[Index, Array]:
        """The offset and the slope (S, 2) that are best together, and their score (S,)."""
        p = self.fit.xy.shape[1] // 2
        found = self._with_one_more(np.repeat(sets, p), np.tile(np.arange(p), len(sets))[:, None])
        slopes = found.reshape(len(sets), p, 2 * p)[:, :, p:].reshape(len(sets), -1)
        offset, slope = np.divmod(slopes.argmin(axis=1), p)
        return np.column_stack([offset, p + slope]), slopes.min(axis=1)

    def _with_one_more(self, sets: Index, chosen: Index) -> Array:
        """Scores (s, q) of sets with the terms chosen (s, m) and one more; infinite where that is nothing new.

        Next to the chosen T a further term c has in every fit a part that T does not explain: W_c = xx_TT⁻¹ xx_Tc, the
        part's square d_c and its product r_c with what T leaves of the error. With b_c = r_c / d_c as its coefficient
        the left-out sum of squares is that of T less 2 b_c g_c − b_c² h_c, where g_c and h_c are the same product and
        square in the block left out.
        """
        entry, row = self._rows(sets)
        T, v = chosen[entry], row[:, None]
        xx_TT, out_TT = (of.xx[v[:, :, None], T[:, :, None], T[:, None, :]] for of in (self.fit, self.tested))
        xx_Tc, out_Tc, xy = self.fit.xx[v, T], self.tested.xx[v, T], self.fit.xy[row]
        W = _solved(xx_TT, xx_Tc)
        b_T = _solved(xx_TT, self.fit.xy[v, T][:, :, None])[:, :, 0]
        square = np.einsum("vqq->vq", self.fit.xx)[row]
        d = square - np.einsum("vmq,vmq->vq", W, xx_Tc)
        r = xy - np.einsum("vmq,vm->vq", W, self.fit.xy[v, T])
        new = d > _NEW * square
        np.put_along_axis(new, T, False, axis=1)
        b = np.where(new, r / np.where(new, d, 1.0), 0.0)
        rest = self.tested.xy[row] - np.einsum("vm,vmq->vq", b_T, out_Tc)
        rest_T = np.take_along_axis(rest, T, axis=1)
        g = rest - np.einsum("vmq,vm->vq", W, rest_T)
        h = np.einsum("vqq->vq", self.tested.xx)[row] - 2 * np.einsum("vmq,vmq->vq", W, out_Tc)
        h += np.einsum("vmq,vmq->vq", W, out_TT @ W)
        left_by_T = self.tested.yy[row] - np.einsum("vm,vm->v", b_T, self.tested.xy[v, T] + rest_T)
        sse = np.where(new, left_by_T[:, None] - 2 * b * g + b**2 * h, np.inf)
        return self._mean_S(sets, entry, row, sse)

    def _scores(self, sets: Index, chosen: Index) -> Array:
        """Scores (s,) of sets with the terms chosen (s, m)."""
        entry, row = self._rows(sets)
        T, v = chosen[entry], row[:, None]
        xx_TT, out_TT = (of.xx[v[:, :, None], T[:, :, None], T[:, None, :]] for of in (self.fit, self.tested))
        b = _solved(xx_TT, self.fit.xy[v, T][:, :, None])
        explained = 2 * self.tested.xy[v, T][:, None, :] @ b - b.transpose(0, 2, 1) @ out_TT @ b
        return self._mean_S(sets, entry, row, self.tested.yy[row] - explained[:, 0, 0])

    def _rows(self, sets: Index) -> tuple[Index, Index]:
        """For each of the sets, one after the other, its fits: place in `sets` (u,) and place in `fit` (u,)."""
        count = self.border[sets + 1] - self.border[sets]
        entry = np.repeat(np.arange(len(sets)), count)
        return entry, np.arange(len(entry)) + (self.border[sets] - np.cumsum(count) + count)[entry]

    def _mean_S(self, sets: Index, entry: Index, row: Index, sse: Array) -> Array:
        """Mean S in µm (s, …) over the blocks of each of the sets, from sums of squares (u, …)."""
        wide = (-1, *[1] * (sse.ndim - 1))
        freedom = np.maximum(self.tested.count[row] - 1.0, 1.0).reshape(wide)
        S_um = np.sqrt(np.maximum(sse, 0.0) / freedom)
        total = np.add.reduceat(S_um, np.searchsorted(entry, np.arange(len(sets))), axis=0)
        out: Array = np.maximum(total / np.bincount(entry).reshape(wide), self.floor_um[sets].reshape(wide))
        return out


def _solved(xx: Array, right: Array) -> Array:
    """xx⁻¹ right (…, m, k) of positive definite xx (…, m, m), scaled to a unit diagonal."""
    if not xx.shape[-1]:
        return np.zeros_like(right)
    scale = np.sqrt(np.einsum("...mm->...m", xx))[..., None]
    out: Array = np.linalg.solve(xx / (scale * np.swapaxes(scale, -1, -2)), right / scale) / scale
    return out


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
        terms = self.started(expanded(design))
        batches = RawSums.of(terms.moments)
        masks = fold_masks(self.key, design, folds, batches.count, _LEAST_ROWS)
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
