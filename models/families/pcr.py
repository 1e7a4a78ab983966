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
        covariance = task.pool.xx
        if self.zero_start:  # about the start the first component would be the mean rise, and nearly all
            total = task.masks @ task.design.moments.sum_x / task.pool.scale
            n = np.maximum(task.pool.count, 1.0)
            covariance = covariance - total[:, :, None] * (total / n[:, None])[:, None, :]
        values, vectors = components(covariance)
        return on_components(task, values, vectors, count_needed(values, self.contribution))


class PCRByLeaveBatchOut(Tuned):
    """The same with the number of components chosen by leave-batch-out inside the training batches.

    A component of small variance, such as a bending gradient, can matter: the 95 % rule discards it.
    """

    key = "pcr_lbo"
    summary = "principal component regression, number of components by leave-batch-out inside the training batches"
    source = "Massy (1965); choice by prediction error: Mertens, Fearn and Thompson (1995)"
    rank = 13

    def _path(self, pool: Pool) -> Array:
        values, vectors = components(pool.xx)
        scores = np.einsum("sji,sj->si", vectors, pool.xy)
        resolved = (values > _RESOLVED * values[:, :1]) & (values > 0)
        weights = np.where(resolved, scores / np.where(resolved, values, 1.0), 0.0)
        return np.asarray(np.cumsum(vectors * weights[:, None, :], axis=2) / pool.scale[:, :, None])

    def _refit(self, task: Task, chosen: NDArray[np.int64]) -> tuple[Array, dict[str, NDArray[Any]]]:
        return on_components(task, *components(task.pool.xx), chosen + 1)

    def _setting(self, pool: Pool, chosen: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        return {"n_components": chosen + 1}


def components(covariance: Array) -> tuple[Array, Array]:
    """Variances (S, p), largest first, and directions (S, p, p), one a column, of covariances (S, p, p)."""
    values, vectors = np.linalg.eigh(covariance)
    return np.maximum(values[:, ::-1], 0.0), vectors[:, :, ::-1]


def count_needed(values: Array, contribution: float) -> NDArray[np.int64]:
    """The fewest leading components that reach the cumulative contribution, (S,); values (S, p), largest first."""
    total = np.cumsum(values, axis=1)
    short = (total < contribution * (1 - 4 * EPS) * total[:, -1:]).sum(axis=1) + 1
    return np.minimum(short, values.shape[1]) if contribution < 1 else np.full(len(values), values.shape[1])


def on_components(
    task: Task, values: Array, vectors: Array, wanted: NDArray[np.int64]
) -> tuple[Array, dict[str, NDArray[Any]]]:
    """Least squares (S, p) per unit of the inputs on so many leading components, as far as these are resolved.

    From the rows where the last component is too small for the sums.
    """
    pool = task.pool
    held = np.maximum((values > _RESOLVED * values[:, :1]).sum(axis=1), 1)
    n_components = np.minimum(wanted, held)
    onto = vectors * (np.arange(values.shape[1]) < n_components[:, None])[:, None, :]
    back = np.swapaxes(onto, 1, 2)
    moments = back @ pool.xx @ onto
    diagonal = np.einsum("sjj->sj", moments)
    diagonal += diagonal == 0
    coef = (onto @ np.linalg.solve(moments, back @ pool.xy[:, :, None]))[:, :, 0]
    last = n_components[:, None] - 1
    smallest = np.take_along_axis(values, last, axis=1)[:, 0]
    for f in np.flatnonzero(smallest * DIGITS_LEFT < values[:, 0]):
        x, y_um = task.centred_rows(int(f))
        coef[f] = onto[f] @ np.linalg.lstsq(x @ onto[f], y_um, rcond=None)[0]
    total = np.cumsum(values, axis=1)
    reached = np.take_along_axis(total, last, axis=1)[:, 0] / np.where(total[:, -1] > 0, total[:, -1], 1.0)
    return coef / pool.scale, {"n_components": n_components, "contribution": reached}
