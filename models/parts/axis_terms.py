"""Which inputs drive an axis' offset and which its slope: forward choice by leave-batch-out on per-batch sums.

Of p inputs x there are 2 p terms: x_i, and (P − P0) x_i. A model is a few of them without a constant. All that is asked
of the rows are sums of products per batch; another P0 is a linear map of those.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from features.design import Design, Moments
from models.base import Array

Mask = NDArray[np.bool_]
Index = NDArray[np.int64]
_NEW = 1e-8  # a term brings something new where at least this part of its square is left beside the terms chosen
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
    """The design with 2 p inputs, x_i and P x_i, rises counted from each batch's first reading; made once a root."""
    root = design.root
    whole = root.__dict__.get("_axis_terms")
    if not isinstance(whole, Design):
        position_mm = root.position_mm(root.along)
        parts = [since_first_reading(root.x[root.rows(k)], position_mm[root.rows(k)]) for k in range(root.n_batches)]
        rise = np.concatenate([np.empty((0, len(root.inputs))), *parts])
        names = (*root.inputs, *map(_slope_name, root.inputs))
        x = np.hstack([rise, position_mm[:, None] * rise])
        whole = Design(names, root.target, root.batch_ids, x, root.y_um, root.time_s, root.offsets, root.step_s)
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
        self.floor_um = _ROUNDING * self.nothing_um  # below, scores tell rounding from rounding

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

        Beside the chosen T a further term c has in every fit a part that T does not explain: W_c = xx_TT⁻¹ xx_Tc, the
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
