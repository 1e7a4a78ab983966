"""How the coefficients of lagged inputs may follow each other, and their choice: by leave-batch-out, AIC or BIC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.base import Array
from models.linear import Pool, Task, Tuned

CRITERIA = ("leave_batch_out", "aic", "bic")
RIDGES = (1e-2, 1e-4, 1e-6, 1e-8)  # of the mean variance of the columns, strongest first
_ORDERS = (0, 1, 2, 3, 4, 6, 9, 12, 18, 24, 36, 48)


@dataclass(frozen=True)
class Shape:
    """Coefficients β (m, p) of m responses of p inputs are `mix` (m, d) times d free ones per input."""

    responses: tuple[int, ...]
    mix: Array


def free_shapes(max_lags: int) -> list[Shape]:
    """Lags 0 … q, each free, for the orders q up to `max_lags`."""
    return [Shape(tuple(range(q + 1)), np.eye(q + 1)) for q in _orders(max_lags)]


def polynomial_shapes(max_lags: int, degree: int) -> list[Shape]:
    """Lags 0 … q on polynomials of a degree, as orthonormal columns; short orders are free (Almon 1965)."""
    shapes = []
    for q in _orders(max_lags):
        powers = np.vander(np.linspace(-1.0, 1.0, q + 1), degree + 1, increasing=True)
        mix = np.eye(q + 1) if q <= degree else np.linalg.qr(powers)[0]
        shapes.append(Shape(tuple(range(q + 1)), mix))
    return shapes


def koyck_shapes(n_decays: int) -> list[Shape]:
    """The input alone, or with one of `n_decays` geometric tails, which stand behind it (Koyck 1954)."""
    return [Shape((0,), np.eye(1)), *(Shape((0, j), np.eye(2)) for j in range(1, n_decays + 1))]


def _orders(max_lags: int) -> list[int]:
    return sorted({q for q in _ORDERS if q < max_lags} | {max_lags})


class LagRegression(Tuned):
    """Ridge regression on m responses of p inputs, columns response by response; chooses shape and penalty."""

    key = "distributed_lag"
    words = "regression of a distributed lag"
    source = "Hoerl and Kennard (1970)"

    def __init__(self, shapes: Sequence[Shape], order_by: str) -> None:
        super().__init__()
        self.shapes, self.order_by = list(shapes), order_by
        self.n_responses = 1 + max(r for shape in shapes for r in shape.responses)

    def solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        """Coefficients (F, m p), and per fold the index of the shape and the penalty k."""
        if self.order_by == "leave_batch_out":
            return self._solve(task)
        return self._refit(task, np.argmin(self._criterion(task), axis=1))

    def _path(self, pool: Pool) -> Array:
        return self._fits(pool)[0]

    def _fits(self, pool: Pool, count: bool = False) -> tuple[Array, Array]:
        """Coefficients (S, m p, G), and with `count` the effective parameters (S, G) including the intercept."""
        sets, columns = pool.xy.shape
        p = columns // self.n_responses
        path = np.zeros((sets, columns, len(self.shapes) * len(RIDGES)))
        parameters = np.zeros((sets, path.shape[2]))
        for s, shape in enumerate(self.shapes):
            at = (np.array(shape.responses)[:, None] * p + np.arange(p)).ravel()
            xx, xy = pool.xx[:, at[:, None], at], pool.xy[:, at]
            mixed = shape.mix.shape[0] != shape.mix.shape[1]
            mix = np.kron(shape.mix, np.eye(p))
            if mixed:
                xx, xy = mix.T @ xx @ mix, xy @ mix
            size = np.einsum("sjj->s", xx) / len(xx[0])
            size = np.where(size > 0, size, 1.0)
            for r, k in enumerate(RIDGES):
                matrix = xx + (k * size)[:, None, None] * np.eye(len(xx[0]))
                coef = np.linalg.solve(matrix, xy[:, :, None])[:, :, 0]
                g = s * len(RIDGES) + r
                path[:, at, g] = coef @ mix.T if mixed else coef
                if count:
                    parameters[:, g] = 1.0 + np.einsum("sij,sji->s", np.linalg.inv(matrix), xx)
        return path, parameters

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {"shape": chosen // len(RIDGES), "k": np.array(RIDGES)[chosen % len(RIDGES)]}

    def _criterion(self, task: Task) -> Array:
        """AIC or BIC (F, G), counting effective rows as the longest lags with the weakest penalty leave them."""
        pool, blocks = task.pool, task.blocks
        path, parameters = self._fits(pool, count=True)
        fold, block = np.nonzero(task.masks)
        S_um = blocks.left_out_S_um(block, pool, fold, path)
        sse = np.zeros(parameters.shape)
        np.add.at(sse, fold, S_um**2 * np.maximum(blocks.count[block] - 1.0, 1.0)[:, None])
        rows = effective_rows(task, path[:, :, -1])[1]
        weight = 2.0 if self.order_by == "aic" else np.log(rows)[:, None]
        fit = np.log(np.maximum(sse, np.finfo(float).tiny) / pool.count[:, None])
        return np.asarray(rows[:, None] * fit + weight * parameters)


def intercepts_um(task: Task, coef: Array) -> Array:
    """Intercepts (F,) of coefficients (F, columns) fitted about the means."""
    moments, pool = task.design.moments, task.pool
    mean_um = pool.mean_y + moments.shift_y
    return np.asarray(mean_um - np.einsum("fj,fj->f", pool.mean_x + moments.shift_x, coef))


def effective_rows(task: Task, coef: Array) -> tuple[Array, Array]:
    """Lag-one autocorrelation ρ of each fold's residuals inside its batches, and n (1 − ρ)/(1 + ρ); (F,) each.

    Source: M. Bartlett, Some aspects of the time-correlation problem, J. R. Stat. Soc. 98 (1935).
    """
    design, usable = task.design, task.design.usable
    residual = np.where(usable[:, None], design.y_um[:, None] - design.x @ coef.T - intercepts_um(task, coef), 0.0)
    residual *= task.masks.T[design.group]
    together = (design.group[1:] == design.group[:-1])[:, None]
    power = np.einsum("nf,nf->f", residual, residual)
    product = np.einsum("nf,nf->f", residual[1:] * together, residual[:-1])
    rho = np.clip(np.divide(product, power, out=np.zeros_like(power), where=power > 0), 0.0, 1.0)
    return rho, np.maximum(task.pool.count * (1.0 - rho) / (1.0 + rho), 2.0)
