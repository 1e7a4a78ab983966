"""When an effect is at work in the runs of a case, as an answer key tells it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twin.plants.casting import Array
from twin.plants.conditions import moments
from twin.plants.effects.base import Effect
from twin.plants.physics import Course
from twin.plants.runs import Run

AT_WORK = 0.1  # of the largest heat in any run
NEARLY_ALWAYS = 0.95  # of the rows

Windows = Literal["always"] | list[list[str | float]]  # [batch id, start s, end s]


def windows(effect: Effect, runs: Sequence[Run], step_s: float, course: Course) -> Windows:
    """Stretches in which the effect works, on the rows of the recordings, or "always".

    What a driver or a gate switches works while that is on. Another one that moves heat works while that is more than
    a tenth of its largest. Faults, chains and constants always do.
    """
    rows_s = np.arange(0.0, runs[0].hours * 3600.0 + 1.0, step_s)
    shown = moments(runs, rows_s, rows_s)
    on = np.stack([effect.active(now) for now in shown])
    if on.all():
        heat_W = moved_W(effect, runs, rows_s, course)
        on = heat_W >= AT_WORK * heat_W.max()
    if on.mean() > NEARLY_ALWAYS:
        return "always"
    return [[run.batch_id, *ends] for b, run in enumerate(runs) for ends in stretches(on[:, b], rows_s)]


def moved_W(effect: Effect, runs: Sequence[Run], rows_s: Array, course: Course) -> Array:
    """Heat that an effect moves into or out of all cells together, W, (rows, B)."""
    at = np.searchsorted(course.time_s, rows_s - 1e-6)
    out = []
    for k, now in zip(at, moments(runs, rows_s, rows_s), strict=True):
        heat_W = np.zeros_like(course.cells_degC[k])
        effect.add_heat_W(heat_W, course.cells_degC[k], now)
        out.append(np.abs(heat_W).sum(axis=0))
    return np.stack(out)


def stretches(on: NDArray[np.bool_], time_s: Array) -> list[list[float]]:
    """[start, end] of every stretch: from its first row to the row at which it is over, or to the last one."""
    edges = np.flatnonzero(np.diff(np.r_[False, on, False].astype(int)))
    last = len(time_s) - 1
    return [[float(time_s[a]), float(time_s[min(b, last)])] for a, b in zip(edges[::2], edges[1::2], strict=True)]
