"""Few runs are cut into blocks that are left out in turn; nothing of the recordings is lost or moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from data.batch import Batch, Finding
from data.errors import InputError
from diagnosis.fitting.batches import coarse, enough_batches, spacing_s, usable_batches
from diagnosis.fitting.fitted import baseline
from diagnosis.policy import POLICY
from tests.diagnosis.small_cases import runs, two_bodies
from tests.twin.recordings import empty_batches
from twin.compile import compile_network
from twin.schema import twin_part
from twin.simulation.inputs import inputs_of


def some(count: int) -> list[Batch]:
    return runs(two_bodies(), count=count)


def test_enough_batches_stay_as_they_are() -> None:
    given = some(4)
    assert enough_batches(given) == (given, ())


@pytest.mark.parametrize(("count", "blocks"), [(1, 2), (2, 4), (3, 6)])
def test_fewer_are_cut_as_far_as_their_rows_allow(count: int, blocks: int) -> None:
    given = some(count)
    assert given[0].n_rows == 49  # two blocks of 24 rows or more
    out, words = enough_batches(given)
    assert len(out) == blocks
    assert min(b.n_rows for b in out) >= POLICY.min_block_rows
    assert [b.batch_id for b in out] == [f"b{k:02d}_{n}" for k in range(count) for n in (1, 2)]
    (told,) = words
    assert told.startswith(f"{count} run{'s' if count > 1 else ''} only: cut into {blocks} blocks")


def test_a_long_run_gives_four_blocks() -> None:
    (long,) = some(1)
    table = pd.concat([long.table] * 4, ignore_index=True)
    table["time_s"] = long.step_s * np.arange(len(table))
    out, _ = enough_batches([replace(long, table=table)])
    assert len(out) == POLICY.min_batches


def test_blocks_hold_the_same_rows_at_the_same_time_of_day() -> None:
    (given,) = some(1)
    out, _ = enough_batches([given])
    again = pd.concat([b.table for b in out], ignore_index=True)
    pd.testing.assert_frame_equal(again.drop(columns="time_s"), given.table.drop(columns="time_s"))
    at = 0
    for b in out:
        assert b.time_s[0] == 0.0 and b.step_s == given.step_s
        assert given.start is not None and b.start == given.start + pd.Timedelta(seconds=float(given.time_s[at]))
        at += b.n_rows
    assert (out[0].machine, out[0].channels, out[0].simulated) == (given.machine, given.channels, given.simulated)


def test_what_was_masked_stays_masked() -> None:
    (given,) = some(1)
    masks = (
        Finding("stuck", "t_head", "in the first half", 600.0, 1800.0),
        Finding("jump", "t_shaft", "in the second", 9000.0, 9900.0),
        Finding("gap", "z", "across the cut", 6600.0, 8100.0),
        Finding("noise", "room", "from then on", 12000.0, None),
    )
    masked = replace(given, findings=masks)
    out, _ = enough_batches([masked])
    for channel in ("t_head", "t_shaft", "z", "room"):
        np.testing.assert_array_equal(np.concatenate([b.masked(channel) for b in out]), masked.masked(channel))


def test_a_run_too_short_to_cut_stays_whole() -> None:
    (given,) = some(1)
    short = replace(given, table=given.table.iloc[:30])
    out, words = enough_batches([short])
    assert out == [short] and words[0].startswith("1 run only: cut into 1 block")


def with_hole(batch: Batch) -> Batch:
    """Without the room's temperature for twenty minutes."""
    table = batch.table.copy()
    table.loc[(table["time_s"] > 1200) & (table["time_s"] < 2400 + 300), "room"] = np.nan
    return replace(batch, table=table)


def test_a_hole_that_cannot_be_bridged_costs_its_run_alone() -> None:
    known = two_bodies()
    network = compile_network(known)
    every = runs(known, count=6)
    given = [with_hole(every[0]), *every[1:]]
    kept, words = usable_batches(network, given)
    assert [b.batch_id for b in kept] == [b.batch_id for b in every[1:]]
    assert len(words) == 1
    assert words[0].startswith(f"left out: batch {every[0].batch_id}: channel 'room' has no value from ")
    assert usable_batches(network, every) == (every, ())


def test_a_hole_that_is_too_long_on_the_rows_that_are_fitted_costs_its_run_alone() -> None:
    def every_minute(batch: Batch) -> Batch:
        time_s = np.arange(0.0, batch.time_s[-1] + 1.0, 60.0)
        table = pd.DataFrame({c: np.interp(time_s, batch.time_s, batch.table[c]) for c in batch.table.columns})
        return replace(batch, table=table)

    known = two_bodies()
    every = [every_minute(b) for b in runs(known, count=6)]
    table = every[0].table.copy()
    table.loc[(table["time_s"] >= 1440) & (table["time_s"] < 1440 + 900), "room"] = np.nan  # bridged as it is recorded
    given = [replace(every[0], table=table), *every[1:]]
    assert len(inputs_of(compile_network(known), given).batch_ids) == 6
    kept, (words,) = usable_batches(compile_network(known), given)
    assert [b.batch_id for b in kept] == [b.batch_id for b in every[1:]] and words.startswith("left out: batch b00: ")
    baseline(known, twin_part(known), kept)


def test_where_few_are_left_the_first_hole_is_told() -> None:
    known = two_bodies()
    every = runs(known, count=6)
    for holes in (3, 6):
        given = [with_hole(b) if k < holes else b for k, b in enumerate(every)]
        with pytest.raises(InputError, match=f"^batch {every[0].batch_id}: channel 'room' has no value from "):
            usable_batches(compile_network(known), given)


# Rows that are fitted


def fine() -> list[Batch]:
    """A run of 4 h with a row a minute whose speed changes at any row."""
    (b,) = empty_batches(two_bodies(), 1, step_s=60.0)
    rng = np.random.default_rng(0)
    return [replace(b, table=b.table.assign(rpm=1000.0 * rng.integers(0, 5, b.n_rows)))]


def test_thinned_rows_show_what_they_did_and_between_them_the_mean_acts() -> None:
    (given,), (thin,) = fine(), coarse(fine(), 300.0)
    assert thin.n_rows == 49 and thin.step_s == 300.0
    pd.testing.assert_frame_equal(thin.table, given.table.iloc[::5].reset_index(drop=True))
    inputs = inputs_of(compile_network(two_bodies()), [thin])
    np.testing.assert_allclose(inputs.drivers["rpm"][0], given.values("rpm")[:-1].reshape(48, 5).mean(axis=1))
    np.testing.assert_array_equal(inputs.at_rows["rpm"][0], given.values("rpm")[::5])


@pytest.mark.parametrize("lead_rows", [0.5, 1.0])
def test_with_a_lead_the_mean_is_that_of_what_acted_on_the_rows_as_given(lead_rows: float) -> None:
    (given,), (thin,) = fine(), coarse(fine(), 300.0, lead_rows)
    rpm = given.values("rpm")
    acted = (1.0 - lead_rows) * rpm[:-1] + lead_rows * rpm[1:]
    np.testing.assert_allclose(thin.held["rpm"][:-1], acted.reshape(48, 5).mean(axis=1))
    np.testing.assert_array_equal(thin.values("rpm"), rpm[::5])


def test_rows_that_are_far_apart_already_stay() -> None:
    (b,) = given = empty_batches(two_bodies(), 1)
    (same,) = coarse(given, 300.0)
    assert same is b and not same.held
    (led,) = coarse(given, 300.0, 1.0)
    assert led.table is b.table
    np.testing.assert_array_equal(led.held["rpm"], np.append(b.values("rpm")[1:], b.values("rpm")[-1]))


def test_spacing_leaves_rows_enough_of_a_short_run() -> None:
    assert spacing_s(fine()) == 241 * 60.0 / POLICY.min_rows_per_batch
    assert spacing_s(empty_batches(two_bodies(), 1, hours=8.0)) == 300.0
    assert spacing_s(empty_batches(two_bodies(), 1, hours=0.1, step_s=5.0)) == 73 * 5.0 / POLICY.min_rows_per_batch
