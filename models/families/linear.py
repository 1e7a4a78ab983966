"""Base classes of linear families, fitted from pooled per-batch moments.

Rows are read once, for the moments. A fold's covariance is a sum over its batches, so 30 folds cost 30 small
matrices, and a choice by leave-batch-out inside them 435 more (leaving out i and k is one fit, whichever is outer).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array, Mask
from data.errors import InputError
from features.design import Design
from models.base import Family
from models.metrics import SIDE_OF_90, row_quantiles
from models.numerics.batches import fold_masks
from models.numerics.kernels import unit_scale
from models.numerics.pooled_sums import AT_ONCE, Blocks, CoefPath, Pool, fitted_paths, inner_sets, left_out_mean_S_um
from models.program import Builder
from models.protocols import forward_obstacle, in_time

_ENOUGH_BATCHES, _ENOUGH_FOR_FORWARD = 3, 6
_MOST_ROWS = 120  # of a batch that residuals are taken at: neighbours are redundant, and a fold must not cost rows
_LEAST_SHARE = 0.01  # of the mean square residual, that a keeps: no recorded value is free of noise


def mean_square(x: Array, design: Design) -> Array:
    """Mean over the inputs of their square (n,), each over the scale of its unit (10 K, 1000 rpm, …)."""
    return np.asarray(((x / unit_scale(design)) ** 2).mean(axis=1))


def stated_sd_um(family: Family, design: Design, batches: Sequence[int]) -> list[Array]:
    """Predictive standard deviation (n_k,) from the (a, b) of `left_out_spread` that a fitted family holds.

    NaN throughout where fewer than three batches were learned from.
    """
    a, b = (family.fitted.get(name, np.nan) for name in ("variance_um2", "variance_growth_um2"))
    x = family.started(design).x
    return [np.sqrt(a + b * mean_square(x[design.rows(k)], design)) for k in batches]


def left_out_spread(task: Task, square: Array, path: CoefPath, chosen: NDArray[np.int64]) -> tuple[Array, Array]:
    """(a, b) of variance = a + b · square for every training set of a task, (F,) each; NaN below three batches.

    Every batch of a set is predicted by the set's own setting `chosen` (F,) of `path`, learned without that batch.
    a > 0 and b ≥ 0 are least squares of the squared residuals, then made larger until nine tenths of them lie inside
    the 90 % interval and their mean square is as stated. A batch that goes astray does so in proportion to its rises
    (random slopes: Laird and Ware 1982); a represents noise and for the zero of a batch, which has noise too.

    Args:
        square: what the variance grows with, on every row of the design, (n,).
    """
    design, masks = task.design, task.masks
    a, b = np.full(len(masks), np.nan), np.full(len(masks), np.nan)
    many = np.flatnonzero(masks.sum(axis=1) >= _ENOUGH_BATCHES)
    if len(many):
        every = [np.flatnonzero(design.usable[design.rows(k)]) + design.offsets[k] for k in range(design.n_batches)]
        rows = [own[:: -(-len(own) // _MOST_ROWS) or 1] for own in every]
        error = _left_out_um(task, rows, masks[many], path, chosen[many])
        a[many], b[many] = _fitted(error**2, square[np.concatenate(rows)])
    return a, b


def _left_out_um(
    task: Task, rows: Sequence[NDArray[np.int64]], masks: Mask, path: CoefPath, chosen: NDArray[np.int64]
) -> Array:
    """Residuals (F, m) at the m `rows` of all batches, each left out of its set; NaN where a set lacks the batch."""
    design, moments = task.design, task.design.moments
    outer, left, sets, which = inner_sets(masks)
    coef, constant = np.empty((len(which), len(design.inputs))), np.empty(len(which))
    for here, at, pool, found in fitted_paths(task.blocks, sets, which, task.scaled, path):
        coef[here] = found[at, :, chosen[outer[here]]]
        mean_x, mean_y = pool.mean_x[at] + moments.shift_x, pool.mean_y[at] + moments.shift_y
        constant[here] = mean_y - np.einsum("vj,vj->v", mean_x, coef[here])
    order = np.argsort(left, kind="stable")
    outer, coef, constant = outer[order], coef[order], constant[order]
    sets_of = np.searchsorted(left[order], np.arange(len(rows) + 1))
    border, every = np.cumsum([0, *map(len, rows)]), np.concatenate(rows)
    x, y_um = design.x[every], design.y_um[every]
    out = np.full((len(masks), len(every)), np.nan)
    for k in range(len(rows)):
        some, own = slice(sets_of[k], sets_of[k + 1]), slice(border[k], border[k + 1])
        out[outer[some], own] = y_um[own] - (coef[some] @ x[own].T + constant[some, None])
    return out


def _fitted(squared: Array, grows: Array) -> tuple[Array, Array]:
    """Least squares a + b · grows (m,) of each set's squared residuals (F, m), NaN left out; (F,) each.

    b ≥ 0, a above its least share, in the size that holds nine tenths of them.
    """
    known = np.isfinite(squared)
    filled, take = np.where(known, squared, 0.0), known.astype(float)
    n, q, qq = take.sum(axis=1), take @ grows, take @ grows**2
    s, sq = filled.sum(axis=1), filled @ grows
    mean, determinant = s / n, n * qq - q * q
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # flat inputs, or residuals of rounding alone
        a, b = (qq * s - q * sq) / determinant, (n * sq - q * s) / determinant
        flat, low = ~(determinant > 0) | ~(b > 0), a < _LEAST_SHARE * mean
        a, b = np.where(low, _LEAST_SHARE * mean, a), np.where(low, np.maximum(sq - _LEAST_SHARE * mean * q, 0) / qq, b)
        a, b = np.where(flat, mean, a), np.where(flat, 0.0, b)
        ratio = squared / (a[:, None] + b[:, None] * grows)
        size = np.maximum(np.where(known, ratio, 0.0).sum(axis=1) / n, row_quantiles(ratio, 0.9) / SIDE_OF_90**2)
        return np.where(s == 0, 0.0, a * size), np.where(s == 0, 0.0, b * size)


EPS = float(np.finfo(float).eps)
DIGITS_LEFT = 1e8  # beyond this condition of the covariance a fit goes back to the rows
_CONDITION_SEEN = 1e10  # beyond this the condition itself is taken from the rows
_MIN_ROWS = 4
_KELVIN = ("K", "degC")


@dataclass(frozen=True)
class Task:
    """What a linear family fits: the design, its folds as masks (F, K), their pooled moments."""

    design: Design
    masks: Mask
    blocks: Blocks
    pool: Pool
    scaled: bool

    @classmethod
    def of(cls, design: Design, masks: Mask, scaled: bool) -> Self:
        """The fits of F training sets: `masks` (F, n_batches); `scaled`: inputs in units of their spread."""
        blocks = Blocks.of(design.moments)
        return cls(design, masks, blocks, blocks.pool(masks, scaled), scaled)

    def intercept_um(self, coef: Array) -> Array:
        """Intercepts (F,) of coefficients (F, p) fitted about the means."""
        moments, pool = self.design.moments, self.pool
        mean_x, mean_um = pool.mean_x + moments.shift_x, pool.mean_y + moments.shift_y
        return np.asarray(mean_um - np.einsum("fj,fj->f", mean_x, coef))

    def chosen(self, path: CoefPath, order_by: str) -> NDArray[np.int64]:
        """The setting of a path (F,) of least mean S over batches left out, from each fold's training batches.

        By `order_by` "leave_batch_out" each in turn; by "forward" every one from the third in time on, predicted from
        those before it. Fewer than 6 batches, or undated ones, are left out in turn; of fewer than 3 contiguous
        quarters (`models.base.inner_groups`).
        """
        chosen, n = np.zeros(len(self.masks), np.int64), self.masks.sum(axis=1)
        known = self.design.batches  # of a design made by hand batches are in order as they come
        place = np.argsort(in_time(known)) if known else np.arange(self.design.n_batches)
        forward = order_by == "forward" and not (known and forward_obstacle(known))
        ahead, few = forward & (n >= _ENOUGH_FOR_FORWARD), n < _ENOUGH_BATCHES
        for some, order in ((ahead, place), (~ahead & ~few, None)):
            if some.any():
                S_um = left_out_mean_S_um(self.blocks, self.masks[some], self.scaled, path, order)
                chosen[some] = np.argmin(S_um, axis=1)
        if few.any():
            quarters = Blocks.of(self.design.quarters)
            masks = np.repeat(self.masks[few], 4, axis=1) & (quarters.count > 0)
            chosen[few] = np.argmin(left_out_mean_S_um(quarters, masks, self.scaled, path), axis=1)
        return chosen

    @cached_property
    def _factors(self) -> list[tuple[Array, Array, float]]:
        """Per batch the triangle of its centred rows [x, y], their mean, their number."""
        out = []
        for k in range(self.design.n_batches):
            rows = self.design.rows(k)
            ok = self.design.usable[rows]
            table = np.column_stack([self.design.x[rows][ok], self.design.y_um[rows][ok]])
            free = len(table) > 0 and not self.design.about_start
            mean = table.mean(axis=0) if free else np.zeros(table.shape[1])
            triangle: Array = np.asarray(np.linalg.qr(table - mean, mode="r"))
            out.append((triangle, mean, float(len(table))))
        return out

    def centred_rows(self, f: int) -> tuple[Array, Array]:
        """Fold f's centred rows up to a rotation, x (m, p) over `scale` and y_um (m,): fitted unsquared."""
        parts = [self._factors[k] for k in np.flatnonzero(self.masks[f])]
        count = np.array([n for _, _, n in parts])
        means = np.array([mean for _, mean, _ in parts])
        between = np.sqrt(count)[:, None] * (means - count @ means / count.sum())
        table = np.vstack([*(r for r, _, _ in parts), between])
        flat = np.einsum("jj->j", self.pool.xx[f]) == 0
        table[:, :-1][:, flat] = 0.0
        return table[:, :-1] / self.pool.scale[f], table[:, -1]

    def condition(self) -> Array:
        """Condition number (F,) of the inputs that move, each over its own spread (Belsley 1980); at most 1/eps."""
        correlation, _ = self.pool.correlation()
        values = np.linalg.eigvalsh(correlation)
        with np.errstate(divide="ignore", invalid="ignore"):
            out = np.sqrt(values[:, -1] / values[:, 0])
        for f in np.flatnonzero(~(values[:, 0] * _CONDITION_SEEN > values[:, -1] * self.pool.loss)):
            x, _ = self.centred_rows(int(f))
            size = np.linalg.norm(x, axis=0)
            singular = np.linalg.svd(x[:, size > 0] / size[size > 0], compute_uv=False)
            short = len(singular) < np.count_nonzero(size)
            out[f] = 1 / EPS if short or singular[-1] <= EPS * singular[0] else singular[0] / singular[-1]
        return out


class Linear(Family):
    """error_um = x · coef_um_per_K, with the inputs x relative to the batch's start; `as_published` + intercept_um.

    `fitted`: coef_um_per_K (p,) (µm per K, or per the input's own unit), intercept_um, condition, n_rows and what the
    family adds. Families that are not indifferent to scale take the inputs as they are where all are in K or degC
    (or the design knows no units), and divided by their training rms (`as_published`: std) where another unit is among
    them. "Centred" sums are about the start, so that no intercept is fitted (`as_published`: about the mean).
    """

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """One fitted copy per fold, all at once from the design's moments.

        Raises:
            InputError: no inputs, or fewer than 4 usable rows in a fold.
        """
        if not folds:
            return []
        if not design.inputs:
            target = design.target or "the error"
            raise InputError(f"{self.key}: no inputs given for {target}; name at least one channel")
        design = self.started(design)
        masks = fold_masks(self.key, design, folds, design.moments.count, _MIN_ROWS)
        task = Task.of(design, masks, any(unit not in _KELVIN for unit in design.input_units))
        coef, learned = self._solve(task)
        pool = task.pool
        coef = np.where(np.einsum("fjj->fj", pool.xx) > 0, coef, 0.0)
        own = {"intercept_um": task.intercept_um(coef), "condition": task.condition(), "n_rows": pool.count.astype(int)}
        learned = own | learned
        columns = {name: values.tolist() for name, values in learned.items()}
        return [
            self._learned(design, {"coef_um_per_K": coef[f], **{n: v[f] for n, v in columns.items() if v[f] == v[f]}})
            for f in range(len(folds))
        ]

    def operations(self, b: Builder) -> Sequence[int]:
        x = b.features(self.inputs)
        return [b.affine(x, self.fitted["coef_um_per_K"][None], self.fitted["intercept_um"])]

    def respond_folds(
        self, design: Design, fitted: Sequence[Self], wanted: Sequence[Sequence[int]]
    ) -> list[list[Array]]:
        """NaN at a row where any input is missing."""
        coef = np.column_stack([f.fitted["coef_um_per_K"] for f in fitted])
        intercept = np.array([f.fitted["intercept_um"] for f in fitted])
        copies: dict[int, list[int]] = {}
        for f, batches in enumerate(wanted):
            for k in batches:
                copies.setdefault(k, []).append(f)
        found: dict[tuple[int, int], Array] = {}
        for k, some in copies.items():
            predicted = design.x[design.rows(k)] @ coef[:, some] + intercept[some]
            found |= {(f, k): predicted[:, c] for c, f in enumerate(some)}
        return [[found[f, k] for k in batches] for f, batches in enumerate(wanted)]

    def fitting_S_um(self, design: Design, fitted: Sequence[Self], trained: Sequence[Sequence[int]]) -> Array:
        """From the batches' sums alone."""
        moments = self.started(design).moments
        blocks = Blocks.of(moments)
        block = np.concatenate([np.asarray(batches, np.int64) for batches in trained])
        which = np.repeat(np.arange(len(fitted)), [len(batches) for batches in trained])
        coef = np.stack([f.fitted["coef_um_per_K"] for f in fitted])[:, :, None]
        at_zero_um = np.array([f.fitted["intercept_um"] for f in fitted]) - moments.shift_y
        S_um = np.empty(len(block))
        step = max(1, AT_ONCE // len(design.inputs) ** 2)
        for start in range(0, len(block), step):
            some = slice(start, start + step)
            zero = np.tile(-moments.shift_x, (len(block[some]), 1))
            S_um[some] = blocks.S_um(block[some], zero, at_zero_um[which[some]], coef[which[some]])[:, 0]
        usable = np.bincount(which, moments.count[block] > 1, len(fitted))
        total = np.bincount(which, np.where(moments.count[block] > 1, S_um, 0.0), len(fitted))
        return np.asarray(total / np.maximum(usable, 1.0))

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value, see `stated_sd_um`."""
        return stated_sd_um(self, design, batches) if self.has_sd else super().sd_um(design, batches)

    def n_parameters(self) -> int:
        """Coefficients, and the intercept where the level is free."""
        return len(self.inputs) + (not self.zero_start) if self.fitted else 0

    @abstractmethod
    def _solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        """Coefficients (F, p) per unit of the inputs, and further quantities to store, each (F,); NaN is dropped."""

    def _spread(self, task: Task, path: CoefPath, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Coefficients for `sd_um`, for families with `has_sd`."""
        if not self.has_sd:
            return {}
        square = mean_square(task.design.x, task.design)
        a, b = left_out_spread(task, square, path, chosen)
        return {"variance_um2": a, "variance_growth_um2": b}


class Tuned(Linear):
    """A linear family with one setting, chosen in every fold inside the fold's training batches.

    The score is the mean S over batches left out as `order_by` says (`Task.chosen`).
    """

    order_by = "leave_batch_out"

    def _solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        chosen = task.chosen(self._path, self.order_by)
        coef, setting = self._refit(task, chosen)
        return coef, setting | self._spread(task, self._path, chosen)

    def _refit(self, task: Task, chosen: NDArray[np.int64]) -> tuple[Array, dict[str, NDArray[Any]]]:
        coef = np.take_along_axis(self._path(task.pool), chosen[:, None, None], axis=2)[:, :, 0]
        return coef, self._setting(task.pool, chosen)

    @abstractmethod
    def _path(self, pool: Pool) -> Array:
        """Coefficients (S, p, G) per unit of the inputs for every setting, from the simplest or strongest on."""

    @abstractmethod
    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """The chosen setting as the family's quantities, each (S,)."""
