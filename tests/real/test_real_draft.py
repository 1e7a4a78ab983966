"""Networks drafted from real recordings: better than nothing moving, worse than what an engineer wrote by hand."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import pytest

from data.batch import Batch
from data.checks import check_batch, check_machine
from data.machine import Machine, load_machine
from data.recording import read_batches, recording_files
from diagnosis.drafting.draft import Drafted, drafted_part
from diagnosis.drafting.groups import rows_of
from twin.calibration.estimate import free_running_rms
from twin.calibration.problem import CalibrationProblem
from twin.compile import compile_network

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
STEP_S = {"spindle_fl": 60.0, "lathe_gv1203": 300.0}


@cache
def recorded(name: str) -> tuple[Machine, list[Batch]]:
    """Machine file on a grid of its own and every run."""
    if not (DATA / name).is_dir():
        pytest.skip(f"no ../shared/data/{name}")
    given = load_machine(ROOT / "machines" / f"{name}.yml")
    machine = given.model_copy(update={"recording": given.recording.model_copy(update={"step_s": STEP_S[name]})})
    files, _ = recording_files(DATA / name, machine)
    found = [b for f in files for b in read_batches(f, machine)]
    return machine, check_machine([b.with_findings(check_batch(b, machine)) for b in found], machine)


@cache
def drafted(name: str, max_bodies: int) -> Drafted:
    machine, batches = recorded(name)
    return drafted_part(machine.model_copy(update={"twin": None}), batches, max_bodies=max_bodies)


def rms(found: Drafted, column: str) -> dict[str, float]:
    return dict(zip(found.left_out["channel"].tolist(), found.left_out[column].astype(float).tolist(), strict=True))


def geometric_mean(ratios: list[float]) -> float:
    return math.exp(sum(math.log(r) for r in ratios) / len(ratios))


@pytest.mark.slow
def test_spindle_fl_needs_several_bodies_and_one_heat() -> None:
    found = drafted("spindle_fl", 5)
    machine, _ = recorded("spindle_fl")
    assert 3 <= len(found.part.bodies) <= 5 and set(found.part.mechanisms) == {"heat_of_spindle_rpm"}
    assert set(found.part.sensors) == set(machine.names("temperature"))
    assert found.part.surroundings["room"].channel == "t16"
    left, zero = rms(found, "left_out"), rms(found, "zero")
    assert all(left[c] < zero[c] for c in left)
    assert geometric_mean([left[c] / zero[c] for c in left]) < 0.5


def test_spindle_fl_states_the_noise_that_the_file_does_not() -> None:
    noise = rms(drafted("spindle_fl", 5), "noise")
    assert all(0.01 <= v < 0.03 for c, v in noise.items() if c.startswith("t"))
    assert all(s.noise is not None for s in drafted("spindle_fl", 5).part.sensors.values())


@pytest.mark.slow
def test_lathe_drafted_lies_between_nothing_and_the_twin_that_was_written_for_it() -> None:
    found = drafted("lathe_gv1203", 4)
    machine, batches = recorded("lathe_gv1203")
    left, zero = rms(found, "left_out"), rms(found, "zero")
    assert all(left[c] < zero[c] for c in left)
    own = CalibrationProblem.of(
        compile_network(machine), rows_of(machine, batches).batches, every_s=STEP_S["lathe_gv1203"]
    )
    by_batch = free_running_rms(own, own.network.values)
    written = {
        c: sum(b[k] for b in by_batch if k in b) / sum(k in b for b in by_batch) for k, c in enumerate(own.channels)
    }
    assert geometric_mean([left[c] / zero[c] for c in left]) < 0.25
    assert 1.0 < geometric_mean([left[c] / written[c] for c in left]) < 4.0


@pytest.mark.slow
def test_lathe_heats_grow_with_speed_and_feed() -> None:
    part = drafted("lathe_gv1203", 4).part
    assert {m.law for m in part.mechanisms.values()} == {"belt_loss", "guide_friction"}
    at = {n: s.at for n, s in part.sensors.items()}
    assert at["PT07"] == at["PT11"]  # the bed's two sensors
    assert at["spindle_motor"] not in {at["PT07"], at["PT12"]}
