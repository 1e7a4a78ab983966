"""Families: principal component regression, components chosen by contribution or by leave-batch-out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from models.families.linear import DIGITS_LEFT, EPS, Linear, Pool, Task, Tuned

_RESOLVED = 1e-10  # variance, relative to the first component's, that the covariance still resolves


class PCR(Linear):
    """Least squares on the leading components of the covariance of the raw rises, put back to the inputs.

    Keeps the first components whose cumulative contribution reaches `contribution`; 1 keeps every component that
    the data hold, which is least squares. `fitted` adds n_components and the contribution reached.
    """

    key = "pcr"
    summary = "principal component regression, components to 95 % cumulative contribution"
    source = "Massy (1965); year-round study of a Vcenter-55 machining centre: covariance, 95 %, 4 points"
    rank = 11

    def __init__(self, contribution: float = 0.95) -> None:
        super().__init__()
        if not 0 < contribution <= 1:
            raise InputError(f"pcr: contribution {contribution}; expected above 0 and at most 1, e.g. 0.95")
        self.contribution = contribution

    def _solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        if self.zero_start:
            return _about_start(task, self.contribution)
        values, path = principal_path(task.pool)
        needed = count_needed(values, self.contribution)
        return pick(task, values, path, needed, self.contribution)


class PCRByLeaveBatchOut(Tuned):
    """The same with the number of components chosen by leave-batch-out inside the training batches.

    A component of small variance, such as a bending gradient, can matter: the 95 % rule discards it.
    """

    key = "pcr_lbo"
    summary = "principal component regression, number of components by leave-batch-out inside the training batches"
    source = "Massy (1965); choice by prediction error: Mertens, Fearn and Thompson (1995)"
    rank = 13

    def _path(self, pool: Pool) -> Array:
        return principal_path(pool)[1]

    def _refit(self, task: Task, chosen: NDArray[np.int64]) -> tuple[Array, dict[str, NDArray[Any]]]:
        values, path = principal_path(task.pool)
        return pick(task, values, path, chosen + 1, None)

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {"n_components": chosen + 1}


def principal_path(pool: Pool) -> tuple[Array, Array]:
    """Variances (S, p), largest first, and coefficients (S, p, c) per unit of the inputs with 1 … p components."""
    values, vectors = np.linalg.eigh(pool.xx)
    values, vectors = np.maximum(values[:, ::-1], 0.0), vectors[:, :, ::-1]
    resolved = (values > _RESOLVED * values[:, :1]) & (values > 0)
    scores = np.einsum("sji,sj->si", vectors, pool.xy)
    weights = np.where(resolved, scores / np.where(resolved, values, 1.0), 0.0)
    return values, np.cumsum(vectors * weights[:, None, :], axis=2) / pool.scale[:, :, None]


def _about_start(task: Task, contribution: float) -> tuple[Array, dict[str, NDArray[Any]]]:
    """Coefficients (S, p) on the components of the covariance, fitted to the error without an intercept.

    The covariance is about the mean: about the start, the first component would be the mean rise and nearly all.
    """
    pool = task.pool
    total = task.masks @ task.design.moments.sum_x / pool.scale
    covariance = pool.xx - total[:, :, None] * total[:, None, :] / np.maximum(pool.count, 1.0)[:, None, None]
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = np.maximum(values[:, ::-1], 0.0), vectors[:, :, ::-1]
    wanted = count_needed(values, contribution)
    held = np.maximum((values > _RESOLVED * values[:, :1]).sum(axis=1), 1)
    n_components = np.minimum(wanted, held)
    coef = np.zeros(pool.xy.shape)
    for f, c in enumerate(n_components):
        onto = vectors[f, :, :c]
        moments, right = onto.T @ pool.xx[f] @ onto, onto.T @ pool.xy[f]
        if values[f, c - 1] * DIGITS_LEFT < values[f, 0]:
            x, y_um = task.centred_rows(int(f))
            coef[f] = onto @ np.linalg.lstsq(x @ onto, y_um, rcond=None)[0]
        else:
            coef[f] = onto @ np.linalg.lstsq(moments, right, rcond=None)[0]
    cumulated = np.cumsum(values, axis=1)
    reached = np.take_along_axis(cumulated, n_components[:, None] - 1, axis=1)[:, 0]
    reached = reached / np.where(cumulated[:, -1] > 0, cumulated[:, -1], 1.0)
    return coef / pool.scale, {"n_components": n_components, "contribution": reached}


def count_needed(values: Array, contribution: float) -> NDArray[np.int64]:
    """The fewest leading components that reach the cumulative contribution, (S,); values (S, p), largest first."""
    total = np.cumsum(values, axis=1)
    short = (total < contribution * (1 - 4 * EPS) * total[:, -1:]).sum(axis=1) + 1
    return np.minimum(short, values.shape[1]) if contribution < 1 else np.full(len(values), values.shape[1])


def pick(
    task: Task, values: Array, path: Array, n_components: NDArray[np.int64], contribution: float | None
) -> tuple[Array, dict[str, NDArray[Any]]]:
    """Coefficients (S, p) with so many components; from the rows where the last is too small for the covariance."""
    last = n_components - 1
    coef = np.take_along_axis(path, last[:, None, None], axis=2)[:, :, 0]
    total = np.cumsum(values, axis=1)
    reached = np.take_along_axis(total, last[:, None], axis=1)[:, 0] / np.where(total[:, -1] > 0, total[:, -1], 1.0)
    smallest = np.take_along_axis(values, last[:, None], axis=1)[:, 0]
    n_components = n_components.copy()
    for f in np.flatnonzero((values[:, 0] > 0) & (smallest * DIGITS_LEFT < values[:, 0])):
        x, y_um = task.centred_rows(int(f))
        u, singular, vt = np.linalg.svd(x, full_matrices=False)
        held = int((singular > EPS * max(float(task.pool.count[f]), x.shape[1]) * singular[0]).sum())
        wanted = n_components[f] if contribution is None else count_needed(singular[None] ** 2, contribution)[0]
        c = n_components[f] = min(int(wanted), held)
        coef[f] = ((u[:, :c].T @ y_um) / singular[:c]) @ vt[:c] / task.pool.scale[f]
        reached[f] = (singular[:c] ** 2).sum() / (singular**2).sum()
    return coef, {"n_components": n_components, "contribution": reached}
