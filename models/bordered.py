"""The bordered matrix of an LS-SVM: its inverse, and left-out residuals of whole batches from that inverse."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

Array = NDArray[np.float64]
Rows = NDArray[np.int64]


def bordered_inverse(omega: Array, gamma: float) -> tuple[Array, Array]:
    """The inverse of `[[0, 1ᵀ], [1, Ω + I/γ]]`: its lower right block (n, n) and the rest of its first row (n,).

    Raises:
        LinAlgError: Ω + I/γ is not positive definite in floating point.
    """
    n = len(omega)
    factor, info = lapack.dpotrf(omega + np.eye(n) / gamma, lower=1, overwrite_a=1)
    if info == 0:
        factor, info = lapack.dpotri(factor, lower=1, overwrite_c=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"kernel matrix of {n} rows is not positive definite at gamma {gamma:g}")
    inverse = np.tril(factor)
    inverse += np.tril(inverse, -1).T
    u = inverse.sum(axis=1)
    ones = u / u.sum()
    return inverse - np.outer(u, ones), ones


def left_out(
    inverse: Array, ones: Array, y: Array, groups: Rows, member: NDArray[np.bool_], outs: Rows
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Every fold's inner score and its own solution, from the inverse on all rows.

    groups (G, m) row numbers, −1 behind a group's end; member (F, G) the groups a fold trains on; outs (F, o) the
    rows it leaves out. Deleting rows O from a matrix turns the inverse C into `C − C_·O C_OO⁻¹ C_O·`; the residual
    of group g when left out is `C_gg⁻¹ α_g` (both after that deletion).
    Returns the mean RMS over the fold's groups (F,), α (F, n), b (F,), and the rows inside each fold (F, n).
    """
    n_folds, width = outs.shape
    n = len(y)
    alpha = np.broadcast_to(inverse @ y, (n_folds, n))
    bias = np.full(n_folds, ones @ y)
    inside = np.ones((n_folds, n), bool)
    valid = groups >= 0
    g = np.where(valid, groups, 0)
    pairs = valid[:, :, None] & valid[:, None, :]
    identity = np.eye(groups.shape[1])
    blocks = np.broadcast_to(np.where(pairs, inverse[g[:, :, None], g[:, None, :]], identity), (n_folds, *pairs.shape))
    if width:
        real = outs >= 0
        o = np.where(real, outs, 0)
        corner = np.where(real[:, :, None] & real[:, None, :], inverse[o[:, :, None], o[:, None, :]], np.eye(width))
        lower = np.linalg.cholesky(corner)
        side = np.concatenate([inverse[o], alpha[0][o][:, :, None], ones[o][:, :, None]], axis=2) * real[:, :, None]
        side = np.linalg.solve(lower, side)  # L⁻¹ [C_O·, α_O, 1_O]
        w, q = side[:, :, :n], side[:, :, n]
        alpha = alpha - np.einsum("fon,fo->fn", w, q)
        bias = bias - np.einsum("fo,fo->f", side[:, :, n + 1], q)
        for f in range(n_folds):
            inside[f, outs[f][real[f]]] = False
        wg = w[:, :, g].transpose(0, 2, 1, 3) * valid[:, None, :]
        blocks = blocks - wg.transpose(0, 1, 3, 2) @ wg
        blocks = np.where(member[:, :, None, None], blocks, identity)
    residual = np.linalg.solve(blocks, (alpha[:, g] * valid)[..., None])[..., 0]
    count = valid.sum(axis=1)
    rms = np.sqrt(np.einsum("fgm,fgm->fg", residual, residual) / np.maximum(count, 1))
    counted = member & (count > 0)
    score = (rms * counted).sum(axis=1) / np.maximum(counted.sum(axis=1), 1)
    return score, alpha, bias, inside
