"""Many small elastic-net problems at once, each to its exact minimum by active sets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from models.base import Array

_SLACK = 1e-11  # of the largest covariance: a gradient that exceeds its penalty by less is rounding
_FLOOR = 1e-13  # of the mean variance, on the diagonal: inputs that depend on each other have no unique coefficients
_STEPS_PER_INPUT = 20
_SIZES = 8  # faces are solved together by the number of their coefficients, rounded up to a multiple


def sparse_coefficients(xx: Array, xy: Array, absolute: Array, square: Array, start: Array) -> Array:
    """β (S, p) minimising `βᵀxx β/2 − xyᵀβ + absolute |β|₁ + square |β|²/2` for S problems, from β = `start`.

    xx (S, p, p), xy (S, p), absolute and square (S,). Each step solves the face of one sign pattern; where a
    coefficient would change sign, the step ends there and the coefficient leaves. At a face's minimum the zero
    coefficient whose gradient exceeds its penalty most comes in. Every step descends, so it ends.

    Source: H. Lee, A. Battle, R. Raina and A. Ng, Efficient sparse coding algorithms, NIPS 19 (2007), algorithm 1, with
    the line search ended at the first change of sign.
    """
    p = xy.shape[1]
    beta, sign = start.copy(), np.sign(start)
    square = square + _FLOOR * np.einsum("sjj->s", xx) / max(1, p)
    enough = absolute + _SLACK * np.abs(xy).max(axis=1, initial=0.0)
    moving = np.count_nonzero(sign, axis=1) > 0
    todo = np.arange(len(xy))
    for _ in range(_STEPS_PER_INPUT * max(1, p)):
        resting = todo[~moving[todo]]
        smooth = (xx[resting] @ beta[resting][:, :, None])[:, :, 0] + square[resting, None] * beta[resting]
        gradient = xy[resting] - smooth
        excess = np.where(sign[resting] == 0, np.abs(gradient) - enough[resting, None], 0.0)
        strongest = excess.argmax(axis=1)
        at = np.arange(len(resting))
        comes = excess[at, strongest] > 0
        sign[resting[comes], strongest[comes]] = np.sign(gradient[at, strongest][comes])
        moving[resting[comes]] = True
        todo = todo[moving[todo]]
        if not len(todo):
            break
        size = -(-np.count_nonzero(sign[todo], axis=1) // _SIZES)
        for some in (todo[size == s] for s in np.unique(size)):
            beta[some], sign[some], moving[some] = _step(xx, xy, absolute, square, beta, sign, some)
    return beta


def _step(
    xx: Array, xy: Array, absolute: Array, square: Array, beta: Array, sign: Array, some: NDArray[np.int64]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """To the minimum of each sign pattern's face, or as far as the signs hold: β, signs, and where it fell short."""
    b, s = beta[some], sign[some]
    width = int(np.count_nonzero(s, axis=1).max())
    face = np.argsort(s == 0, axis=1, kind="stable")[:, :width]  # active coefficients first
    b_face, s_face = np.take_along_axis(b, face, 1), np.take_along_axis(s, face, 1)
    active = s_face != 0
    matrix = xx[some[:, None, None], face[:, :, None], face[:, None, :]]
    matrix *= active[:, :, None] & active[:, None, :]
    np.einsum("sjj->sj", matrix)[:] += np.where(active, square[some, None], 1.0)
    right = np.take_along_axis(xy[some], face, 1) - absolute[some, None] * s_face
    target = np.linalg.solve(matrix, np.where(active, right, 0.0)[:, :, None])[:, :, 0]
    crosses = active & (s_face * target <= 0)
    share = np.divide(b_face, b_face - target, out=np.zeros_like(target), where=b_face != target)
    share = np.where(crosses, share, np.inf)
    first = share.min(axis=1)
    b_face = b_face + np.minimum(first, 1.0)[:, None] * (target - b_face)
    leaves = crosses & (share <= first[:, None])
    np.put_along_axis(b, face, np.where(leaves, 0.0, b_face), 1)
    np.put_along_axis(s, face, np.where(leaves, 0.0, s_face), 1)
    return b, s, crosses.any(axis=1)
