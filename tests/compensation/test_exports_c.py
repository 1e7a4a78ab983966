"""The C export: compiles without a warning, computes what the program computes, and limits what it sends."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_exports_programs import PROGRAMS, Batches, dynamic, every_operation, fitted, rows_with_holes

from compensation.exports import EXPORTS
from compensation.exports.base import Export, ExportedAxis
from models.program import replay
from tests.toys.exported import LIMITS, export_of, offset_only, straight

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc to compile the C export")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")


class Compiled:
    """The compiled functions of one machine."""

    def __init__(self, export: Export, folder: Path) -> None:
        source, header = sorted(EXPORTS["c"]().write(export, folder))
        assert (source.suffix, header.suffix) == (".c", ".h")
        library = folder / "machine.so"
        command = ["gcc", *FLAGS, "-shared", "-fPIC", "-o", str(library), str(source), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        self.library, self.stem = ctypes.CDLL(str(library)), export.stem
        self.channels = list(dict.fromkeys(c for a in export.axes for c in a.program.channels))
        self.axes, self.outputs = len(export.axes), sum(len(a.program.outputs) for a in export.axes)
        self.reset()

    def reset(self) -> None:
        getattr(self.library, f"{self.stem}_reset")()

    def _call(self, name: str, *args: object) -> int:
        function = getattr(self.library, f"{self.stem}_{name}")
        made = [a.ctypes.data_as(ctypes.c_void_p) if isinstance(a, np.ndarray) else a for a in args]
        return int(function(*made))

    def step(self, row: np.ndarray) -> tuple[int, np.ndarray]:
        out = np.full(self.outputs, 7.0)
        return self._call("step", np.ascontiguousarray(row, float), out), out

    def correction(self, row: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        offset, slope = np.full(self.axes, 7.0), np.full(self.axes, 7.0)
        lacking = self._call("correction_step", np.ascontiguousarray(row, float), offset, slope)
        return lacking, offset, slope

    def move(self, elapsed_s: float) -> float:
        offset, slope = np.full(self.axes, 7.0), np.full(self.axes, 7.0)
        function = getattr(self.library, f"{self.stem}_correction_move")
        function.restype = None
        pointers = (a.ctypes.data_as(ctypes.c_void_p) for a in (offset, slope))
        function(ctypes.c_double(elapsed_s), *pointers)
        return float(offset[0])


def test_every_family_in_one_machine(toy_batches: Batches, tmp_path: Path) -> None:
    programs = {key: fitted(key, toy_batches) for key in PROGRAMS}
    export = export_of(*(ExportedAxis(key, p, {}, LIMITS) for key, (p, _) in programs.items()))
    machine = Compiled(export, tmp_path)
    values = {c: rows[:, k] for p, rows in programs.values() for k, c in enumerate(p.channels)}
    got = []
    for row in np.column_stack([values[c] for c in machine.channels]):
        lacking, out = machine.step(row)
        assert lacking == 0
        got.append(out)
    wanted = np.column_stack([replay(p, rows) for p, rows in programs.values()])
    assert np.abs(np.array(got) - wanted).max() < 1e-9


def test_every_operation_with_holes_and_after_a_reset(tmp_path: Path) -> None:
    program = every_operation()
    machine = Compiled(export_of(dynamic()), tmp_path)
    rows = rows_with_holes(program)
    wanted = replay(program, rows)
    assert np.isnan(wanted).any() and np.isfinite(wanted[50:]).all()
    for _ in range(2):
        made = [machine.step(row) for row in rows]
        assert np.array_equal([lacking for lacking, _ in made], np.isnan(wanted[:, 0]))
        assert np.allclose([out for _, out in made], wanted, rtol=0.0, atol=1e-9, equal_nan=True)
        machine.reset()


def test_the_file_can_state_any_text(tmp_path: Path) -> None:
    export = export_of(replace(offset_only(), axis="z*/"), machine="a */ b ??/ \\ /* µ\nc")
    Compiled(replace(export, model='x "y" \\'), tmp_path)


def test_the_correction_is_limited_in_size_and_rate_and_reaches_the_negative_error(tmp_path: Path) -> None:
    machine = Compiled(export_of(straight()), tmp_path)  # at 0.02 µm/s a step of 300 s is 6 µm
    sent, slopes = [0.0], [0.0]
    for t0 in [20.0] * 5 + [24.0] * 8 + [45.0] * 12:
        lacking, offset, slope = machine.correction(np.array([t0, 20.0]))
        assert lacking == 0
        sent.append(offset[0])
        slopes.append(slope[0])
    assert np.abs(np.diff(sent)).max() <= 6.0 + 1e-9 and np.abs(np.diff(slopes)).max() <= 6.0 / 0.4 + 1e-9
    assert sent[1] == 6.0 and sent[9] == pytest.approx(-(1.5 + 12.0 - 40.0)) and slopes[13] == pytest.approx(-40.0)
    assert sent[-1] == pytest.approx(-36.5) and slopes[-1] == pytest.approx(-100.0)  # 40 µm at 0.4 m
    stepped = Compiled(export_of(replace(straight(), limits=replace(LIMITS, step_um=1.0))), tmp_path / "stepped")
    assert [stepped.correction(np.array([20.0, 20.0]))[1][0] for _ in range(3)] == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("bad", [np.nan, 1e6, -300.0, np.inf])
def test_a_faulty_sensor_holds_then_fades_then_returns(bad: float, tmp_path: Path) -> None:
    machine = Compiled(export_of(offset_only()), tmp_path)
    good = np.array([20.0, 20.0])
    for _ in range(10):
        before = machine.correction(good)[1][0]
    assert before == 38.5
    got = [machine.correction(np.array([20.0, bad]))[1][0] for _ in range(16)]
    assert got[:4] == [38.5] * 4  # 900 s after the first faulty row
    assert got[4:6] == pytest.approx([32.5, 26.5])
    assert got[-1] == 0.0
    assert machine.correction(good)[1][0] == pytest.approx(6.0)


def test_silence_is_a_fault_and_small_movements_make_a_large_one(tmp_path: Path) -> None:
    machine = Compiled(export_of(offset_only()), tmp_path)
    machine.reset()
    row = np.array([20.0, 20.0])
    machine._call("correction_row", row)
    moved = [machine.move(10.0) for _ in range(90)]
    assert np.allclose(np.diff(moved), 0.2) and moved[-1] == pytest.approx(18.0)
    held = [machine.move(10.0) for _ in range(92)]  # 900 s without a row, then 900 s
    assert np.ptp(held[1:-1]) < 0.5 and machine.move(10.0) < held[5]
    assert np.isfinite(machine.move(float("nan"))) and np.isfinite(machine.move(-5.0))
