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
    """y of a linear network to heat ``w = slope (seen + y) + given`` of k sources, at outputs `matrix` (n_out, N).

    The sources look at the first n outputs, with `slope` (B, M, 2, k, n), W/K, at both ends of every interval.
    """

    def __init__(self, solved: Solved, matrix: Array, slope: Array) -> None:
        balance, modes = solved.balance, solved.response.modes
        schedule, valid = balance.schedule, balance.inputs.valid
        self.matrix, self.slope = matrix, slope
        kind = np.where(valid, schedule.regime * len(schedule.step_s) + schedule.step, -1)
        kinds, number = np.unique(kind, return_inverse=True)
        self.number = number.reshape(kind.shape)  # of each interval's regime and step
        regime, dt_s = kinds // len(schedule.step_s), schedule.step_s[kinds % len(schedule.step_s), None]
        decay, start_s, end_s = first_order_hold(modes.rate_per_s[0, regime], dt_s * (kinds >= 0)[:, None])
        shape = modes.shape[0, regime]
        modal = (outlets(balance, solved.sources)[0, regime] @ shape).swapaxes(-1, -2)
        self.keeps = (shape * decay[:, None]) @ modes.inverse[0, regime]  # (kinds, N, N); behind the end all of it
        self.of_start = shape @ (start_s[..., None] * modal)  # (kinds, N, k)
        self.of_end = shape @ (end_s[..., None] * modal)
        loop = slope[:, :, 1] @ (matrix[: slope.shape[-1]] @ self.of_end)[self.number]
        self.solution = np.linalg.inv(np.eye(loop.shape[-1]) - loop)  # (B, M, k, k)

    def run(self, part: slice, seen: Array, given: Array, now: Array, every: int = 1) -> tuple[Array, Array]:
        """Outputs and, at the end, all cells of y from its cells `now` (B, N, Q) at the start of some intervals.

        Time goes first: seen (m + 1, B, n, Q), given (m, 2, B, k, Q), outputs (m // every + 1, B, n_out, Q).
        """
        n_seen, shown = seen.shape[2], self.matrix @ now
        out = np.empty(((part.stop - part.start) // every + 1, *shown.shape))
        out[0] = shown
        for i, m in enumerate(range(part.start, part.stop)):
            number = self.number[:, m]
            start_W = self.slope[:, m, 0] @ (seen[i] + shown[:, :n_seen]) + given[i, 0]
            ahead = self.keeps[number] @ now + self.of_start[number] @ start_W
            known_W = self.slope[:, m, 1] @ (seen[i + 1] + self.matrix[:n_seen] @ ahead) + given[i, 1]
            now = ahead + self.of_end[number] @ (self.solution[:, m] @ known_W)
            shown = self.matrix @ now
            if (i + 1) % every == 0:
                out[(i + 1) // every] = shown
        return out, now
