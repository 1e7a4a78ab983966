"""Checks of sensors at a control: they find what the guard finds, in the same row, in C and structured text too."""

from __future__ import annotations

import ctypes
from functools import cache
from math import isfinite, nan
from pathlib import Path

import numpy as np
import pytest
from test_exports_receiver import Sender, blocks, needs_gcc
from test_runtime import INPUTS, model_of

from compensation.exports.base import Export, ExportedAxis
from compensation.exports.region import checks_program
from compensation.faults import faults, with_values
from compensation.safety import Limits
from compensation.substitutes import Guard, Substitutes
from data.batch import Batch
from models.program import replay
from tests.conftest import make_toy_batches
from tests.toys.exported import C, export_of

LIMITS = Limits(max_offset_um=40.0, rate_um_per_s=0.5, step_um=2.0, hold_s=900.0, stale_s=900.0, warm_up_s=20.0)
FAULTS = ("none", "frozen", "a step of 5 K", "out of range", "a spike")


@cache
def machine() -> tuple[Export, Guard, Batch]:
    """An axis with checks of its sensors, the guard that they come from, and a run that it has not seen."""
    *train, left = make_toy_batches(8, 400)
    model, guard = model_of(train), Guard(Substitutes.learn(train, INPUTS))
    checks = checks_program(guard, model.program.channels, left.channels, left.step_s)
    plausible = {n: (float(left.channels[n].low or -50.0), float(left.channels[n].high or 150.0)) for n in INPUTS}
    return export_of(ExportedAxis("z", model.program, {}, LIMITS, plausible=plausible, checks=checks)), guard, left


def stream(kind: str, name: str) -> np.ndarray:
    """Rows of the model's channels, of which one fails from a quarter of the run on."""
    (a,), batch = machine()[0].axes, machine()[2]
    columns = {k: c for k, at_fault, c in faults(batch, [name])}
    first = np.flatnonzero(columns["a step of 5 K"][name] != batch.masked(name))[0]
    columns["a spike"] = {name: batch.masked(name) + 12.0 * (np.arange(batch.n_rows) == first)}
    columns["out of range"] = {name: np.where(np.arange(batch.n_rows) < first, batch.masked(name), 999.0)}
    seen = with_values(batch, columns[kind]) if kind != "none" else batch
    return np.column_stack([seen.masked(c) for c in a.program.channels])


def guarded(kind: str, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Whether the guard finds a channel failing in a row (n,), and the values that it lets pass."""
    export, guard, batch = machine()
    channels, watch, failing, passed = export.axes[0].program.channels, guard.begin(levels=False), [], []
    for time_s, row in zip(batch.time_s, stream(kind, name), strict=True):
        watch, checked = guard.step(watch, float(time_s), dict(zip(channels, row.tolist(), strict=True)))
        failing.append(any(s != "ok" for n, s in checked.status.items() if n in channels))
        passed.append([checked.values[c] for c in channels])
    return np.array(failing), np.array(passed)


@pytest.mark.parametrize("name", ["t0", "t4", "room"])
@pytest.mark.parametrize("kind", FAULTS)
def test_the_program_finds_what_the_guard_does(kind: str, name: str) -> None:
    (a,), (failing, passed) = machine()[0].axes, guarded(kind, name)
    assert a.checks is not None and a.checks.channels == a.program.channels
    rows = stream(kind, name)
    usable = np.array([(low <= v) & (v <= high) for v, (low, high) in zip(rows.T, a.usable(), strict=True)]).T
    *filled, failed = replay(a.checks, np.where(usable, rows, nan)).T
    assert np.array_equal(~(failed == 0.0), failing)
    there = np.isfinite(failed)
    assert np.abs(np.transpose(filled)[there] - passed[there]).max() < 1e-9
    found = {"none": [], "frozen": ["t4"], "a step of 5 K": ["t4", "room"]}.get(kind, ["t0", "t4", "room"])
    assert failing.any() == (name in found)  # t0 moves as fast by itself


@needs_gcc
@pytest.mark.parametrize("kind", FAULTS)
def test_c_and_structured_text_let_no_failing_sensor_move_the_correction(kind: str, tmp_path: Path) -> None:
    export, (failing, passed) = machine()[0], guarded(kind, "t4")
    made, (block,), expected, (a,) = C(export, "c", tmp_path), blocks(export, "st"), Sender(export.axes), export.axes
    run, state, seen = a.program.runner(), a.program.begin(), set()
    for row, fails, values in zip(stream(kind, "t4"), failing, passed, strict=True):
        if kind == "out of range":  # a value that is missing leaves the last one, not what replaces it
            values = np.where(row < 900.0, row, nan)
        error_um = float(run(state, values)[0])
        wanted = None if fails or not isfinite(error_um) else [-error_um]
        (sent,) = expected.move(0, a.program.step_s, wanted, wanted is None, False)
        offset, slope = np.zeros(1), np.zeros(1)
        assert made.call("correction_row", np.ascontiguousarray(row)) == int(fails)
        made.call("correction_move", ctypes.c_double(a.program.step_s), offset, slope)
        given = {f"in_{c}": v for c, v in zip(a.program.channels, row.tolist(), strict=True)}
        done = block.call(elapsed_s=a.program.step_s, **given)
        assert abs(offset[0] - sent) <= 1e-9 and abs(done["offset_um"] - sent) <= 1e-9
        assert done["state"] == made.call("state", 0) == expected.state(0) and done["valid"] == (not fails)
        seen.add(done["state"])
    assert 2 in seen and (seen >= {3, 4}) == (kind != "none")


@needs_gcc
def test_a_reset_forgets_what_failed(tmp_path: Path) -> None:
    export = machine()[0]
    made, (block,) = C(export, "c", tmp_path), blocks(export, "st")
    for row in (*stream("a step of 5 K", "t4")[99:102], None, *stream("a step of 5 K", "t4")[102:104]):
        if row is None:
            made.call("reset")
            block.call(elapsed_s=0.0, reset=True, fresh=False)
            continue
        lacking = made.call("correction_row", np.ascontiguousarray(row))
        given = {f"in_{c}": v for c, v in zip(export.axes[0].program.channels, row.tolist(), strict=True)}
        done = block.call(elapsed_s=300.0, reset=False, fresh=True, **given)
        assert done["valid"] == (not lacking)
    assert lacking == 0


def test_files_state_the_checks() -> None:
    assert any("missing, not usable, frozen or stepping" in line for line in machine()[0].heading())
