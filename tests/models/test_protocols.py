"""Folds: what is trained on and what is tested."""

from dataclasses import replace

import numpy as np
import pytest

from data.errors import InputError
from models.protocols import PROTOCOLS, folds_of, leave_batch_out, season, speed, train_on_one


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_training_and_test_never_overlap_and_every_batch_is_tested(protocol, toy_batches) -> None:
    batches = toy_batches(9)
    folds = folds_of(protocol, batches)
    assert folds
    for fold in folds:
        assert fold.train and not set(fold.train) & set(fold.test)
        assert set(fold.train) | set(fold.test) <= set(range(9))
    assert {i for f in folds for i in f.test} == set(range(9))


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
