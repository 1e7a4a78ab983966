"""What temperature-dependent heat answers to derivatives of temperatures: linear, so solved interval by interval.

Within an interval heat is linear and follows the temperatures at both ends; those at the end follow from it in turn.
With k sources that is one small linear system per interval, whose inverse all unknowns share: no iteration.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.simulation.coupling import outlets
from twin.simulation.modes import first_order_hold
from twin.simulation.solved import Solved

Array = NDArray[np.float64]


class Answer:
    """Heat ``w = slope (seen + y) + given`` of k sources, y being what it makes of the temperatures seen.

    `matrix` (n, N) are the places that the sources look at and `slope` (B, M, 2, k, n) their W/K at both ends of every
    interval.
    """

    def __init__(self, solved: Solved, matrix: Array, slope: Array) -> None:
        balance, modes = solved.balance, solved.response.modes
        schedule = balance.schedule
        self.matrix, self.slope = matrix, slope
        pairs, number = np.unique(schedule.regime * len(schedule.step_s) + schedule.step, return_inverse=True)
        self.number = number.reshape(schedule.regime.shape)  # of each interval's regime and step
        regime, dt_s = pairs // len(schedule.step_s), schedule.step_s[pairs % len(schedule.step_s), None]
        decay, start_s, end_s = first_order_hold(modes.rate_per_s[0, regime], dt_s)
        shape = modes.shape[0, regime]
        modal = (outlets(balance, solved.sources)[0, regime] @ shape).swapaxes(-1, -2)
        self.keeps = (shape * decay[:, None]) @ modes.inverse[0, regime]  # (pairs, N, N)
        self.of_start = shape @ (start_s[..., None] * modal)  # (pairs, N, k)
        self.of_end = shape @ (end_s[..., None] * modal)
        loop = slope[:, :, 1] @ (matrix @ self.of_end)[self.number]
        self.solution = np.linalg.inv(np.eye(loop.shape[-1]) - loop)  # (B, M, k, k)

    def heat_W(self, part: slice, seen: Array, given: Array, now: Array) -> tuple[Array, Array, Array]:
        """From y of all cells at the start of some intervals, `now` (B, N, Q): heat, y of the places, y at the end.

        Time goes first: seen (m + 1, B, n, Q), given and heat (m, 2, B, k, Q), y (m + 1, B, n, Q).
        """
        heat, y = np.empty_like(given), np.empty_like(seen)
        y[0] = self.matrix @ now
        for i, m in enumerate(range(part.start, part.stop)):
            number = self.number[:, m]
            heat[i, 0] = self.slope[:, m, 0] @ (seen[i] + y[i]) + given[i, 0]
            ahead = self.keeps[number] @ now + self.of_start[number] @ heat[i, 0]
            known = self.slope[:, m, 1] @ (seen[i + 1] + self.matrix @ ahead) + given[i, 1]
            heat[i, 1] = self.solution[:, m] @ known
            now = ahead + self.of_end[number] @ heat[i, 1]
            y[i + 1] = self.matrix @ now
        return heat, y, now
