"""The grey model GM(1,N) as equations, `x1⁰(k) + a z(k) = Σ b_i x_i¹(k)`: a batch's rows, and (a, b) from them.

x1 is the error and x_i, i = 2 … N, are the inputs; `¹` is the cumulated sum (1-AGO), begun anew in every batch, and
`z(k) = (x1¹(k) + x1¹(k−1))/2`.

Source: J. Deng, Introduction to grey system theory, J. Grey System 1 (1989).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from features.design import Design
from features.rises import hold_last

Array = NDArray[np.float64]
_RCOND = 1e-4  # sums of sensors of 0.1 K: directions weaker than this are rounding, and wreck other batches


@dataclass(frozen=True)
class GreyFit:
    """Development coefficient a per row, driving coefficients b (p,) in µm per K and row.

    `size` (p,) is the root of the sum of squares of every cumulated input, so that |b| · size compares the inputs
    whatever their units; `condition` is that of the columns, each scaled to unit size.
    """

    a: float
    b: Array
    size: Array
    condition: float


def equations(design: Design, k: int, recent_rows: int | None = None) -> Array:
    """Rows [−z, x_i¹ | x1⁰] of one batch from its second row on, (m, p + 2), usable rows only.

    `recent_rows`: of its last so many usable rows alone, and the sums begin with the first of them. The sums bridge
    holes by the last input and by a straight line in the error.
    """
    rows = design.rows(k)
    usable, y_um = design.usable[rows], design.y_um[rows]
    if usable.sum() < 2:
        return np.empty((0, len(design.inputs) + 2))
    n = np.arange(len(y_um))
    known = np.isfinite(y_um)
    y_um = np.interp(n, n[known], y_um[known])
    x = np.column_stack([hold_last(column) for column in design.x[rows].T]) if design.inputs else np.empty((len(n), 0))
    first = 0 if recent_rows is None else int(np.flatnonzero(usable)[-recent_rows:][0])
    usable, y_um, x = usable[first:], y_um[first:], x[first:]
    cumulated = np.cumsum(y_um)
    z = (cumulated[1:] + cumulated[:-1]) / 2.0
    return np.column_stack([-z, np.cumsum(x, axis=0)[1:], y_um[1:]])[usable[1:]]


def least_squares(rows: Array, a: float | None = None) -> GreyFit:
    """(a, b) from equations (m, p + 2) or their R factor, by a truncated SVD of the columns scaled to unit size.

    Directions below 1e-4 of the strongest are dropped. `a` given: b alone is fitted; the condition stays that of all.
    """
    size = np.linalg.norm(rows[:, :-1], axis=0)
    size[size == 0] = 1.0
    left, right = rows[:, :-1] / size, rows[:, -1]
    solution, _, _, singular = np.linalg.lstsq(left, right, rcond=_RCOND)
    if a is not None:
        solution = np.concatenate([[0.0], np.linalg.lstsq(left[:, 1:], right - a * rows[:, 0], rcond=_RCOND)[0]])
    least = singular[singular > 0]
    condition = float(singular[0] / least[-1]) if len(least) else float("inf")
    b = solution[1:] / size[1:]
    return GreyFit(float(solution[0] / size[0]) if a is None else a, b, size[1:], condition)
