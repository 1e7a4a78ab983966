"""The trained region: inside, at its edge, outside."""

from dataclasses import replace

import numpy as np
import pytest

from models.region import outside, region_of


def test_training_batches_are_inside_their_own_region(toy_batches) -> None:
    batches = toy_batches(4)
    region = region_of(batches, ["t0", "room"])
    assert set(region) == {"t0", "room", "t0@start", "room@start", "spindle_rpm"}
    assert region["spindle_rpm"] == (2000.0, 6000.0)
    for b in batches:
        assert not any(rows.any() for rows in outside(b, region, ["t0", "room"]).values())


@pytest.mark.parametrize(
    ("channel", "shift", "flagged"), [("t0", 40.0, "t0@start"), ("spindle_rpm", 9000.0, "spindle_rpm")]
)
def test_colder_warmer_or_faster_says_so(channel, shift, flagged, toy_batches) -> None:
    batches = toy_batches(4)
    region = region_of(batches, ["t0"])
    table = batches[0].table.copy()
    table[channel] = table[channel] + shift
    rows = outside(replace(batches[0], table=table), region, ["t0"])
    assert rows[flagged].all()
    assert not np.any(rows["t0"])
