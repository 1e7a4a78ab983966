"""`thermodrift calibrate` as a user meets it: exit codes, one line of trouble, clean JSON, files kept on failure."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import yaml

from data.machine import load_machine
from tests.toys.command import Call
from tests.twin.machines import TWO_BODIES
from tests.twin.recordings import empty_batches, recorded
from twin.compile import compile_network
from twin.schema import twin_part


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine file whose truth is not its prior, and three recordings of it."""
    monkeypatch.setenv("THERMODRIFT_HOME", str(tmp_path / "home"))
    raw = copy.deepcopy(TWO_BODIES)
    raw["twin"]["bodies"]["head"]["capacity"] = "40 kJ/K"
    raw["recording"] = {"step_s": 300, "files": ["*.csv"]}
    (tmp_path / "two.yml").write_text(yaml.safe_dump(raw), encoding="utf-8")
    machine = load_machine(tmp_path / "two.yml")
    values = compile_network(machine)
    truth = values.values * 1.0
    truth[values.index("mechanisms.belt.power")] *= 1.3
    (tmp_path / "in").mkdir()
    for batch in recorded(machine, empty_batches(machine, 3), truth, seed=1):
        batch.table.to_csv(tmp_path / "in" / f"{batch.batch_id}.csv", index=False)
    return tmp_path


@pytest.fixture
def call(folder: Path, monkeypatch: pytest.MonkeyPatch, call: Call) -> Call:
    """`thermodrift calibrate --machine two.yml --out new.yml ARGS` in this process, on one core."""
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    return partial(call, "calibrate", "--machine", folder / "two.yml", "--out", folder / "new.yml")


def test_recordings_become_a_calibrated_file(folder: Path, call: Call) -> None:
    done = call("--recordings", folder / "in")
    assert done.code == 0, done.err
    assert "4 parameters from 3 batches  (simulated recordings); converged after" in done.out
    for words in ("belt power", "90 % interval", "width left", "left out", "3 batches left out one by one",
                  "t_head: the residual", "new.yml: calibrated machine file"):  # fmt: skip
        assert words in done.out, words
    new = load_machine(folder / "new.yml")
    network, part = compile_network(new), twin_part(new)
    power = network.parameters[network.index("mechanisms.belt.power")]
    assert power.value == pytest.approx(156.0, rel=0.05) and power.prior_value == 120.0
    assert part.calibrated is not None and part.calibrated.batches == ("b00", "b01", "b02")
    assert set(part.calibrated.left_out_rms) == {"t_shaft_K", "t_head_K", "z_um"}
    page = (folder / "new.html").read_text(encoding="utf-8")
    assert "new.html: pictures" in done.out and "SIMULATED" in page.upper() and "Simulated against recorded" in page
    again = call()  # what stands there is not overwritten unasked
    assert again.code == 2 and "new.yml: exists; give another file" in again.err


def test_json_is_clean_and_the_lake_is_the_default(folder: Path, call: Call) -> None:
    assert call("--recordings", folder / "in", "--no-leave-out", "--no-report").code == 0
    done = call("--batches", "b00,b02", "--no-leave-out", "--no-report", "--overwrite", "--json")
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert told["batches"] == ["b00", "b02"] and told["simulated"] and told["left_out"] is None
    assert told["fit"]["converged"] and {p["name"] for p in told["parameters"]} >= {"mechanisms.belt.power"}
    low, high = told["parameters"][0]["interval90"]
    assert low < told["parameters"][0]["value"] < high


def test_a_fit_that_fails_leaves_the_file_untouched(folder: Path, call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder / "new.yml").write_text("what stood there", encoding="utf-8")
    from twin.calibration import estimate

    def impatient(problem, options, *more):  # type: ignore[no-untyped-def]
        return real(problem, replace(options, max_iterations=1, tolerance=1e-15), *more)

    real = estimate.fit
    monkeypatch.setattr(estimate, "fit", impatient)
    done = call("--recordings", folder / "in", "--overwrite", "--no-leave-out", "--no-report")
    assert done.code == 1
    assert "calibration of two_bodies: stopped after" in done.err and done.err.count("Traceback") == 0
    assert (folder / "new.yml").read_text(encoding="utf-8") == "what stood there"


def test_bad_input_is_one_line_and_exit_code_2(folder: Path, call: Call) -> None:
    cases = [
        (("--recordings", folder / "absent"), "absent: no such file or folder"),
        (("--starts", "0"), "--starts: got 0, expected 1 or more"),
        ((), "two_bodies"),  # an empty lake
    ]
    for args, words in cases:
        done = call(*args)
        assert done.code == 2 and words in done.err and len(done.err.strip().splitlines()) == 1, (args, done.err)
    call("--recordings", folder / "in", "--no-leave-out", "--no-report")
    done = call("--batches", "b0", "--overwrite")
    assert done.code == 2 and "--batches: no batch 'b0' of two_bodies; did you mean" in done.err
