"""Folds: what is trained on and what is tested."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch
from data.errors import InputError
from models.protocols import PROTOCOLS, folds_of, forward_obstacle, leave_batch_out, placed, season, speed, train_on_one

FORWARD = ("forward", "forward-gap")


@pytest.mark.parametrize("protocol", [p for p in PROTOCOLS if p not in FORWARD])
def test_training_and_test_never_overlap_and_every_batch_is_tested(protocol, toy_batches) -> None:
    batches = toy_batches(9)
    folds = folds_of(protocol, batches)
    assert folds
    for fold in folds:
        assert fold.train and not set(fold.train) & set(fold.test)
        assert set(fold.train) | set(fold.test) <= set(range(9))
    assert {i for f in folds for i in f.test} == set(range(9))


def dated(batches: list[Batch], *days: int) -> list[Batch]:
    """Starts so many days after the first of the year."""
    first = pd.Timestamp("2026-01-01 08:00")
    return [replace(b, start=first + pd.Timedelta(days=d)) for b, d in zip(batches, days, strict=True)]


def test_forward_predicts_later_runs_from_earlier_ones(toy_batches) -> None:
    """Batches 9 … 0 in order of time: the first five train, then blocks of one."""
    batches = dated(toy_batches(10), *range(90, -10, -10))
    folds = folds_of("forward", batches)
    assert [f.test for f in folds] == [(4,), (3,), (2,), (1,), (0,)]
    assert [sorted(f.train) for f in folds] == [list(range(k + 1, 10)) for k in (4, 3, 2, 1, 0)]
    assert folds[0].name == "2026-02-20"


def test_forward_blocks_are_equal_and_their_names_unique(toy_batches) -> None:
    folds = folds_of("forward", dated(toy_batches(24), *range(0, 240, 10)))
    assert [len(f.test) for f in folds] == [3, 3, 3, 3] and len(folds[0].train) == 12
    same_day = folds_of("forward", dated(toy_batches(8), *[0] * 8))
    assert len({f.name for f in same_day}) == 4


def test_a_gap_leaves_out_the_weeks_before_the_block(toy_batches) -> None:
    batches = dated(toy_batches(10), *range(0, 100, 10))
    for near, far in zip(folds_of("forward", batches), folds_of("forward-gap", batches), strict=True):
        assert near.test == far.test
        start = batches[far.test[0]].start
        assert set(far.train) == {k for k in near.train if batches[k].start <= start - pd.Timedelta(days=28)}
        assert len(far.train) < len(near.train)


def test_without_dates_forward_is_not_offered_unless_one_recording_gives_the_order(toy_batches) -> None:
    undated = [replace(b, start=None, source=f"{i}.csv") for i, b in enumerate(toy_batches(9))]
    assert folds_of("forward", undated) == []
    assert forward_obstacle(undated).startswith(
        f"9 of 9 batches have no start time (first: {undated[0].batch_id}); give"
    )
    assert folds_of("leave-season-out", undated) == [] != folds_of("leave-season-out", toy_batches(9))
    parts = [replace(b, source="one.csv") for b in undated]
    assert [f.test for f in folds_of("forward", parts)] == [(4,), (5,), (6,), (7,), (8,)]
    assert folds_of("forward-gap", parts) == []
    assert forward_obstacle(parts[:5]) == "only 5 batches, need at least 6"


def test_a_stated_order_makes_forward_validation_of_undated_runs(toy_batches) -> None:
    runs = [replace(b, batch_id=f"run {i + 1}", start=None, source=f"{i}.csv") for i, b in enumerate(toy_batches(12))]
    later = [runs[i].batch_id for f in folds_of("forward", placed(runs, "name")) for i in f.test]
    assert later == [f"run {i}" for i in range(7, 13)]  # run 10 after run 9
    ids = [b.batch_id for b in runs]
    last = folds_of("forward", placed(runs, ids[::-1]))[-1]
    assert [runs[i].batch_id for i in last.test] == ["run 1"] and 11 in last.train
    with pytest.raises(InputError, match=r"recording\.order lacks run 12; name each of the 12 batches once"):
        placed(runs, ids[:-1])
    with pytest.raises(InputError, match=r"recording\.order repeats run 1;"):
        placed(runs, [*ids, "run 1"])


def test_train_on_one_mirrors_leave_batch_out(toy_batches) -> None:
    batches = toy_batches(4)
    for one, out in zip(train_on_one(batches), leave_batch_out(batches), strict=True):
        assert (one.train, one.test) == (out.test, out.train)


def test_leave_speed_out_leaves_whole_speeds(toy_batches) -> None:
    batches = toy_batches(9)
    for fold in folds_of("leave-speed-out", batches):
        assert {speed(batches[i]) for i in fold.test} == {fold.name}
        assert fold.name not in {speed(batches[i]) for i in fold.train}


def test_season_is_told_by_the_start_ambient(toy_batches) -> None:
    batches = toy_batches(6)
    assert season(batches[0]) == "below 10 °C" and season(batches[-1]) == "above 25 °C"


def test_several_speeds_are_a_group_of_their_own(toy_batches) -> None:
    batch = toy_batches(1)[0]
    table = batch.table.copy()
    table["spindle_rpm"] = np.where(np.arange(len(table)) < 30, 1500.0, 3000.0)
    assert speed(replace(batch, table=table)) == "several speeds"


def test_one_group_has_nothing_to_leave_out_and_one_batch_is_refused(toy_batches) -> None:
    same = [b for b in toy_batches(6) if speed(b) == "2000 rpm"]
    assert folds_of("leave-speed-out", same) == []
    with pytest.raises(InputError, match=r"leave-batch-out: got 1 batch\(es\), need at least 2"):
        folds_of("leave-batch-out", same[:1])
