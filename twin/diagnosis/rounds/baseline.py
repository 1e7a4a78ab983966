"""A fair baseline: the machine file at its best recalibration, before anything is said to be missing."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from data.batch import Batch
from data.errors import InputError
from data.machine import Machine
from twin.calibration.estimate import check_batches
from twin.calibration.fit_noise import Noise
from twin.calibration.least_squares import settled
from twin.calibration.measured import EVERY_S
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network
from twin.diagnosis.rounds.fitted import Fitted, settle
from twin.schema import TwinPart

TOLERANCE, STEPS = 1e-2, 40
# Every channel's noise to begin with, and rows that count as one: alike, so that none is given up for others.
MISFIT, SMOOTH = 3.0, 20.0
ROWS = 60  # of a usual batch, at least: a run of ten minutes is no less a run than one of six hours


def check(machine: Machine, batches: Sequence[Batch]) -> None:
    """Raises InputError: no batches, one of another machine, or the same twice."""
    if not batches:
        raise InputError(f"machine {machine.machine}: no batches to diagnose; give recordings")
    check_batches(machine, batches)


def baseline(
    machine: Machine,
    part: TwinPart,
    batches: Sequence[Batch],
    progress: Callable[[str, int, int], None] | None = None,
    runs: int = 0,
) -> Fitted:
    """The twin part fitted to all batches, with the noise of every channel as the fit leaves it; `runs` that they
    come from, where they are blocks of fewer.

    Raises:
        InputError: batches of another machine, twice the same, or that cannot be simulated.
        WorkError: the model fails at the priors' means.
    """
    check(machine, batches)
    problem = CalibrationProblem.of(compile_network(machine, part=part), batches, spacing_s(batches))
    steps = 0

    def told(_: str) -> None:
        nonlocal steps
        steps += 1
        if progress:
            progress("baseline", steps, 0)

    k = len(problem.channels)
    alike = Noise(np.full(k, MISFIT), np.full(k, SMOOTH))
    state, _ = settled(problem, tolerance=TOLERANCE, max_iterations=STEPS, progress=told, noise=alike)
    return settle(Fitted(machine, part, tuple(batches), problem, state, runs or len(batches)))


def spacing_s(batches: Sequence[Batch]) -> float:
    """Seconds from one row that is looked at to the next."""
    lengths = sorted(b.step_s * b.n_rows for b in batches) or [0.0]  # none: told where they are simulated
    return min(EVERY_S, lengths[len(lengths) // 2] / ROWS) or EVERY_S
