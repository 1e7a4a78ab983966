"""The known faults of two real machines are found by the checks alone, and nothing else is masked."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from data.batch import Batch
from data.checks import check_machine, checked, usable_channels
from data.machine import load_machine
from data.recording import read_batches

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
LATHE, SPINDLE = DATA / "lathe_gv1203", DATA / "spindle_fl"
HELD_AFTER_THE_RUN = {
    "20200616", "20200617", "20200618", "20200701", "20200702", "20200703", "20200706", "20200727", "20200729",
    "20200730", "20200805", "20200820", "20200821", "20200824", "20200902", "20200903", "20200904",
}  # fmt: skip
HELD_AT_THE_STOP = {"20200723", "20200810"}


def known(folder: Path, pattern: str, name: str) -> list[Batch]:
    machine = load_machine(ROOT / "machines" / f"{name}.yml")
    batches = [b for f in sorted(folder.glob(pattern)) for b in read_batches(f, machine)]
    return check_machine([checked(b, machine) for b in batches], machine)


@pytest.fixture(scope="module")
def lathe() -> dict[str, Batch]:
    if not LATHE.is_dir():
        pytest.skip("no ../shared/data/lathe_gv1203")
    return {b.batch_id: b for b in known(LATHE, "20*.csv", "lathe_gv1203")}


def test_the_lathe_has_these_faults_and_no_others(lathe: dict[str, Batch]) -> None:
    told = {(b, f.check, f.channel) for b, batch in lathe.items() for f in batch.findings}
    held = {(b, "error_held", c) for b in HELD_AFTER_THE_RUN | HELD_AT_THE_STOP for c in ("disp_x", "disp_z")}
    later = ("20200824", "20200827", "20200828", "20200901", "20200902", "20200903", "20200904")
    assert told == held | {(b, "offset", "PT10") for b in later} | {
        ("20200706", "interruption", "disp_x"),
        ("20200706", "interruption", "disp_z"),
        ("20200706", "saturated", "disp_z"),
        ("20200821", "jump_no_return", "PT10"),
        ("20200821", "unexplained", "disp_x"),
    }
    assert not any(f.masks for b in lathe.values() for f in b.findings if f.check == "unexplained")


def test_when_the_faults_of_the_lathe_are(lathe: dict[str, Batch]) -> None:
    start = {(f.check, f.channel): f.start_s or 0.0 for f in lathe["20200706"].findings}
    assert 324 < start["interruption", "disp_x"] / 60 < 330  # minutes from the first row
    assert 327 < start["saturated", "disp_z"] / 60 < 331
    jump = next(f for f in lathe["20200821"].findings if f.channel == "PT10")
    assert 118 < (jump.start_s or 0.0) / 60 < 135 and jump.end_s is None
    for batch_id in HELD_AFTER_THE_RUN:
        held = next(f for f in lathe[batch_id].findings if f.check == "error_held")
        assert 297 <= (held.start_s or 0.0) / 60 <= 303, batch_id
    for batch_id in HELD_AT_THE_STOP:
        held = next(f for f in lathe[batch_id].findings if f.check == "error_held")
        assert 148 <= (held.start_s or 0.0) / 60 <= 153 and 206 <= (held.end_s or 0.0) / 60 <= 211, batch_id


def test_one_sensor_of_the_lathe_is_no_input(lathe: dict[str, Batch]) -> None:
    batches = list(lathe.values())
    usable, excluded = usable_channels(batches, batches[0].names("temperature", "ambient"))
    assert [name for name, _ in excluded] == ["PT10"] and len(usable) == 23
    assert "20200821" in excluded[0][1]
    assert all(np.isfinite(b.masked("disp_z")).sum() > 100 for b in batches)


def test_the_spindle_recording_is_clean() -> None:
    if not SPINDLE.is_dir():
        pytest.skip("no ../shared/data/spindle_fl")
    batches = known(SPINDLE, "*.csv", "spindle_fl")
    assert len(batches) == 6
    assert [f.message for b in batches for f in b.findings] == []


@pytest.mark.slow
def test_minutes_read_as_seconds_are_named_and_mask_no_good_sensor_of_the_lathe() -> None:
    """X is masked in a run where the recorder held it, and let it go within a row: a step at any rate."""
    if not LATHE.is_dir():
        pytest.skip("no ../shared/data/lathe_gv1203")
    given = load_machine(ROOT / "machines" / "lathe_gv1203.yml")
    time = given.recording.time.model_copy(update={"unit": "s"})
    recording = given.recording.model_copy(update={"time": time, "step_s": 1.0, "max_gap_s": 5.0})
    machine = given.model_copy(update={"recording": recording})
    found = [checked(b, machine) for f in sorted(LATHE.glob("20*.csv")) for b in read_batches(f, machine)]
    batches = check_machine(found, machine)
    masked = {(b.batch_id, f.channel) for b in batches for f in b.findings if f.masks and f.check == "jump_no_return"}
    assert masked == {("20200821", "PT10"), ("20200723", "disp_x")} and "20200723" in HELD_AT_THE_STOP
    named = [[f.message for f in b.findings if f.check == "clock"] for b in batches]
    assert all("recording.time.unit: s gives" in m and "min would not" in m for (m,) in named) and len(named) == 32
