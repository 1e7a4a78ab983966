"""The elastic net's whole path, exactly, for many small problems at once.

Along the path the coefficients are straight lines in the penalty between the points where an input joins or leaves, so
a step per such point finds all of it, however collinear the inputs are; no descent has to converge.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_ROUNDING = 1e-12
_STEPS_PER_INPUT = 20  # a path has about one step per input; this many mean that rounding goes in circles


def active_inputs(products: Array, with_target: Array, levels: Array) -> NDArray[np.bool_]:
    """Where β ≠ 0 minimises ½ βᵀGβ − rᵀβ + λ Σ|β_j|, for S problems at L falling levels of λ: (S, L, p).

    G (S, p, p) are the inputs' products with the ridge part on the diagonal (positive definite), r (S, p) those with
    the target.

    Source: B. Efron et al. (2004), Least angle regression, Ann. Statist. 32, 407–499, with the lasso's leaving step;
    H. Zou and T. Hastie (2005), J. R. Statist. Soc. B 67, 301–320, for the ridge part.
    """
    n_problems, p = with_target.shape
    out = np.zeros((n_problems, len(levels), p), bool)
    problem = np.arange(n_problems)
    g, r = products, with_target
    beta, rest = np.zeros_like(r), r.copy()
    penalty = np.abs(r).max(axis=1, initial=0.0)
    active = np.zeros(r.shape, bool)
    if p:
        active[problem, np.argmax(np.abs(r), axis=1)] = True
    barred = np.zeros_like(active)
    for _ in range(_STEPS_PER_INPUT * p):
        some = penalty > levels[-1]
        if not some.all():
            problem, g, r, beta, rest, penalty, active, barred = (
                a[some] for a in (problem, g, r, beta, rest, penalty, active, barred)
            )
        if not len(problem):
            break
        both = active[:, :, None] & active[:, None, :]
        system = np.where(both, g, np.eye(p))
        direction = np.linalg.solve(system, (np.sign(rest) * active)[..., None])[..., 0] * active
        slope = (g @ direction[..., None])[..., 0]
        joining, leaving = _joining(penalty, rest, slope, active | barred), _leaving(beta, direction)
        n, first_in, first_out = np.arange(len(problem)), joining.argmin(axis=1), leaving.argmin(axis=1)
        leaves = leaving[n, first_out] < joining[n, first_in]
        step = np.minimum(np.minimum(joining[n, first_in], leaving[n, first_out]), penalty)
        passed = (levels <= penalty[:, None]) & (levels > (penalty - step)[:, None])
        out[problem] |= passed[:, :, None] & active[:, None, :]
        beta, penalty = beta + step[:, None] * direction, penalty - step
        column = np.where(leaves, first_out, first_in)
        beta[n[leaves], column[leaves]] = 0.0
        active[n, column] = ~leaves
        barred[:] = False
        barred[n[leaves], column[leaves]] = True  # it stands at the border now and must not rejoin at once
        rest = r - (g @ beta[..., None])[..., 0]
    out[problem] |= (levels <= penalty[:, None])[:, :, None] & active[:, None, :]
    return out


def _joining(penalty: Array, rest: Array, slope: Array, kept_out: NDArray[np.bool_]) -> Array:
    """Falls of the penalty after which an input that is not active reaches it, (S, p)."""
    fall = np.full(rest.shape, np.inf)
    for sign in (1.0, -1.0):
        gap, speed = np.maximum(penalty[:, None] - sign * rest, 0.0), 1.0 - sign * slope
        reaches = (speed > _ROUNDING) & ~kept_out
        fall = np.minimum(fall, np.where(reaches, gap / np.where(reaches, speed, 1.0), np.inf))
    return fall


def _leaving(beta: Array, direction: Array) -> Array:
    """Falls of the penalty after which an active coefficient is back at 0, (S, p)."""
    returns = beta * direction < 0.0
    fall: Array = np.where(returns, -beta / np.where(returns, direction, 1.0), np.inf)
    return fall
