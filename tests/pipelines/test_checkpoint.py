"""An interrupted crossing is taken up where it stopped, and never where anything that decides its numbers changed."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from models.selection.crossing import Crossing, FamilyResult, Plan, prepare
from models.selection.race import Job, rounds
from pipelines.store.checkpoint import Checkpoint
from tests.toys.training import toy_batches

PLAN = Plan(("none", "correlation"), ("zero", "mlr", "gm1n"), ("leave-batch-out", "train-on-one"))


class Interrupted(Exception):
    pass


def crossing(**changes: object) -> Crossing:
    return prepare(toy_batches("toy-unfinished", 4), "z", replace(PLAN, **changes))  # type: ignore[arg-type]


JOBS = next(rounds(crossing()))


def counting(made: Crossing, calls: list[str], stop_at: str = ""):
    def cross(job: Job) -> FamilyResult:
        if job.family == stop_at:
            raise Interrupted
        calls.append(job.family)
        return job.run(made)

    return cross


def test_what_was_crossed_is_read_and_the_rest_is_crossed(tmp_path: Path) -> None:
    zero, mlr, gm1n = JOBS
    first: list[str] = []
    checkpoint = Checkpoint(tmp_path, {"z": crossing()})
    said: list[str] = []
    checkpoint.resume(said.append)
    work = checkpoint.crossed(counting(crossing(), first, stop_at="gm1n"))
    work(zero)
    before = work(mlr)
    with pytest.raises(Interrupted):
        work(gm1n)
    assert checkpoint.summary().startswith(f"2 finished parts of the crossing kept in {tmp_path}")
    again = Checkpoint(tmp_path, {"z": crossing()})
    again.resume(said.append)
    assert [re.sub(r"20\d\d-\d\d-\d\d \d\d:\d\d", "WHEN", s) for s in said] == [
        "resumes: 2 finished parts of the crossing were crossed on WHEN"
    ]
    work = again.crossed(counting(crossing(), first))
    results = {job.family: work(job) for job in JOBS}
    assert first == ["zero", "mlr", "gm1n"]
    pd.testing.assert_frame_equal(results["mlr"].scores, before.scores)
    pd.testing.assert_frame_equal(results["mlr"].cells, before.cells)
    assert set(results["mlr"].predictions) == set(before.predictions)
    for name, values in before.predictions.items():
        np.testing.assert_array_equal(results["mlr"].predictions[name], values)
    again.remove()
    assert list(tmp_path.iterdir()) == []


def test_failures_are_kept_too(tmp_path: Path) -> None:
    kept = FamilyResult(pd.DataFrame(), pd.DataFrame(), {}, [("family mlr", "2 points: too few rows")])
    checkpoint = Checkpoint(tmp_path, {"z": crossing()})
    checkpoint.crossed(lambda job: kept)(JOBS[1])
    back = checkpoint.crossed(counting(crossing(), [], stop_at="mlr"))(JOBS[1])
    assert back.failures == kept.failures and back.scores.empty and back.cells.empty


@pytest.mark.parametrize("what", ["plan", "recording"])
def test_another_plan_or_recording_starts_anew(what: str, tmp_path: Path) -> None:
    made = crossing()
    calls: list[str] = []
    Checkpoint(tmp_path, {"z": made}).crossed(counting(made, calls))(JOBS[0])
    if what == "plan":
        other = crossing(n_tsps=(2,))
    else:
        y = made.design.y_um.copy()
        y[5] += 1e-9
        other = replace(made, design=replace(made.design, y_um=y))
    Checkpoint(tmp_path, {"z": made}).crossed(counting(made, calls))(JOBS[0])
    assert calls == ["zero"]
    Checkpoint(tmp_path, {"z": other}).crossed(counting(other, calls))(JOBS[0])
    assert calls == ["zero", "zero"]


@pytest.mark.parametrize("name", ["scores.parquet", "cells.parquet", "predictions.npz", "failures.json", "sums.json"])
@pytest.mark.parametrize("how", ["cut", "changed", "removed"])
def test_a_damaged_file_is_reported_and_crossed_again(name: str, how: str, tmp_path: Path) -> None:
    made = crossing()
    calls: list[str] = []
    said: list[str] = []
    work = Checkpoint(tmp_path, {"z": made}).crossed(counting(made, calls), said.append)
    work(JOBS[0])
    work(JOBS[1])
    (file,) = tmp_path.glob(f"*/z__mlr/{name}")
    content = file.read_bytes()
    middle = len(content) // 2
    file.write_bytes(content[:middle] if how == "cut" else content[:middle] + b"?" + content[middle + 1 :])
    if how == "removed":
        file.unlink()
    work(JOBS[0])
    assert calls == ["zero", "mlr"] and said == []
    work(JOBS[1])
    assert said[0].startswith(f"{file.parent}: is damaged (") and said[0].endswith("); z mlr is crossed again")
    work(JOBS[1])
    assert calls == ["zero", "mlr", "mlr"] and len(said) == 1
