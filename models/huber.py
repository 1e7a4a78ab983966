"""Family: Huber regression, quadratic for small and linear for large residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from data.arrays import Array
from data.errors import InputError
from models.base import inner_groups
from models.linear import Linear, Mask, Task
from models.solvers.penalised import Settled, settle
from models.solvers.pooled_sums import FLAT


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
