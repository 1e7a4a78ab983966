"""When drivers act within a row: learned from recordings, stated by the machine file, and what a row shows of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from data.arrays import Array
from data.batch import Batch
from data.machine import LEAD_ROWS, Machine
from tests.twin.machines import TWO_BODIES, machine
from tests.twin.recordings import empty_batches, recorded
from twin.calibration.least_squares import FitOptions
from twin.calibration.problem import CalibrationProblem
from twin.calibration.recorder import converge_with_lead, lead_remarks
from twin.compile import compile_network
from twin.simulation import simulate
from twin.simulation.inputs import acting, inputs_of

STEP_S = 300.0
SHIFT = {"law": "speed_shift", "acts_on": "z", "drivers": "rpm", "parameters": {"shift": "6 um"}}


def two_bodies(drivers: str | None = None, **changes: Any) -> Machine:
    """Two bodies; the file may state what a row shows of a driver."""
    own = {**TWO_BODIES["recording"], **({"drivers": drivers} if drivers else {})}
    return machine({**TWO_BODIES, "recording": own}, **changes)


@cache
def shown_late(rows: float) -> tuple[Batch, ...]:
    """Runs whose speed changes so many rows before the row that first shows it, simulated in quarters of rows."""
    known, stride = two_bodies(), 4
    every = zip(empty_batches(known, 4, step_s=STEP_S), empty_batches(known, 4, step_s=STEP_S / stride), strict=True)
    fine = []
    for shown, b in every:
        rpm = np.repeat(shown.values("rpm"), stride)[: b.n_rows]
        ahead = round(rows * stride)
        fine.append(replace(b, table=b.table.assign(rpm=np.append(rpm[ahead:], np.full(ahead, rpm[-1])))))
    out = []
    for shown, b in zip(empty_batches(known, 4, step_s=STEP_S), recorded(known, fine, seed=3), strict=True):
        table = b.table.iloc[::stride].reset_index(drop=True)
        out.append(replace(b, table=table.assign(rpm=shown.table["rpm"])))
    return tuple(out)


def learned_rows(known: Machine, batches: tuple[Batch, ...]) -> float:
    network = compile_network(known)

    def problem(lead_rows: float) -> CalibrationProblem:
        return CalibrationProblem.of(network, acting(batches, lead_rows))

    return converge_with_lead(known, problem, FitOptions(tolerance=1e-2))[0]


@pytest.mark.parametrize("rows", [0.0, 0.5, 1.0])
def test_by_how_much_a_recorder_is_late_is_learned(rows: float) -> None:
    assert learned_rows(two_bodies(), shown_late(rows)) == rows


@pytest.mark.parametrize(("drivers", "rows"), LEAD_ROWS.items())
def test_a_machine_file_that_states_it_is_obeyed(drivers: str, rows: float) -> None:
    assert all(learned_rows(two_bodies(drivers), shown_late(late)) == rows for late in (0.0, 1.0))


def test_where_no_driver_ever_changes_nothing_is_learned() -> None:
    still = tuple(replace(b, table=b.table.assign(rpm=3000.0)) for b in shown_late(1.0))
    assert learned_rows(two_bodies(), still) == 0.0


def test_a_lead_that_was_learned_is_told_with_what_states_it() -> None:
    assert lead_remarks(two_bodies(), 0.0) == lead_remarks(two_bodies("mean"), 1.0) == ()
    for rows, words, key in ((0.5, "half a row", "instant"), (1.0, "a row", "mean")):
        (said,) = lead_remarks(two_bodies(), rows)
        assert said.startswith(f"a change of a driver comes {words} before") and f"recording.drivers: {key}" in said


# acting


@pytest.mark.parametrize(
    ("lead_rows", "rpm"), [(0.0, [0.0, 0.0, 4000.0, 4000.0]), (0.5, [0.0, 2000.0, 4000.0, 2000.0]),
                           (1.0, [0.0, 4000.0, 4000.0, 0.0])]
)  # fmt: skip
def test_between_two_rows_the_mean_of_what_holds_acts_and_rows_show_what_they_did(
    lead_rows: float, rpm: list[float]
) -> None:
    network = compile_network(two_bodies())
    (b,) = empty_batches(two_bodies(), 1, hours=4 / 12, step_s=STEP_S)
    given = replace(b, table=b.table.assign(rpm=[0.0, 0.0, 4000.0, 4000.0, 0.0]))
    inputs = inputs_of(network, acting([given], lead_rows))
    np.testing.assert_array_equal(inputs.drivers["rpm"], [rpm])
    rows = inputs.at_rows.get("rpm")
    assert (rows is None) == (lead_rows == 0.0)
    if rows is not None:
        np.testing.assert_array_equal(rows, [[0.0, 0.0, 4000.0, 4000.0, 0.0]])
        np.testing.assert_array_equal(inputs.batch([0]).at_rows["rpm"], rows)


def test_a_hole_is_held_as_without_a_lead() -> None:
    network = compile_network(two_bodies())
    (b,) = empty_batches(two_bodies(), 1, hours=4 / 12, step_s=STEP_S)
    given = replace(b, table=b.table.assign(rpm=[1000.0, 2000.0, np.nan, 3000.0, 3000.0]))
    inputs = inputs_of(network, acting([given], 1.0))
    np.testing.assert_array_equal(inputs.drivers["rpm"], [[2000.0, 2000.0, 2000.0, 3000.0]])


def shown_um(shift: bool, lead_rows: float) -> tuple[Array, Array]:
    """Displacement z and the temperatures of both bodies in the rows of a run."""
    network = compile_network(two_bodies(mechanisms__shift=SHIFT) if shift else two_bodies())
    runs = acting(empty_batches(two_bodies(), 2), lead_rows)
    start = np.full((1, len(runs), network.n_cells), 20.0)
    done = simulate(network, network.values, inputs_of(network, runs, 2), start)
    return done.errors[0, ..., 0], done.readings[0]


@pytest.mark.parametrize("lead_rows", [0.5, 1.0])
def test_a_displacement_that_follows_the_speed_shows_the_speed_of_its_own_row_whatever_the_lead(
    lead_rows: float,
) -> None:
    jump_um = [shown_um(True, lead)[0] - shown_um(False, lead)[0] for lead in (0.0, lead_rows)]
    np.testing.assert_allclose(jump_um[1][:, :-1], jump_um[0][:, :-1], atol=1e-9)
    assert np.ptp(jump_um[0]) > 1.0
    warmer_K = shown_um(False, lead_rows)[1] - shown_um(False, 0.0)[1]
    assert warmer_K.max() > 0.1  # and heat comes earlier
