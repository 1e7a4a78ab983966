"""The trained region: inside, at its edge, outside, and how far."""

from dataclasses import replace

import numpy as np
import pytest

from models.selection.trust import PATTERN, Region, watched


def test_training_batches_are_inside_their_own_region(toy_batches) -> None:
    batches = toy_batches(4)
    region = Region.of(batches, ["t0", "room"])
    assert set(region.ranges) == {"t0", "room", "t0@start", "room@start", "spindle_rpm"}
    assert region.ranges["spindle_rpm"] == (2000.0, 6000.0)
    for b in batches:
        assert not any(rows.any() for rows in region.outside(b, ["t0", "room"]).values())
        assert region.distance(watched(b, ["t0", "room"])).max() < 1e-9


@pytest.mark.parametrize(
    ("channel", "shift", "flagged"), [("t0", 40.0, "t0@start"), ("spindle_rpm", 9000.0, "spindle_rpm")]
)
def test_colder_warmer_or_faster_says_so(channel, shift, flagged, toy_batches) -> None:
    batches = toy_batches(4)
    region = Region.of(batches, ["t0"])
    table = batches[0].table.copy()
    table[channel] = table[channel] + shift
    rows = region.outside(replace(batches[0], table=table), ["t0"])
    assert rows[flagged].all()
    assert not np.any(rows["t0"])


def test_distance_counts_trained_widths(toy_batches) -> None:
    batches = toy_batches(4)
    region = Region.of(batches, ["t0"])
    low, high = region.ranges["spindle_rpm"]
    table = batches[0].table.assign(spindle_rpm=high + 0.5 * (high - low))
    values = watched(replace(batches[0], table=table), ["t0"])
    assert region.distance(values) == pytest.approx(0.5)
    assert region.beyond(values)["t0"].max() == 0


def test_a_narrow_range_is_no_wall(toy_batches) -> None:
    (batch, *_) = toy_batches(1)
    constant = replace(batch, table=batch.table.assign(spindle_rpm=4000.0))
    region = Region.of([constant], ["t0"])
    faster = replace(batch, table=batch.table.assign(spindle_rpm=4500.0))
    assert region.beyond(watched(faster, ["t0"]))["spindle_rpm"] == pytest.approx(0.5)  # of 1000 rpm


def test_a_replaced_sensor_is_far_outside_though_each_value_was_seen_before(toy_batches) -> None:
    batches = toy_batches(6)
    inputs = ["t0", "t1", "t2"]
    region = Region.of(batches, inputs)
    table = batches[0].table.copy()
    table["t1"] = table["t1"].to_numpy()[::-1]  # its own values in another order
    rows = region.outside(replace(batches[0], table=table), inputs)
    assert rows[PATTERN].any()
    assert not region.outside(batches[0], inputs)[PATTERN].any()


def test_a_missing_driver_is_not_judged_and_a_missing_value_is_no_distance(toy_batches) -> None:
    batches = toy_batches(3)
    region = Region.of(batches, ["t0"])
    bare = replace(batches[0], table=batches[0].table.drop(columns="spindle_rpm"))
    assert "spindle_rpm" not in region.outside(bare, ["t0"])
    hole = replace(bare, table=bare.table.assign(t0=np.nan))
    assert np.isnan(region.distance(watched(hole, ["t0"]))).all()


def test_plain_and_back(toy_batches) -> None:
    batches = toy_batches(3)
    region = Region.of(batches, ["t0", "t1"])
    back = Region.from_plain(region.as_plain())
    values = watched(batches[1], ["t0", "t1"]) | {"t0": np.full(batches[1].n_rows, 99.0)}
    np.testing.assert_array_equal(back.distance(values), region.distance(values))
