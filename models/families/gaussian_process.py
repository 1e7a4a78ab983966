"""Family: Gaussian process with a line, a smooth curve and batch-wise random effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular

from data.arrays import Array
from data.errors import InputError
from features.design import Design
from models.base import Family, inner_groups
from models.metrics import SIDE_OF_90
from models.numerics.batch_process import INVERSE, LeftOut, Pooled
from models.numerics.batches import too_few_rows
from models.numerics.kernels import Kernel, evenly, from_origin, products, unit_scale
from models.program import Builder

Rows = NDArray[np.int64]
LINES = (1e2, 1e3, 1e4, 1e5, 1e6)
CURVES = (0.0, 1.0, 10.0, 100.0, 1000.0)
LENGTHS = (0.3, 1.0, 3.0)
OWN_LINES = (0.0, 0.1, 1.0)
_FEWEST_ROWS, _LEAST_OF_A_BATCH, _MOST_OF_A_BATCH = 4, 8, 48
_ENOUGH_BATCHES = 3  # to see how batches differ
_LEAST_NOISE_UM = 1e-9
_LOST = 1e12  # kernel over noise, beyond which rounding is all that is left


@dataclass(frozen=True)
class Setting:
    """Variances over the noise's: of the common line, of the curve about it (with its length), of a batch's own line.

    The length is in the inputs' scale. A batch's own zero has the noise's variance: an error is recorded against the
    batch's first sample, which has noise too. `free`: with a common constant of the same variance and the whole curve,
    else the curve less its value at 0.
    """

    line: float = 1e5
    curve: float = 0.0
    length: float = 1.0
    own_line: float = 0.1

    def shared(self, u: Array, v: Array, free: bool) -> Array:
        """Covariance (n, m) of what all batches have in common, between inputs u (n, p) and v (m, p)."""
        return self.of_products(*products(u, v), *(_to_origin(u), _to_origin(v)), free)

    def of_products(self, half: Array, dot: Array, half_u: Array, half_v: Array, free: bool) -> Array:
        """The same from `products` of u with v, and of each with 0."""
        out: Array = self.line * dot + (1.0 if free else 0.0)
        if self.curve > 0:
            out += self.curve * np.exp(half / self.length**2)
        if self.curve > 0 and not free:
            to_u, to_v = np.exp(half_u / self.length**2), np.exp(half_v / self.length**2)
            out += self.curve * (1.0 - to_u[:, None] - to_v)
        return out

    def own(self, dot: Array) -> Array:
        """Covariance of what a batch has of its own, between rows of one batch."""
        return 1.0 + self.own_line * dot

    def prior(self, u: Array, free: bool) -> Array:
        """Variance (n,) of a recorded value before anything was learned, noise included."""
        dot = (u**2).sum(axis=1) / u.shape[1]
        level = 1.0 + self.curve if free else 2.0 * self.curve * -np.expm1(_to_origin(u) / self.length**2)
        return np.asarray(self.line * dot + level + self.own(dot) + 1.0)


class GaussianProcess(Family):
    """`y = line(u) + curve(u) − curve(0) + own zero and own line of the batch + noise`, all Gaussian.

    Covariances over the p inputs u, each divided by a fixed scale per unit (10 K, …): the line u·u'/p, the curve
    `exp(−|u − u'|²/(2 p length²))`, one length for all inputs. The batch's own part is what makes the stated interval
    valid: rows of one batch are not independent, and a new batch brings an own part that nobody has seen. u is
    relative to the batch's start, where it is 0 (`as_published`: the inputs as they are, a common constant and the
    whole curve).

    Ratios to the noise are chosen one after the other by leave-batch-out inside the training batches (contiguous
    quarters of one or two), least mean RMS: the predictive density of left-out batches chose worse on simulated
    years, led by their few odd runs. The noise itself, so the size of all variances, makes the left-out residuals as
    large as stated, and lets at least nine tenths of them lie inside the 90 % interval. It learns from about
    `max_rows` rows, evenly over every batch and at most 48 of each. `fitted` holds rows, weights and the factor.

    Source: C. Rasmussen and C. Williams, Gaussian Processes for Machine Learning (2006), algorithm 2.1, eqs. 2.25 to
    2.27 and 4.27; the batch's own part: N. Laird and J. Ware, Random-effects models, Biometrics 38 (1982).
    """

    key = "gaussian_process"
    summary = "Gaussian process: line, curve about it, and what each batch has of its own"
    source = "Rasmussen and Williams 2006; Laird and Ware 1982"
    closed_form = False
    has_sd = True
    rank = 62

    def __init__(self, max_rows: int = 480) -> None:
        super().__init__()
        self.max_rows = int(max_rows)

    def fit_folds(self, design: Design, folds: Sequence[Sequence[int]]) -> list[Self]:
        """Folds that leave out one batch share one inverse per setting.

        Raises:
            InputError: fewer than 4 usable rows in a fold, or inputs far beyond their unit's scale.
        """
        design = self.started(design)
        present = np.unique(design.group[design.usable])
        out: dict[int, Self] = {}
        gaps = {f: present[~np.isin(present, list(fold))] for f, fold in enumerate(folds)}
        shared = [f for f, gap in gaps.items() if len(gap) == 1 and len(present) >= 4]
        if len(shared) > 1:
            rows = self._rows(design, present.tolist(), len(present) - 1)
            problem = _Problem.of(design, rows, np.searchsorted(present, design.group[rows]))
            chosen = problem.chosen([int(np.searchsorted(present, gaps[f][0])) for f in shared])
            for f, (setting, size_um) in zip(shared, chosen, strict=True):
                own = rows[design.group[rows] != gaps[f][0]]
                out[f] = self._made(design, own, setting, size_um)
        for f, fold in enumerate(folds):
            if f not in out:
                batches = [int(k) for k in present if k in set(fold)]
                rows = self._rows(design, batches, max(1, len(batches)))
                if len(rows) < _FEWEST_ROWS:
                    raise too_few_rows(self.key, design, fold, len(rows), _FEWEST_ROWS)
                ((setting, size_um),) = _Problem.of(design, rows, inner_groups(design.group[rows])).chosen([None])
                out[f] = self._made(design, rows, setting, size_um)
        return [out[f] for f in range(len(folds))]

    def respond(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """NaN at a row where an input is missing."""
        setting, support, alpha = self._setting(), np.asarray(self.fitted["support"]), self.fitted["alpha"]
        u = self._scaled(design)
        return [setting.shared(u[design.rows(k)], support, not self.zero_start) @ alpha for k in batches]

    def operations(self, b: Builder) -> Sequence[int]:
        setting, alpha = self._setting(), np.asarray(self.fitted["alpha"], float)
        support = np.atleast_2d(np.asarray(self.fitted["support"], float))
        u = b.scaled(self.started_inputs(b), np.asarray(self.fitted["scale"], float))
        p = max(1, len(self.inputs))
        line = b.affine(u, (setting.line / p * alpha @ support)[None], 0.0 if self.zero_start else float(alpha.sum()))
        if not setting.curve > 0:
            return [line]
        rows, weights = from_origin(support, alpha) if self.zero_start else (support, alpha)
        sharpness = 1.0 / (2.0 * p * setting.length**2)
        curve = b.add("kernel", [u], 1, support=rows, weights=setting.curve * weights, sharpness=sharpness)
        return [b.affine(b.join(line, curve), np.ones((1, 2)))]

    def sd_um(self, design: Design, batches: Sequence[int]) -> list[Array]:
        """Predictive standard deviation (n_k,) of a recorded value of a new batch, its own part and noise included.

        NaN throughout where fewer than three batches were learned from: nobody has seen how batches differ.
        """
        setting, support, factor = self._setting(), np.asarray(self.fitted["support"]), self.fitted["factor"]
        free, scaled = not self.zero_start, self._scaled(design)
        out = []
        for k in batches:
            u = scaled[design.rows(k)]
            ok = np.isfinite(u).all(axis=1)
            known = solve_triangular(factor, setting.shared(u[ok], support, free).T, lower=True)
            left = np.maximum(setting.prior(u[ok], free) - (known**2).sum(axis=0), 1.0)
            sd_um = np.full(len(u), np.nan)
            if self.fitted["n_batches"] >= _ENOUGH_BATCHES:
                sd_um[ok] = self.fitted["size_um"] * np.sqrt(left)
            out.append(sd_um)
        return out

    def n_parameters(self) -> int:
        """One weight per row, four ratios and the noise."""
        return int(np.size(self.fitted["alpha"])) + 5 if self.fitted else 0

    def _rows(self, design: Design, batches: Sequence[int], n_trained: int) -> Rows:
        each = int(np.clip(self.max_rows // n_trained, _LEAST_OF_A_BATCH, _MOST_OF_A_BATCH))
        return evenly(design, batches, each)

    def _made(self, design: Design, rows: Rows, setting: Setting, size_um: float) -> Self:
        u, group = design.x[rows] / unit_scale(design), design.group[rows]
        covariance = setting.shared(u, u, not design.about_start)
        covariance += (group[:, None] == group) * setting.own(products(u, u)[1])
        covariance.flat[:: len(rows) + 1] += 1.0
        factor = cholesky(covariance, lower=True)
        return self._learned(design, {
            "support": u, "alpha": cho_solve((factor, True), design.y_um[rows]), "factor": factor,
            "scale": unit_scale(design), "size_um": size_um, "n_batches": len(np.unique(group)), **vars(setting),
        })  # fmt: skip

    def _setting(self) -> Setting:
        return Setting(*(float(self.fitted[name]) for name in ("line", "curve", "length", "own_line")))

    def _scaled(self, design: Design) -> Array:
        return np.asarray(self.started(design).x / self.fitted["scale"])


@dataclass(frozen=True)
class _Problem:
    """Rows in G groups of m places, 0 on padding: inputs u (n, p), their products, y_um and known (n,), n = G m."""

    u: Array
    half: Array
    dot: Array
    to_origin: Array
    free: bool
    same: NDArray[np.bool_]
    y_um: Array
    known: NDArray[np.bool_]
    group_rows: int

    @classmethod
    def of(cls, design: Design, rows: Rows, group: Rows) -> Self:
        count = np.bincount(group)
        m = int(count.max())
        place = group * m + np.arange(len(group)) - (np.cumsum(count) - count)[group]
        n = m * len(count)
        known, u, y_um = np.zeros(n, bool), np.zeros((n, design.x.shape[1])), np.zeros(n)
        known[place], u[place], y_um[place] = True, design.x[rows] / unit_scale(design), design.y_um[rows]
        half, dot = products(u, u)
        if not np.abs(dot).max(initial=0.0) * LINES[0] < _LOST:
            raise InputError(
                f"family gaussian_process: inputs reach {np.abs(u).max():.3g} times their scale, expected about 1: "
                "check their units"
            )
        at = np.arange(n) // m
        return cls(u, half, dot, _to_origin(u), not design.about_start, at[:, None] == at, y_um, known, m)

    def chosen(self, out: Sequence[int | None]) -> list[tuple[Setting, float]]:
        """Setting and noise in µm for each training set: all groups but one, or all of them (None)."""
        best, scores = [Setting()] * len(out), dict[Setting, Array]()
        for tries in _STEPS:
            sets_of: dict[Setting, list[int]] = {}
            for f, setting in enumerate(best):
                for tried in tries(setting):
                    sets_of.setdefault(tried, []).append(f)
            for tried, sets in sets_of.items():
                score = scores.setdefault(tried, np.full(len(out), np.nan))
                if new := [f for f in sets if np.isnan(score[f])]:
                    left = self._left_out(tried)
                    score[new] = [np.inf if left is None else _rms_um(*self._residuals(left, out[f])) for f in new]
            best = [tries(s)[int(np.argmin([scores[tried][f] for tried in tries(s)]))] for f, s in enumerate(best)]
        size_um = np.ones(len(out))
        for setting in dict.fromkeys(best):
            left = self._left_out(setting)
            for f, own in enumerate(best):
                if own == setting and left is not None:
                    size_um[f] = _size_um(*self._residuals(left, out[f]))
        return list(zip(best, size_um.tolist(), strict=True))

    @cached_property
    def _lines(self) -> dict[float, LinesLeftOut]:
        """By the variance of a batch's own line; empty where one inverse of all rows costs less than what replaces it:
        a system of the inputs for every pair of groups."""
        n_groups, p = len(self.known) // self.group_rows, self.u.shape[1] + self.free
        if n_groups**2 * p**3 > INVERSE * len(self.known) ** 3:
            return {}
        u = self.u.reshape(n_groups, self.group_rows, -1) / np.sqrt(max(1, self.u.shape[1]))
        known, y_um = (values.reshape(u.shape[:2]) for values in (self.known, self.y_um))
        return {own_line: LinesLeftOut.of(u, y_um, known, own_line, self.free) for own_line in OWN_LINES}

    def _left_out(self, setting: Setting) -> LeftOut | Line | None:
        """None where the covariance is beyond rounding."""
        if setting.curve == 0.0 and setting.own_line in self._lines:
            if not setting.line * np.abs(self.dot).max(initial=0.0) < _LOST:
                return None
            return Line(self._lines[setting.own_line], setting.line)
        covariance = setting.of_products(self.half, self.dot, self.to_origin, self.to_origin, self.free)
        covariance += self.same * setting.own(self.dot)
        covariance *= self.known[:, None] & self.known
        if not np.abs(covariance).max() < _LOST:
            return None
        return LeftOut.of(Kernel(covariance).inverse(1.0), self.y_um, self.group_rows)

    def _residuals(self, left: LeftOut | Line, f: int | None) -> tuple[Array, Array, Rows]:
        """Residuals and their variances over the noise (rows,) of every group left out, and the rows' groups."""
        error, variance = left.alone() if f is None else left.without(f)
        judged = self.known.reshape(error.shape).copy()
        if f is not None:
            judged[f] = False
        return error[judged], variance[judged], np.nonzero(judged)[0].astype(np.int64)


@dataclass(frozen=True)
class LinesLeftOut:
    """Whitened sums of every group for a Gaussian line through its rows: z (G, m, q) the inputs, and a constant where
    the level is free, own (G, m) the variance of each row without the line."""

    z: Array
    y_um: Array
    own: Array
    pooled: Pooled
    free: bool

    @classmethod
    def of(cls, u: Array, y_um: Array, known: NDArray[np.bool_], own_line: float, free: bool) -> Self:
        """Of inputs u (G, m, p) over √p; a group has its own zero of variance 1, its own line, and noise."""
        z = np.concatenate([u, np.ones((*u.shape[:2], 1))], axis=2) if free else u
        z = z * known[:, :, None]
        own = known[:, :, None] * known[:, None, :] * (1.0 + own_line * (u @ u.transpose(0, 2, 1)))
        own += np.eye(own.shape[1])
        table = np.concatenate([z, (y_um * known)[:, :, None]], axis=2)
        white = np.linalg.solve(np.linalg.cholesky(own), table)
        zt = white[:, :, :-1].transpose(0, 2, 1)
        pooled = Pooled(zt @ white[:, :, :-1], (zt @ white[:, :, -1:])[:, :, 0])
        return cls(z, y_um, np.einsum("gii->gi", own), pooled, free)


@dataclass(frozen=True)
class Line:
    """The process of a line alone, with groups left out as in `LeftOut`: a regression on the other groups."""

    lines: LinesLeftOut
    variance: float

    def alone(self) -> tuple[Array, Array]:
        """Residual and variance (G, m) of each group left out by itself."""
        return self._left_out(None)

    def without(self, f: int) -> tuple[Array, Array]:
        """Residual and variance (G, m) of each group when it and group f are left out; those of f mean nothing."""
        return self._left_out(f)

    def _left_out(self, f: int | None) -> tuple[Array, Array]:
        s = self.lines
        xx, xy = s.pooled.without(f)
        prior = np.full(xx.shape[1], 1.0 / self.variance)
        prior[len(prior) - s.free :] = 1.0
        covariance = np.linalg.inv(xx + np.diag(prior))
        gains = covariance @ xy[:, :, None]
        return s.y_um - (s.z @ gains)[:, :, 0], s.own + ((s.z @ covariance) * s.z).sum(axis=2)


_STEPS: tuple[Callable[[Setting], list[Setting]], ...] = (
    lambda s: [replace(s, line=v) for v in LINES],
    lambda s: [replace(s, curve=v) for v in CURVES],
    lambda s: [replace(s, length=v) for v in LENGTHS] if s.curve > 0 else [s],
    lambda s: [replace(s, own_line=v) for v in OWN_LINES],
    lambda s: [replace(s, line=v) for v in LINES],
)


def _to_origin(u: Array) -> Array:
    """−|u|²/(2p) of each row, (n,)."""
    return np.asarray((u**2).sum(axis=1) / (-2.0 * max(1, u.shape[1])))


def _rms_um(error: Array, variance: Array, group: Rows) -> float:
    """Mean over the groups of their RMS."""
    count = np.bincount(group)
    square = np.bincount(group, error**2)[count > 0] / count[count > 0]
    return float(np.sqrt(square).mean())


def _size_um(error: Array, variance: Array, group: Rows) -> float:
    """Noise that makes the residuals as large as stated, and nine tenths of them lie inside."""
    stated = np.abs(error) / np.sqrt(variance)
    rms, inside = np.sqrt(np.mean(stated**2)), np.quantile(stated, 0.9) / SIDE_OF_90
    return float(max(rms, inside, _LEAST_NOISE_UM))
