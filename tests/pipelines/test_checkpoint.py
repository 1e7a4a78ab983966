"""An interrupted crossing is taken up where it stopped, and never where anything that decides its numbers changed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from models.crossing import Crossing, FamilyResult, Plan, cross_family, prepare
from pipelines.checkpoint import Checkpoint
from tests.toys.training import toy_batches

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
    work = Checkpoint(tmp_path, {"z": made}).crossed(counting(made, first, stop_at="gm1n"))
    work(("z", "zero"))
    before = work(("z", "mlr"))
    with pytest.raises(Interrupted):
        work(("z", "gm1n"))
    second: list[str] = []
    again = Checkpoint(tmp_path, {"z": crossing()})
    results = {f: again.crossed(counting(made, second))(("z", f)) for f in PLAN.families}
    assert (first, second) == (["zero", "mlr"], ["gm1n"])
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
    Checkpoint(tmp_path, {"z": made}).crossed(lambda job: kept)(("z", "mlr"))
    back = Checkpoint(tmp_path, {"z": made}).crossed(counting(made, []))(("z", "mlr"))
    assert back.failures == kept.failures and back.scores.empty and back.cells.empty


@pytest.mark.parametrize("what", ["plan", "recording"])
def test_another_plan_or_recording_starts_anew(what: str, tmp_path: Path) -> None:
    made = crossing()
    Checkpoint(tmp_path, {"z": made}).crossed(counting(made, []))(("z", "zero"))
    if what == "plan":
        other = crossing(n_tsps=(2,))
    else:
        y = made.design.y_um.copy()
        y[5] += 1e-9
        other = replace(made, design=replace(made.design, y_um=y))
    calls: list[str] = []
    Checkpoint(tmp_path, {"z": other}).crossed(counting(other, calls))(("z", "zero"))
    assert calls == ["zero"]
