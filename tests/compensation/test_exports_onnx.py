"""The ONNX export: a step and a batch give what the program gives."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from test_exports_programs import PROGRAMS, Batches, dynamic, every_operation, fitted, rows_with_holes

from compensation.exports import EXPORTS
from compensation.exports.base import ExportedAxis
from models.program import Program, replay
from tests.toys.exported import LIMITS, export_of

onnxruntime = pytest.importorskip("onnxruntime")


def session(path: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def check(axis: ExportedAxis, rows: np.ndarray, folder: Path) -> None:
    step_path, batch_path = EXPORTS["onnx"]().write(export_of(axis), folder)
    program: Program = axis.program
    wanted = replay(program, rows)
    (whole,) = session(batch_path).run(None, {"rows": rows})
    assert np.allclose(whole, wanted, rtol=0.0, atol=1e-9, equal_nan=True)
    run = session(step_path)
    sizes = json.loads(run.get_modelmeta().custom_metadata_map["state"])
    state = np.concatenate([np.full(sizes["nan"], np.nan), np.zeros(sizes["zeros"])])
    started, got = np.array(False), []
    own, here = program.runner(), program.begin()
    for row in rows:
        error, state, started = run.run(None, {"row": row, "state": state, "started": started})
        got.append(error)
        own(here, row)
        carried = np.concatenate([here.held, *here.carried[1:]])
        assert started == here.started and np.allclose(state, carried, rtol=0.0, atol=1e-9, equal_nan=True)
    assert np.allclose(got, wanted, rtol=0.0, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("key", PROGRAMS)
def test_a_family_row_by_row_and_as_a_batch(key: str, toy_batches: Batches, tmp_path: Path) -> None:
    program, rows = fitted(key, toy_batches)
    check(ExportedAxis("z", program, {}, LIMITS), rows, tmp_path)


def test_every_operation_with_holes(tmp_path: Path) -> None:
    check(dynamic(), rows_with_holes(every_operation()), tmp_path)


def test_metadata_is_complete(tmp_path: Path) -> None:
    for path in EXPORTS["onnx"]().write(export_of(dynamic()), tmp_path):
        told = session(path).get_modelmeta().custom_metadata_map
        assert json.loads(told["channels"])[:2] == ["a", "b"] and json.loads(told["units"])[0] == "degC"
        assert json.loads(told["required"]).count(False) == 1 and json.loads(told["step_s"]) == 300.0
        assert json.loads(told["trained"])[0] == [5.0, 35.0] and json.loads(told["limits"])["hold_s"] == 900.0
        assert told["simulated"] == "SIMULATED" and told["version"] == "v7" and len(told["sha256"]) == 64
        assert json.loads(told["position"])["reference_mm"] == 120.0
