"""When drivers changed within a row: learned from the recordings where the machine file does not state it.

A recorder that reads a speed at an instant shows a change up to a row late; one that writes means shows it a row late.
A twin that holds every driver from its row on is late by as much, which looks like a skew of clocks or a sensor's lag.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from data.machine import LEAD_ROWS, Machine
from twin.calibration.fit_problem import Noise
from twin.calibration.least_squares import FitOptions, State, converge, log_posterior, noise_left
from twin.calibration.problem import CalibrationProblem


def converge_with_lead(
    machine: Machine,
    problem_at: Callable[[float], CalibrationProblem],
    options: FitOptions,
    noise: Noise | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[float, CalibrationProblem, State, str]:
    """`converge` for the problem whose drivers lead by as many rows as is likeliest, or as the machine file states.

    Compared are the posteriors at each optimum with the noise of every channel unknown; rows count the same for all.

    Args:
        problem_at: the problem whose drivers' changes come so many rows (0 to 1) before the row that shows them.

    Returns:
        The lead in rows, its problem, and what `converge` returns for it.
    """
    first_rows = first_lead_rows(machine)
    held = problem_at(first_rows)
    state, notes = converge(held, options, progress, noise)
    best = first_rows, held, state, notes
    if not must_learn_lead(machine, held):
        return best
    noise_held = noise_left(held, state)
    most = log_posterior(held, state, noise_held, noise_held.inflation)
    for lead_rows in sorted(LEAD_ROWS.values())[1:]:
        problem = problem_at(lead_rows)
        state, notes = converge(problem, options, progress, noise)
        level = log_posterior(problem, state, noise_left(problem, state), noise_held.inflation)
        if level > most:
            best, most = (lead_rows, problem, state, notes), level
    return best


def first_lead_rows(machine: Machine) -> float:
    """The lead that the machine file states, or that of drivers held from their row on."""
    return LEAD_ROWS[machine.recording.drivers or "held"]


def must_learn_lead(machine: Machine, held: CalibrationProblem) -> bool:
    """Whether the machine file leaves open when drivers act, and one of them moves."""
    moves = any(np.ptp(v) for v in held.inputs.drivers.values())
    return machine.recording.drivers is None and bool(held.network.drivers) and moves


def lead_remarks(machine: Machine, lead_rows: float) -> tuple[str, ...]:
    """When drivers act, where that was learned and is not from their row on."""
    if machine.recording.drivers is not None or not lead_rows:
        return ()
    meant = next(name for name, rows in LEAD_ROWS.items() if rows == lead_rows)
    row = "half a row" if lead_rows < 1.0 else "a row"
    return (
        f"a change of a driver comes {row} before the row that first shows it (learned from the recordings; "
        f"recording.drivers: {meant} in the machine file states it)",
    )
