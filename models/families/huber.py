"""Family: Huber regression, quadratic for small and linear for large residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from models.base import inner_groups
from models.families.linear import Linear, Mask, Task
from models.numerics.pooled_sums import FLAT

_SETTLED = 1e-8  # of the scale: a step that moves predictions (RMS) and scale by less is the last
_MOST_STEPS = 500
_EXACT = 1e-9  # of the target's size: a smaller scale is an exact fit
_AT_ONCE = 1_000_000  # weights in memory
_ROUNDING = 1e-12  # of the criterion: a larger rise is one


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
        found = self._settled(x, y_um, member, epsilon, task.scaled, free)
        coef, intercept = found.beta[:, :-1], found.beta[:, -1]
        learned = {"epsilon": epsilon, "scale_um": found.scale, "far_share": found.far_share, "steps": found.steps}
        return coef, {"intercept_um": intercept + shift_y - coef @ shift_x, **learned}

    def _settled(self, x: Array, y_um: Array, member: Mask, epsilon: Array, scaled: bool, free: bool) -> Settled:
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
        return settle(np.hstack([x, np.ones((len(x), 1))]), y_um, member, epsilon, np.hstack([penalty, of_ones]),
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
            beta = self._settled(x, y_um, sets, np.full(len(sets), epsilon), scaled, free).beta
            for f, rows, s in zip(outer, left, which, strict=True):
                residual = y_um[rows] - x[rows] @ beta[s, :-1] - beta[s, -1]
                total[f, e] += np.sqrt(residual @ residual / max(len(rows) - 1, 1))
        return np.array(self.epsilons)[np.argmin(total, axis=1)]


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
    `H(z) = z²` up to |z| = ε and `2 ε |z| − ε²` beyond, r = y − x β. The criterion is convex in β and σ together.

    A Newton step solves for β and σ with the near and far rows as they are, and their signs: the criterion is quadratic
    there, so that a step which changes neither is the last. Where it does not lower the criterion, it is replaced by
    two that do: `σ² = (Σ min(r², ε² σ²) + Σ penalty β²)/n`, then weights `min(1, ε σ/|r|)`.

    Source: P. Huber, Robust statistics (1981), sec. 7.8; P. Huber and R. Dutter, Numerical solution of robust
    regression problems, COMPSTAT (1974); the criterion: A. Owen, A robust hybrid of lasso and ridge regression (2007).
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
    beta = _weighted(x, member, (member @ (x * y[:, None]))[:, :, None], penalty, moves)[0][:, :, 0]
    scale = np.maximum(np.sqrt((member * (y - beta @ x.T) ** 2).sum(axis=1) / n), least)
    far_share, steps, lowest = np.zeros(len(n)), np.full(len(n), _MOST_STEPS), np.full(len(n), np.inf)
    held_beta, held_scale, todo = beta.copy(), scale.copy(), np.arange(len(n))
    for step in range(_MOST_STEPS):
        at = _Place.of(x, y, member[todo], epsilon[todo], penalty[todo], beta[todo], scale[todo])
        rose = at.criterion > (1.0 + _ROUNDING) * lowest[todo]
        if rose.any():  # back to where it was, and on by the steps that cannot rise
            beta[todo[rose]], scale[todo[rose]] = held_beta[todo[rose]], held_scale[todo[rose]]
            at = _Place.of(x, y, member[todo], epsilon[todo], penalty[todo], beta[todo], scale[todo])
        lowest[todo], held_beta[todo], held_scale[todo] = at.criterion, beta[todo], scale[todo]
        far_share[todo] = at.far.sum(axis=1) / n[todo]
        gram = np.empty((len(todo), x.shape[1], x.shape[1]))
        for some, way in ((~rose, _newton), (rose, _descent)):
            if some.any():
                found = way(x, y, at.only(some), moves[todo[some]], least[todo[some]])
                beta[todo[some]], scale[todo[some]], gram[some] = found
        change = beta[todo] - held_beta[todo]
        moved = np.sqrt(np.einsum("sj,sjk,sk->s", change, gram, change) / n[todo])
        settled = moved + np.abs(scale[todo] - held_scale[todo]) <= _SETTLED * scale[todo]
        steps[todo[settled]] = step + 1
        todo = todo[~settled]
        if not len(todo):
            break
    return Settled(beta, scale, far_share, steps)


@dataclass(frozen=True)
class _Place:
    """Where S sets stand: residuals and far rows (S, n), and the criterion (S,)."""

    member: Array
    epsilon: Array
    penalty: Array
    beta: Array
    scale: Array
    residual: Array
    far: Array
    criterion: Array

    @classmethod
    def of(cls, x: Array, y: Array, member: Array, epsilon: Array, penalty: Array, beta: Array, scale: Array) -> Self:
        residual = y - beta @ x.T
        size, reach = np.abs(residual), (epsilon * scale)[:, None]
        near = np.minimum(size, reach)
        squares = np.einsum("sn,sn,sn->s", member, near, 2.0 * size - near) + (penalty * beta**2).sum(axis=1)
        criterion = member.sum(axis=1) * scale + squares / scale
        return cls(member, epsilon, penalty, beta, scale, residual, member * (size > reach), criterion)

    def only(self, some: Mask) -> Self:
        return self if some.all() else type(self)(*(getattr(self, f.name)[some] for f in fields(self)))


def _newton(x: Array, y: Array, at: _Place, moves: Mask, least: Array) -> tuple[Array, Array, Array]:
    """β, σ and the matrices of β's equations, with near and far rows and their signs as they are: β = β₀ + σ β₁."""
    near = at.member - at.far
    pull = at.epsilon[:, None] * ((at.far * np.sign(at.residual)) @ x)
    both, gram = _weighted(x, near, np.stack([near @ (x * y[:, None]), pull], axis=2), at.penalty, moves)
    free, pulled = both[:, :, 0], both[:, :, 1]
    squares = np.einsum("sn,sn->s", near, (y - free @ x.T) ** 2) + (at.penalty * free**2).sum(axis=1)
    n_free = at.member.sum(axis=1) - at.epsilon**2 * at.far.sum(axis=1) - (pull * pulled).sum(axis=1)
    scale = np.sqrt(np.divide(squares, n_free, out=at.scale**2, where=n_free > 0))
    scale = np.maximum(scale, least)
    return free + scale[:, None] * pulled, scale, gram


def _descent(x: Array, y: Array, at: _Place, moves: Mask, least: Array) -> tuple[Array, Array, Array]:
    """The same by one step of the scale, and one of least squares with weights."""
    size = np.abs(at.residual)
    near = np.minimum(size, (at.epsilon * at.scale)[:, None])
    squares = np.einsum("sn,sn,sn->s", at.member, near, near) + (at.penalty * at.beta**2).sum(axis=1)
    scale = np.maximum(np.sqrt(squares / np.maximum(at.member.sum(axis=1), 1.0)), least)
    reach = (at.epsilon * scale)[:, None]
    weight = at.member * np.divide(reach, size, out=np.ones_like(size), where=size > reach)
    found, gram = _weighted(x, weight, (weight @ (x * y[:, None]))[:, :, None], at.penalty, moves)
    return found[:, :, 0], scale, gram


def _weighted(x: Array, weight: Array, right: Array, penalty: Array, moves: Mask) -> tuple[Array, Array]:
    """Solutions (S, q, r) of weighted normal equations, weights (S, n), right (S, q, r); and their matrices."""
    q = x.shape[1]
    gram = np.empty((len(weight), q, q))
    for j in range(q):  # one thin product after the other: rows times q² would not fit for many inputs
        gram[:, j, j:] = weight @ (x[:, j:] * x[:, j, None])
        gram[:, j:, j] = gram[:, j, j:]
    gram *= moves[:, :, None] & moves[:, None, :]
    np.einsum("sjj->sj", gram)[:] += np.where(moves, penalty, 1.0)
    size = 1.0 / np.sqrt(np.einsum("sjj->sj", gram))
    even = gram * (size[:, :, None] * size[:, None, :])
    return np.linalg.solve(even, right * (moves * size)[:, :, None]) * size[:, :, None], gram
