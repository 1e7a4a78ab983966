"""Correlations of the inputs over training batches, from the design's per-batch sums, and helpers of selectors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.checks import why_missing
from data.errors import InputError
from features.design import Design

Columns = NDArray[np.int64]
DIGITS = 9  # scores equal to so many digits are a tie: summation order must not choose a sensor
_CONSTANT = 1e-12  # variance over mean square below which an input counts as constant


@dataclass(frozen=True)
class Statistics:
    """Correlations over the stacked usable rows of the training batches.

    between (p, p): of the inputs; with_target (p,); varying (p,): False for a constant input,
    whose correlations are 0 (1 with itself).
    """

    between: Array
    with_target: Array
    varying: NDArray[np.bool_]


def training_statistics(design: Design, train: Sequence[int], selector: str) -> Statistics:
    """Correlations of the inputs with each other and with the target, from the batches `train` alone.

    Raises:
        InputError: fewer than 3 usable rows, with the batches and the input that is missing most.
    """
    rows = np.asarray(train, int)
    m = design.moments
    n = float(m.count[rows].sum())
    if n < 3:
        raise InputError(_too_few(design, rows, int(n), selector))
    mean, y_mean = m.sum_x[rows].sum(axis=0) / n, float(m.sum_y[rows].sum()) / n
    square = m.xx[rows].sum(axis=0) / n
    covariance = square - np.outer(mean, mean)
    variance = covariance.diagonal().copy()
    varying = variance > _CONSTANT * (square.diagonal() + m.shift_x**2)
    y_square = float(m.yy[rows].sum()) / n
    y_variance = y_square - y_mean**2
    y_std = y_variance**0.5 if y_variance > _CONSTANT * (y_square + m.shift_y**2) else np.inf
    std = np.where(varying, np.sqrt(np.maximum(variance, 0.0)), np.inf)
    between = np.clip(covariance / std[:, None] / std, -1.0, 1.0)
    np.fill_diagonal(between, 1.0)
    with_target = np.clip((m.xy[rows].sum(axis=0) / n - mean * y_mean) / std / y_std, -1.0, 1.0)
    return Statistics(between, with_target, varying)


def ranking(score: Array, varying: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Columns from the best score down, shape (p,); ties in the design's order, constant inputs behind all others."""
    return np.lexsort((np.round(-score, DIGITS), ~varying)).astype(np.int64)


def in_order(design: Design, columns: Sequence[int] | Columns) -> tuple[str, ...]:
    """Names of the columns, in the design's order."""
    return tuple(design.inputs[c] for c in sorted(int(c) for c in columns))


def chosen_of_varying(
    design: Design, varying: NDArray[np.int64], n_tsps: Sequence[int], pick: Callable[[int], Sequence[int] | Columns]
) -> dict[int, tuple[str, ...]]:
    """`pick(n)` gives n of the columns `varying`, as indices into it; called with fewer than all.

    Constant inputs join, in the design's order, only when n exceeds the number of the others.
    """
    constant = np.setdiff1d(np.arange(len(design.inputs)), varying)
    return {
        n: in_order(
            design,
            varying[np.asarray(pick(n), int)]
            if n < len(varying)
            else np.concatenate([varying, constant[: n - len(varying)]]),
        )
        for n in n_tsps
    }


def check_n_tsps(design: Design, n_tsps: Sequence[int], selector: str) -> None:
    """Every requested number must lie between 1 and the number of inputs.

    Raises:
        InputError: it does not.
    """
    p = len(design.inputs)
    for n in n_tsps:
        if not 1 <= n <= p:
            raise InputError(f"selector {selector}: n_tsp is {n}; expected 1 to {p}, the number of inputs")


def _too_few(design: Design, rows: NDArray[np.int64], n: int, selector: str) -> str:
    ids = [design.batch_ids[k] for k in rows]
    named = ", ".join(ids[:5]) + (f" and {len(ids) - 5} more" if len(ids) > 5 else "")
    values = np.concatenate([design.x[design.rows(k)] for k in rows]) if ids else np.empty((0, len(design.inputs)))
    target = np.concatenate([design.y_um[design.rows(k)] for k in rows]) if ids else np.empty(0)
    missing = [*np.count_nonzero(~np.isfinite(values), axis=0), np.count_nonzero(~np.isfinite(target))]
    worst = int(np.argmax(missing))
    name = (*design.inputs, design.target)[worst]
    why = why_missing(design.batches[rows[0]], name) if ids and design.batches else ""
    return (
        f"selector {selector}: {n} usable rows in the training batches ({named or 'none given'}), expected at least 3; "
        f"{name!r} is missing in {missing[worst]} of {len(values)} rows{why}: leave it out or give more batches"
    )
