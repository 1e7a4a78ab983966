"""The twins of the laboratory board and the cell predict runs that they never saw, from first readings alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest
from numpy.typing import ArrayLike

from data.batch import Batch
from data.machine import Machine, load_machine
from tests.real.recorded import ROOT, recorded
from twin.calibration import CalibrationOptions, calibrate
from twin.calibration.estimate import leave_batch_out
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network

EVERY_S = 10.0
ALIKE = ("energy_balance_mimo", "mimo2_data")  # finest readings, and boards that differ least


def board() -> tuple[Machine, list[Batch]]:
    return recorded("tclab_board", "tclab", 1.0)


def cell() -> tuple[Machine, list[Batch]]:
    return recorded("cell_30q", "cell_30q", 5.0)


def left_out(machine: Machine, batches: Sequence[Batch]) -> pd.DataFrame:
    """Error of every run by a calibration on the others, by (channel, batch)."""
    done = leave_batch_out(CalibrationProblem.of(compile_network(machine), batches, EVERY_S))
    assert all(f.converged for f in done.folds)
    return done.table.set_index(["channel", "batch"])


def predicted(machine: Machine, fitted: Batch, other: Batch) -> list[float]:
    """Rms in K of both temperatures of a run by a calibration on another alone."""
    problem = CalibrationProblem.of(
        calibrate(machine, [fitted], CalibrationOptions(every_s=EVERY_S)).network, [other], EVERY_S
    )
    (error,) = problem.free_running_errors(problem.network.values)
    return [rms(error[problem.measured[0].channel == c]) for c in range(2)]


def rms(error: ArrayLike) -> float:
    return math.sqrt(float(np.mean(np.asarray(error, float) ** 2)))


@pytest.mark.parametrize("name", ["tclab_board", "cell_30q"])
def test_their_files_compile_and_see_every_temperature(name: str) -> None:
    machine = load_machine(ROOT / "machines" / f"{name}.yml")
    network = compile_network(machine)
    assert {r.channel for r in network.readings} == {n for n, c in machine.channels.items() if c.role == "temperature"}
    assert {e.channel for e in network.errors} == {n for n, c in machine.channels.items() if c.role == "error"}


def test_watts_of_the_board_have_one_scale_which_is_held() -> None:
    network = compile_network(load_machine(ROOT / "machines" / "tclab_board.yml"))
    held = {p.name for p in network.parameters if not p.free}
    assert "mechanisms.heat1.gain" in held and "mechanisms.heat2.gain" not in held


def test_every_run_of_the_board_is_predicted_by_the_other_three() -> None:
    table = left_out(*board())
    assert (table["left_out"] < 0.25 * table["zero"]).all()
    assert rms(table["left_out"]) < 1.6 and table["left_out"].max() < 2.7
    assert (table.loc[["temperature1"]]["left_out"] < 1.6).all()


def test_boards_that_are_alike_predict_each_other() -> None:
    machine, batches = board()
    one, other = (next(b for b in batches if b.batch_id == name) for name in ALIKE)
    assert max(predicted(machine, one, other)) < 0.8
    assert max(predicted(machine, other, one)) < 1.3


def test_the_board_needs_its_shared_supply() -> None:
    machine, batches = board()
    part = dict(machine.twin or {})
    part["mechanisms"] = {n: m for n, m in part["mechanisms"].items() if m["law"] != "supply_sag"}
    apart = machine.model_copy(update={"twin": part})
    shared_K, apart_K = (
        rms(calibrate(m, batches, CalibrationOptions(every_s=EVERY_S)).rms["after"]) for m in (machine, apart)
    )
    assert shared_K < 1.1 and apart_K > 1.35 * shared_K


@pytest.mark.slow
def test_every_discharge_is_predicted_by_the_other_three() -> None:
    """4C by 1C to 3C among them: beyond every current, heat and temperature that was fitted."""
    table = left_out(*cell())
    can, strain = table.loc["can"], table.loc["hoop_strain"]
    assert (table["left_out"] < 0.12 * table["zero"]).all()
    assert can["left_out"].max() < 0.3 and can["left_out"]["Q30_S001_4C"] < 0.25  # K
    assert strain["left_out"].max() < 20.0 and strain["left_out"].median() < 14.0  # um/m
