"""An interrupted crossing is taken up where it stopped, and never where anything that decides its numbers changed."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from models.crossing import Crossing, FamilyResult, Plan, cross_family, prepare
from pipelines.checkpoint import Checkpoint
from tests.toys.training import toy_batches

JOBS = [("z", f) for f in ("zero", "mlr", "gm1n")]
PLAN = Plan(("none", "correlation"), ("zero", "mlr", "gm1n"), ("leave-batch-out", "train-on-one"))


class Interrupted(Exception):
    pass


def crossing(**changes: object) -> Crossing:
    return prepare(toy_batches("toy-unfinished", 4), "z", replace(PLAN, **changes))  # type: ignore[arg-type]


def counting(made: Crossing, calls: list[str], stop_at: str = ""):
    def cross(job: tuple[str, str]) -> FamilyResult:
        if job[1] == stop_at:
            raise Interrupted
        calls.append(job[1])
        return cross_family(made, job[1])

    return cross


def test_what_was_crossed_is_read_and_the_rest_is_crossed(tmp_path: Path) -> None:
    made = crossing()
    first: list[str] = []
    checkpoint = Checkpoint(tmp_path, {"z": made}, JOBS)
    assert checkpoint.kept() == {}
    work = checkpoint.crossed(counting(made, first, stop_at="gm1n"))
    work(("z", "zero"))
    before = work(("z", "mlr"))
    with pytest.raises(Interrupted):
        work(("z", "gm1n"))
    assert checkpoint.summary().startswith(f"2 of 3 families are kept in {tmp_path}")
    said: list[str] = []
    again = Checkpoint(tmp_path, {"z": crossing()}, JOBS)
    kept = again.kept(said.append)
    assert first == ["zero", "mlr"] and list(kept) == JOBS[:2]
    assert [re.sub(r"20\d\d-\d\d-\d\d \d\d:\d\d", "WHEN", s) for s in said] == [
        "resumes: 2 of 3 families were crossed on WHEN"
    ]
    results = {family: result for (_, family), result in kept.items()}
    pd.testing.assert_frame_equal(results["mlr"].scores, before.scores)
    pd.testing.assert_frame_equal(results["mlr"].cells, before.cells)
    assert set(results["mlr"].predictions) == set(before.predictions)
    for name, values in before.predictions.items():
        np.testing.assert_array_equal(results["mlr"].predictions[name], values)
    again.remove()
    assert list(tmp_path.iterdir()) == []


def test_failures_are_kept_too(tmp_path: Path) -> None:
    kept = FamilyResult(pd.DataFrame(), pd.DataFrame(), {}, [("family mlr", "2 points: too few rows")])
    made = crossing()
    checkpoint = Checkpoint(tmp_path, {"z": made}, JOBS)
    checkpoint.crossed(lambda job: kept)(("z", "mlr"))
    back = checkpoint.kept()["z", "mlr"]
    assert back.failures == kept.failures and back.scores.empty and back.cells.empty


@pytest.mark.parametrize("what", ["plan", "recording"])
def test_another_plan_or_recording_starts_anew(what: str, tmp_path: Path) -> None:
    made = crossing()
    first = Checkpoint(tmp_path, {"z": made}, JOBS)
    first.crossed(counting(made, []))(("z", "zero"))
    if what == "plan":
        other = crossing(n_tsps=(2,))
    else:
        y = made.design.y_um.copy()
        y[5] += 1e-9
        other = replace(made, design=replace(made.design, y_um=y))
    assert list(first.kept()) == JOBS[:1] and Checkpoint(tmp_path, {"z": other}, JOBS).kept() == {}


@pytest.mark.parametrize("name", ["scores.parquet", "cells.parquet", "predictions.npz", "failures.json", "sums.json"])
@pytest.mark.parametrize("how", ["cut", "changed", "removed"])
def test_a_damaged_file_is_reported_and_crossed_again(name: str, how: str, tmp_path: Path) -> None:
    made = crossing()
    checkpoint = Checkpoint(tmp_path, {"z": made}, JOBS)
    work = checkpoint.crossed(counting(made, []))
    work(JOBS[0])
    work(JOBS[1])
    (file,) = tmp_path.glob(f"*/z__mlr/{name}")
    content = file.read_bytes()
    middle = len(content) // 2
    file.write_bytes(content[:middle] if how == "cut" else content[:middle] + b"?" + content[middle + 1 :])
    if how == "removed":
        file.unlink()
    said: list[str] = []
    assert list(checkpoint.kept(said.append)) == JOBS[:1]
    assert said[0].startswith(f"{file.parent}: is damaged (") and said[0].endswith("); z mlr is crossed again")
    assert said[1].startswith("resumes: 1 of 3 families were") and len(said) == 2
    work(JOBS[1])
    assert list(checkpoint.kept()) == JOBS[:2]


def test_families_of_several_channels_are_counted_together(tmp_path: Path) -> None:
    made = crossing()
    jobs = [(t, f) for _, f in JOBS for t in ("x", "z")]
    text = Checkpoint(tmp_path, {"x": made, "z": made}, jobs).summary()
    assert text.startswith("0 of 6 families (of 2 error channels) are kept in ")
