"""Many small elastic-net problems at once, each to its exact minimum by active sets."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from models.linear import Mask

_SLACK = 1e-11  # of the largest covariance: a gradient that exceeds its penalty by less is rounding
_FLOOR = 1e-13  # of the mean variance, on the diagonal: inputs that depend on each other have no unique coefficients
_STEPS_PER_INPUT = 20
_SIZES = 8  # faces are solved together by the number of their coefficients, rounded up to a multiple


def sparse_coefficients(xx: Array, xy: Array, absolute: Array, square: Array, start: Array) -> Array:
    """β (S, p) minimising `βᵀxx β/2 − xyᵀβ + absolute |β|₁ + square |β|²/2` for S problems, from β = `start`.

    xx (S, p, p), xy (S, p), absolute and square (S,). Each step solves the face of one sign pattern; where a
    coefficient would change sign, the step ends there and the coefficient leaves. At a face's minimum the zero
    coefficient whose gradient exceeds its penalty most comes in. Every step descends, so it ends.

    All problems at once take 1/11 of the time of scikit-learn's `enet_path` at the same accuracy, and 1/2.7 at its
    default one, which is off by up to 9 % (30 folds of 25 penalties and 3 mixings: ``benchmarks/elastic_net.py``).

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


_SETTLED = 1e-8  # of the scale: a step that moves predictions (RMS) and scale by less is the last
_MOST_STEPS = 500
_EXACT = 1e-9  # of the target's size: a smaller scale is an exact fit
_AT_ONCE = 1_000_000  # weights in memory


@dataclass(frozen=True)
class Settled:
    """Coefficients (S, q), scale σ (S,), share of rows beyond ε σ (S,), steps taken (S,)."""

    beta: Array
    scale: Array
    far_share: Array
    steps: NDArray[np.int64]


def settle(x: Array, y: Array, member: Mask, epsilon: Array, penalty: Array, moves: Mask) -> Settled:
    """β and σ minimising `Σ (σ + σ H(r/σ)) + Σ_j penalty_j β_j²/σ` over the rows of each of S sets.

    x (n, q), y (n,), member (S, n), epsilon (S,), penalty and moves (S, q); inputs that do not move keep β = 0.
    `H(z) = z²` up to |z| = ε and `2 ε |z| − ε²` beyond, r = y − x β. The criterion is convex in β and σ together, and
    both steps lower it: `σ² = (Σ min(r², ε² σ²) + Σ penalty β²)/n`, then weights `min(1, ε σ/|r|)`.

    Source: P. Huber and R. Dutter, Numerical solution of robust regression problems, COMPSTAT (1974); the criterion:
    A. Owen, A robust hybrid of lasso and ridge regression (2007).
    """
    step = max(1, _AT_ONCE // max(1, len(y)))
    parts = [
        _settle(x, y, member[i : i + step].astype(float), epsilon[i : i + step], penalty[i : i + step],
                moves[i : i + step])
        for i in range(0, len(member), step)
    ]  # fmt: skip
    return Settled(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Settled)))


def _settle(x: Array, y: Array, member: Array, epsilon: Array, penalty: Array, moves: Mask) -> Settled:
    n = np.maximum(member.sum(axis=1), 1.0)
    least = np.maximum(_EXACT * np.sqrt(member @ y**2 / n), np.finfo(float).tiny)
    beta, _ = _weighted(x, y, member, penalty, moves)
    scale = np.maximum(np.sqrt((member * (y - beta @ x.T) ** 2).sum(axis=1) / n), least)
    far_share, steps = np.zeros(len(n)), np.full(len(n), _MOST_STEPS)
    todo = np.arange(len(n))
    for step in range(_MOST_STEPS):
        inside, before = member[todo], scale[todo]
        size = np.abs(y - beta[todo] @ x.T)
        near = np.minimum(size, (epsilon[todo] * before)[:, None])
        squares = np.einsum("sn,sn,sn->s", inside, near, near) + (penalty[todo] * beta[todo] ** 2).sum(axis=1)
        scale[todo] = np.maximum(np.sqrt(squares / n[todo]), least[todo])
        reach = (epsilon * scale)[todo, None]
        far = size > reach
        far_share[todo] = (inside * far).sum(axis=1) / n[todo]
        weight = np.divide(reach, size, out=np.ones_like(size), where=far)
        weight *= inside
        found, gram = _weighted(x, y, weight, penalty[todo], moves[todo])
        change = found - beta[todo]
        beta[todo] = found
        moved = np.sqrt(np.einsum("sj,sjk,sk->s", change, gram, change) / n[todo]) + np.abs(scale[todo] - before)
        settled = moved <= _SETTLED * scale[todo]
        steps[todo[settled]] = step + 1
        todo = todo[~settled]
        if not len(todo):
            break
    return Settled(beta, scale, far_share, steps)


def _weighted(x: Array, y: Array, weight: Array, penalty: Array, moves: Mask) -> tuple[Array, Array]:
    """β (S, q) of weighted least squares with weights (S, n), and the matrices (S, q, q) of their equations."""
    q = x.shape[1]
    gram = np.empty((len(weight), q, q))
    for j in range(q):  # one thin product after the other: rows times q² would not fit for many inputs
        gram[:, j, j:] = weight @ (x[:, j:] * x[:, j, None])
        gram[:, j:, j] = gram[:, j, j:]
    gram *= moves[:, :, None] & moves[:, None, :]
    np.einsum("sjj->sj", gram)[:] += np.where(moves, penalty, 1.0)
    right = (weight @ (x * y[:, None])) * moves
    size = 1.0 / np.sqrt(np.einsum("sjj->sj", gram))
    even = gram * (size[:, :, None] * size[:, None, :])
    return np.linalg.solve(even, (right * size)[:, :, None])[:, :, 0] * size, gram
