"""Family: distributed lags of the inputs (Koyck, Almon or free)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError, closest
from features.design import Design
from models.base import Family
from models.families.linear import Pool, Task
from models.numerics.batches import bridged, by_batch, fold_masks, steps_s
from models.numerics.kernels import unit_scale
from models.numerics.lags import Response, lag_responses, with_columns
from models.numerics.pooled_sums import mean_diagonal, ridge_path
from models.program import Builder

LAGS = ("koyck", "almon", "free")
CRITERIA = ("forward", "leave_batch_out", "aic", "bic")
KOYCK_TAUS_S = tuple(60.0 * t for t in (10, 20, 40, 80, 160, 320, 640))
RIDGES = (1e-2, 1e-4, 1e-6, 1e-8)  # of the mean variance of the columns, strongest first
_ORDERS = (0, 1, 2, 3, 4, 6, 9, 12, 18, 24, 36, 48)
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
    or `leave_batch_out` inside the training batches (`models.families.linear.Task`), `aic` or `bic`. Residuals of a
    thermal run are autocorrelated: the criteria count `effective_rows`, n (1 − ρ)/(1 + ρ) with ρ their lag-one
    autocorrelation.

    Source: S. Almon, Econometrica 33 (1965); L. Koyck, Distributed lags and investment analysis (1954);
    effective rows: Bartlett (1935); criteria: Akaike (1974), Schwarz (1978).
    """

    key = "distributed_lag"
    summary = "distributed lag: temperatures of now and before, geometric, polynomial or free"
    source = "Koyck 1954; Almon 1965"
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
        x = _responses(design, responses) / unit_scale(design)
        columns = self.started(with_columns(design, x.reshape(len(x), -1)))
        count = columns.moments.count if design.inputs else np.zeros(design.n_batches)
        task = Task.of(columns, fold_masks(self.key, design, folds, count, _LEAST_ROWS), False)
        path = partial(shaped_path, shapes)
        if self.order_by in ("aic", "bic"):
            chosen = np.argmin(criterion(task, shapes, self.order_by), axis=1)
        else:
            chosen = task.chosen(path, self.order_by)
        coef = np.take_along_axis(path(task.pool), chosen[:, None, None], axis=2)[:, :, 0]
        rho, rows = effective_rows(task, coef)
        intercept_um = task.intercept_um(coef)
        weights = coef.reshape(len(folds), len(responses), -1) / unit_scale(design)
        out = []
        for f in range(len(folds)):
            used = np.flatnonzero(shapes[chosen[f] // len(RIDGES)].any(axis=1))
            fitted = {
                "weights_um_per_K": weights[f, used],
                "delays_s": np.array([responses[i][0] for i in used]),
                "taus_s": np.array([responses[i][1] for i in used]),
                "intercept_um": float(intercept_um[f]),
                "k": RIDGES[chosen[f] % len(RIDGES)],
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
        x = _responses(design, list(place)).reshape(len(design.time_s), -1)
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

    def _tried(self, design: Design) -> tuple[list[Response], list[Array]]:
        """Responses of every input, and the shapes that their coefficients may have."""
        if self.lags == "koyck":
            return [(0.0, 0.0), *((0.0, tau_s) for tau_s in KOYCK_TAUS_S)], koyck_shapes(len(KOYCK_TAUS_S))
        spacing_s = float(np.nanmax([60.0 * self.lag_min, *steps_s(design)]))
        degree = self.max_lags if self.lags == "free" else self.degree
        return [(spacing_s * lag, 0.0) for lag in range(self.max_lags + 1)], lag_shapes(self.max_lags, degree)


def _responses(design: Design, responses: Sequence[Response]) -> Array:
    """Responses (n, m, p) of all inputs, whose holes are bridged; drivers rest before a batch."""
    at_rest = np.array([name.partition("@")[0] in design.driver_names for name in design.inputs], bool)
    return lag_responses(design, bridged(design, design.x), responses, at_rest)


def lag_shapes(max_lags: int, degree: int) -> list[Array]:
    """Lags 0 … q, for orders q up to `max_lags`, on polynomials of a degree as orthonormal columns (Almon 1965).

    A shape (m, d) times d free coefficients of an input gives those of its m responses. Orders up to the degree are
    free.
    """
    shapes = []
    for q in sorted({q for q in _ORDERS if q < max_lags} | {max_lags}):
        powers = np.vander(np.linspace(-1.0, 1.0, q + 1), degree + 1, increasing=True)
        mix = np.eye(q + 1) if q <= degree else np.linalg.qr(powers)[0]
        shapes.append(np.pad(mix, [(0, max_lags - q), (0, 0)]))
    return shapes


def koyck_shapes(n_decays: int) -> list[Array]:
    """The input alone, or with one of `n_decays` geometric tails, which follow it (Koyck 1954)."""
    each = np.eye(n_decays + 1)
    return [each[:, :1], *(each[:, [0, j]] for j in range(1, n_decays + 1))]


def shaped_path(shapes: Sequence[Array], pool: Pool) -> Array:
    """Coefficients (S, m p, G) of all responses for every shape with each of `RIDGES`; columns response by response."""
    path = np.zeros((*pool.xy.shape, len(shapes) * len(RIDGES)))
    for s, shape in enumerate(shapes):
        at, mix, free = _free(shape, pool)
        coef = ridge_path(free, RIDGES)
        path[:, at, s * len(RIDGES) : (s + 1) * len(RIDGES)] = coef if mix is None else mix @ coef
    return path


def _free(shape: Array, pool: Pool) -> tuple[NDArray[np.int64], Array | None, Pool]:
    """Columns of a shape, how they mix the free coefficients (None: not at all), and the sums of these."""
    used = np.flatnonzero(shape.any(axis=1))
    p = pool.xy.shape[1] // len(shape)
    at: NDArray[np.int64] = (used[:, None] * p + np.arange(p)).ravel()
    xx, xy = pool.xx[:, at[:, None], at], pool.xy[:, at]
    if len(used) == shape.shape[1]:
        return at, None, replace(pool, xx=xx, xy=xy)
    mix: Array = np.kron(shape[used], np.eye(p)).astype(float)
    return at, mix, replace(pool, xx=mix.T @ xx @ mix, xy=xy @ mix)


def criterion(task: Task, shapes: Sequence[Array], order_by: str) -> Array:
    """AIC or BIC (F, G), counting effective rows as the longest lags with the weakest penalty leave them."""
    pool, blocks = task.pool, task.blocks
    path = shaped_path(shapes, pool)
    parameters = []
    for xx in (_free(shape, pool)[2].xx for shape in shapes):
        values, ridge = np.linalg.eigvalsh(xx)[:, :, None], mean_diagonal(xx)[:, None, None] * RIDGES
        parameters.append(1.0 + (values / (values + ridge)).sum(axis=1))
    fold, block = np.nonzero(task.masks)
    S_um = blocks.left_out_S_um(block, pool, fold, path)
    sse = np.zeros((len(task.masks), path.shape[2]))
    np.add.at(sse, fold, S_um**2 * np.maximum(blocks.count[block] - 1.0, 1.0)[:, None])
    rows = effective_rows(task, path[:, :, -1])[1]
    weight = 2.0 if order_by == "aic" else np.log(rows)[:, None]
    fit = np.log(np.maximum(sse, np.finfo(float).tiny) / pool.count[:, None])
    return np.asarray(rows[:, None] * fit + weight * np.hstack(parameters))


def effective_rows(task: Task, coef: Array) -> tuple[Array, Array]:
    """Lag-one autocorrelation ρ of each fold's residuals inside its batches, and n (1 − ρ)/(1 + ρ); (F,) each.

    Source: M. Bartlett, Some aspects of the time-correlation problem, J. R. Stat. Soc. 98 (1935).
    """
    design, usable = task.design, task.design.usable
    residual = np.where(usable[:, None], design.y_um[:, None] - design.x @ coef.T - task.intercept_um(coef), 0.0)
    residual *= task.masks.T[design.group]
    together = (design.group[1:] == design.group[:-1])[:, None]
    power = np.einsum("nf,nf->f", residual, residual)
    product = np.einsum("nf,nf->f", residual[1:] * together, residual[:-1])
    rho = np.clip(np.divide(product, power, out=np.zeros_like(power), where=power > 0), 0.0, 1.0)
    return rho, np.maximum(task.pool.count * (1.0 - rho) / (1.0 + rho), 2.0)
