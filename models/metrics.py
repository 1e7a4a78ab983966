"""Scores of predictions, for many models at once.

All on one batch's usable rows, recorded y and prediction p (µm), e = y − p:
S = sqrt(Σ e² / (n − 1)), the residual standard deviation of the year-round PCR study; max |e|; bias = mean e;
95 % quantile of |e|; RMSE; compensation effect 1 − range(e)/range(y); prediction accuracy
eta = 1 − mean|e|/mean|y| (coupled-lathe study); grey synthetic relational degree of y and p (Liu 1991).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from data.arrays import Array
from features.grey import synthetic_degree
from models.selection.result import SCORES

SIDE_OF_90 = 1.6449  # standard deviations: a normal value lies within them nine times in ten


def batch_scores(y_um: Array, predicted_um: Array) -> dict[str, Array]:
    """Scores of C models on one batch.

    Args:
        y_um: recorded error (n,), NaN where masked.
        predicted_um: predictions (n, C), NaN where a model has none.

    Returns:
        one array (C,) per name in `SCORES`, and `n_rows` (C,): the rows both are finite in. NaN below 2 rows.
    """
    columns = predicted_um.shape[1]
    out = {name: np.full(columns, np.nan) for name in [*SCORES, "n_rows"]}
    finite = np.isfinite(y_um)[:, None] & np.isfinite(predicted_um)
    counts = finite.sum(axis=0)
    # Columns that share their usable rows are judged together; nearly always all of them do.
    full = counts == int(np.isfinite(y_um).sum())
    groups = [(np.flatnonzero(full), np.isfinite(y_um))] if full.any() else []
    groups += [(np.array([c]), finite[:, c]) for c in np.flatnonzero(~full)]
    for which, rows in groups:
        n = int(rows.sum())
        out["n_rows"][which] = n
        if n < 2:
            continue
        y, p = y_um[rows], predicted_um[rows][:, which]
        for name, values in _scores(y, p).items():
            out[name][which] = values
    return out


def coverage(y_um: Array, predicted_um: Array, sd_um: Array) -> dict[str, Array]:
    """Coverage and mean of the stated standard deviations of C models on one batch.

    Args:
        y_um: recorded error (n,). predicted_um, sd_um: predictions and their stated standard deviations (n, C).

    Returns:
        per name in `CERTAINTY` an array (C,): the share of finite rows with |y − p| ≤ 1.645 sd, and the mean sd in µm.
        NaN without such a row.
    """
    away = np.abs(y_um[:, None] - predicted_um)
    known = np.isfinite(away) & np.isfinite(sd_um)
    n = known.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        inside = (away <= SIDE_OF_90 * sd_um) & known
        return {"coverage90": inside.sum(axis=0) / n, "sd_um": np.where(known, sd_um, 0.0).sum(axis=0) / n}


def _scores(y: Array, p: Array) -> dict[str, Array]:
    e = y[:, None] - p
    absolute = np.abs(e)
    sse = np.einsum("ij,ij->j", e, e)
    n = len(y)
    mean_y, range_y = np.abs(y).mean(), np.ptp(y)
    mean_abs = absolute.mean(axis=0)
    return {
        "S_um": np.sqrt(sse / (n - 1)),
        "rmse_um": np.sqrt(sse / n),
        "max_abs_um": absolute.max(axis=0),
        "bias_um": e.mean(axis=0),
        "p95_abs_um": _quantile95(absolute),
        "compensation_effect": 1.0 - np.ptp(e, axis=0) / range_y if range_y > 0 else np.full(p.shape[1], np.nan),
        "eta": 1.0 - mean_abs / mean_y if mean_y > 0 else np.full(p.shape[1], np.nan),
        "grey_degree": synthetic_degree(y, p),
    }


def _quantile95(values: Array) -> Array:
    """Linear 95 % quantile over rows; a partition instead of a sort."""
    position = 0.95 * (len(values) - 1)
    low = int(position)
    high = min(low + 1, len(values) - 1)
    part = np.partition(values, (low, high), axis=0)
    return part[low] + (position - low) * (part[high] - part[low])


def row_quantiles(values: Array, share: float) -> Array:
    """Linear quantile (F,) of the numbers of each row (F, m), NaN left out; NaN of none."""
    ranked = np.sort(values, axis=1)  # NaN comes last
    most = (~np.isnan(ranked)).sum(axis=1) - 1
    place = share * most
    low, every = place.astype(int), np.arange(len(ranked))
    at_low, at_high = ranked[every, low], ranked[every, np.minimum(low + 1, most)]
    return np.asarray(at_low + (place - low) * (at_high - at_low))


def residual_std_um(error_um: Array) -> Any:
    """S of a residual series (n,), or of C of them (n, C) → (C,); NaN left out, and NaN below 2 rows."""
    known = np.isfinite(error_um)
    n, e = known.sum(axis=0), np.where(known, error_um, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(n > 1, np.sqrt((e * e).sum(axis=0) / (n - 1)), np.nan)[()]
