"""Family: Huber regression, quadratic for small and linear for large residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from models.base import inner_groups
from models.families.linear import Linear, Mask, Task
from models.numerics.pooled_sums import FLAT

_CONVERGED = 1e-8  # of the scale: a step that moves predictions (RMS) and scale by less is the last
_MOST_STEPS = 500
_EXACT = 1e-9  # of the target's size: a smaller scale is an exact fit
_AT_ONCE = 1_000_000  # weights in memory
_ROUNDING = 1e-12  # of the criterion: a larger rise is one
_FLOOR = 1e-14  # on a diagonal of 1: fewer near rows than inputs have no unique coefficients


class Huber(Linear):
    """Linear model whose scale σ is estimated with it; rows off by more than ε σ count linearly, not squared.

    Minimises `Σ (σ + σ H(r/σ)) + α |β|²/σ` over β and σ, `H(z) = z²` up to |z| = ε and `2 ε |z| − ε²`
    beyond. α is `ridge` times the mean sum of squares of the centred inputs: small, so that collinear sensors have one
    answer. ε is the only one of `epsilons`, or that of least mean S by leave-batch-out inside the training batches
    (contiguous quarters of one or two). `fitted` adds epsilon, scale_um (σ), far_share (of the rows, beyond ε σ) and
    the steps taken.
    """

    key = "huber"
    summary = "Huber regression: rows far off count linearly"
    source = "Huber (1964); scale and steps: Huber and Dutter (1974); the criterion: Owen (2007)"
    rank = 16

    def __init__(self, epsilons: Sequence[float] = (1.35,), ridge: float = 1e-6) -> None:
        super().__init__()
        self.epsilons, self.ridge = [float(e) for e in epsilons], float(ridge)
        if not self.epsilons or min(self.epsilons) <= 1 or not self.ridge > 0:
            raise InputError(
                f"huber: epsilons {self.epsilons}, ridge {self.ridge:g}; expected epsilons above 1 (1.35 is usual) "
                "and a ridge above 0, e.g. 1e-6"
            )

    def _solve(self, task: Task) -> tuple[Array, dict[str, NDArray[Any]]]:
        design, ok = task.design, task.design.usable
        free = not design.about_start
        shift_x, shift_y = design.moments.shift_x, design.moments.shift_y
        x, y_um, batch = design.x[ok] - shift_x, design.y_um[ok] - shift_y, design.group[ok]
        member = task.masks[:, batch]
        epsilon = np.full(len(member), self.epsilons[0])
        if len(self.epsilons) > 1:
            epsilon = self._chosen(x, y_um, batch, member, task.scaled, free)
        found = self._minimised(x, y_um, member, epsilon, task.scaled, free)
        coef, intercept = found.beta[:, :-1], found.beta[:, -1]
        learned = {"epsilon": epsilon, "scale_um": found.scale, "far_share": found.far_share, "steps": found.steps}
        return coef, {"intercept_um": intercept + shift_y - coef @ shift_x, **learned}

    def _minimised(self, x: Array, y_um: Array, member: Mask, epsilon: Array, scaled: bool, free: bool) -> Minimum:
        """Inputs x (n, p) and a column of ones, for the rows `member` (S, n) of S training sets.

        The coefficient of the ones is 0 unless the level is `free`.
        """
        take = member.astype(float)
        n = np.maximum(take.sum(axis=1), 1.0)[:, None]
        raw = take @ x**2
        square = raw - (take @ x) ** 2 / n if free else raw
        moves = square > FLAT * raw
        square = np.where(moves, square, 0.0)
        penalty = self.ridge * (square if scaled else np.broadcast_to(square.mean(axis=1, keepdims=True), square.shape))
        of_ones = np.zeros((len(member), 1))
        return minimise(np.hstack([x, np.ones((len(x), 1))]), y_um, member, epsilon, np.hstack([penalty, of_ones]),
                      np.hstack([moves, np.full_like(of_ones, free, bool)]))  # fmt: skip

    def _chosen(self, x: Array, y_um: Array, batch: NDArray[np.int64], member: Mask, scaled: bool, free: bool) -> Array:
        """ε of least mean S over the groups of each training set, each left out once, (S,)."""
        inside, left, outer = [], [], []
        for f, rows in enumerate(member):
            group = np.full(len(batch), -1)
            group[rows] = inner_groups(batch[rows])
            for g in range(int(group.max()) + 1):
                inside.append(rows & (group != g))
                left.append(np.flatnonzero(group == g))
                outer.append(f)
        sets, which = np.unique(np.array(inside), axis=0, return_inverse=True)
        total = np.zeros((len(member), len(self.epsilons)))
        for e, epsilon in enumerate(self.epsilons):
            beta = self._minimised(x, y_um, sets, np.full(len(sets), epsilon), scaled, free).beta
            for f, rows, s in zip(outer, left, which, strict=True):
                residual = y_um[rows] - x[rows] @ beta[s, :-1] - beta[s, -1]
                total[f, e] += np.sqrt(residual @ residual / max(len(rows) - 1, 1))
        return np.array(self.epsilons)[np.argmin(total, axis=1)]


@dataclass(frozen=True)
class Minimum:
    """Coefficients (S, q), scale σ (S,), share of rows beyond ε σ (S,), steps taken (S,)."""

    beta: Array
    scale: Array
    far_share: Array
    steps: NDArray[np.int64]


def minimise(x: Array, y: Array, member: Mask, epsilon: Array, penalty: Array, moves: Mask) -> Minimum:
    """β and σ minimising `Σ (σ + σ H(r/σ)) + Σ_j penalty_j β_j²/σ` over the rows of each of S sets.

    x (n, q), y (n,), member (S, n), epsilon (S,), penalty and moves (S, q); inputs that do not move keep β = 0.
    `H(z) = z²` up to |z| = ε and `2 ε |z| − ε²` beyond, r = y − x β. The criterion is convex in β and σ together.

    A Newton step solves for β and σ with the near and far rows as they are, and their signs: the criterion is quadratic
    there, so that a step which changes neither is the last. A step that raises the criterion is halved: it is convex,
    and falls along the first part.

    Source: P. Huber, Robust statistics (1981), sec. 7.8; P. Huber and R. Dutter, Numerical solution of robust
    regression problems, COMPSTAT (1974); the criterion: A. Owen, A robust hybrid of lasso and ridge regression (2007).
    """
    step = max(1, _AT_ONCE // max(1, len(y)))
    parts = [
        _minimise(x, y, member[i : i + step].astype(float), epsilon[i : i + step], penalty[i : i + step],
                moves[i : i + step])
        for i in range(0, len(member), step)
    ]  # fmt: skip
    return Minimum(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Minimum)))


def _minimise(x: Array, y: Array, member: Array, epsilon: Array, penalty: Array, moves: Mask) -> Minimum:
    n = np.maximum(member.sum(axis=1), 1.0)
    least = np.maximum(_EXACT * np.sqrt(member @ y**2 / n), np.finfo(float).tiny)
    beta = _weighted(x, member, (member @ (x * y[:, None]))[:, :, None], penalty, moves)[:, :, 0]
    scale = np.maximum(np.sqrt((member * (y - beta @ x.T) ** 2).sum(axis=1) / n), least)
    far_share, steps, lowest = np.zeros(len(n)), np.full(len(n), _MOST_STEPS), np.full(len(n), np.inf)
    held_beta, held_scale, todo = beta.copy(), scale.copy(), np.arange(len(n))
    for step in range(_MOST_STEPS):
        inside, residual = member[todo], y - beta[todo] @ x.T
        size, reach = np.abs(residual), (epsilon * scale)[todo, None]
        near = np.minimum(size, reach)
        squares = np.einsum("sn,sn,sn->s", inside, near, 2.0 * size - near) + (penalty * beta**2)[todo].sum(axis=1)
        criterion, far = (n * scale)[todo] + squares / scale[todo], inside * (size > reach)
        fell = criterion <= (1.0 + _ROUNDING) * lowest[todo]
        on = todo
        if not fell.all():
            on, back = todo[fell], todo[~fell]
            beta[back], scale[back] = (beta[back] + held_beta[back]) / 2.0, (scale[back] + held_scale[back]) / 2.0
            inside, residual, far, criterion = inside[fell], residual[fell], far[fell], criterion[fell]
        lowest[on], held_beta[on], held_scale[on] = criterion, beta[on], scale[on]
        far_share[on] = far.sum(axis=1) / n[on]
        pull = epsilon[on, None] * ((far * np.sign(residual)) @ x)
        beta[on], scale[on] = _newton(x, y, inside - far, pull, penalty[on], moves[on], scale[on],
                                            n[on] - epsilon[on] ** 2 * far.sum(axis=1))  # fmt: skip
        scale[on] = np.maximum(scale[on], least[on])
        change = (beta[on] - held_beta[on]) @ x.T
        moved = np.sqrt(np.einsum("sn,sn,sn->s", inside, change, change) / n[on])
        converged = moved + np.abs(scale[on] - held_scale[on]) <= _CONVERGED * scale[on]
        steps[on[converged]] = step + 1
        todo = np.setdiff1d(todo, on[converged])
        if not len(todo):
            break
    beta[todo], scale[todo] = held_beta[todo], held_scale[todo]
    return Minimum(beta, scale, far_share, steps)


def _newton(
    x: Array, y: Array, near: Array, pull: Array, penalty: Array, moves: Mask, scale: Array, n_free: Array
) -> tuple[Array, Array]:
    """β and σ with near and far rows and their signs as they are: β = β₀ + σ β₁; twice σ where all of them fall."""
    both = _weighted(x, near, np.stack([near @ (x * y[:, None]), pull], axis=2), penalty, moves)
    free, pulled = both[:, :, 0], both[:, :, 1]
    squares = np.einsum("sn,sn->s", near, (y - free @ x.T) ** 2) + (penalty * free**2).sum(axis=1)
    n_free = n_free - (pull * pulled).sum(axis=1)
    scale = np.sqrt(np.divide(squares, n_free, out=4.0 * scale**2, where=n_free > 0))
    return free + scale[:, None] * pulled, scale


def _weighted(x: Array, weight: Array, right: Array, penalty: Array, moves: Mask) -> Array:
    """Solutions (S, q, r) of weighted normal equations, weights (S, n), right (S, q, r)."""
    q = x.shape[1]
    gram = np.empty((len(weight), q, q))
    for j in range(q):  # one thin product after the other: rows times q² would not fit for many inputs
        gram[:, j, j:] = weight @ (x[:, j:] * x[:, j, None])
        gram[:, j:, j] = gram[:, j, j:]
    gram *= moves[:, :, None] & moves[:, None, :]
    np.einsum("sjj->sj", gram)[:] += np.where(moves, penalty, 1.0)
    size = 1.0 / np.sqrt(np.einsum("sjj->sj", gram))
    even = gram * (size[:, :, None] * size[:, None, :])
    np.einsum("sjj->sj", even)[:] += _FLOOR
    return np.asarray(np.linalg.solve(even, right * (moves * size)[:, :, None]) * size[:, :, None])
