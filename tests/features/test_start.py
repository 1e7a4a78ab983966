"""The zero of a batch: its first known row, and along an axis the first sweep."""

import numpy as np
import pandas as pd

from data.batch import Batch, Channel
from features.design import Design
from features.rises import zeroed_error_um
from features.start import Start
from tests.features.test_design import INPUTS, assert_same, year


def test_the_first_known_row_is_the_zero() -> None:
    known = np.array([False, True, True])
    start = Start.of(known, np.arange(3.0))
    assert start is not None
    np.testing.assert_array_equal(
        start.since(np.array([[1.0, 5.0], [2.0, 7.0], [4.0, 6.0]])), [[-1, -2], [0, 0], [2, -1]]
    )
    assert Start.of(np.zeros(3, bool), np.arange(3.0)) is None


def test_along_an_axis_a_series_is_zeroed_as_the_recorded_error_is() -> None:
    rng = np.random.default_rng(1)
    at_mm = np.resize([0.0, 60.0, 120.0, 90.0], 16)
    at_mm[[5, 9]] = np.nan
    time_s, error_um = np.arange(16) * 60.0, rng.normal(size=16)
    channels = {"at": Channel("at", "position", "mm"), "z": Channel("z", "error", "um", position="at")}
    table = {"time_s": time_s, "at": at_mm, "z": np.where(np.isfinite(at_mm), error_um, np.nan)}
    batch = Batch("lathe", "one", pd.DataFrame(table), channels)
    start = Start.of(np.ones(16, bool), time_s, at_mm)
    assert start is not None
    ours, recorded = start.since(error_um), zeroed_error_um(batch, "z")
    known = np.isfinite(recorded)
    np.testing.assert_allclose(ours[known], recorded[known], atol=1e-12)
    assert (ours[:4] == 0.0).all() and np.isfinite(ours).all()


def test_a_started_design_is_relative_to_its_first_complete_row_and_keeps_raw_sums() -> None:
    design = Design.build(year(), ("a", "b", "room", "room@start"), "z")
    x = design.x.copy()
    x[:3, 1] = np.nan  # b is late in the first batch
    late = Design(design.inputs, "z", design.batch_ids, x, design.y_um, design.time_s, design.offsets)
    started = late.started
    np.testing.assert_array_equal(started.x[3], 0.0)
    np.testing.assert_allclose(started.x[5], x[5] - x[3])
    np.testing.assert_array_equal(started.x[:, 3][np.isfinite(started.x[:, 3])], 0.0)
    rows = started.usable & (started.group == 0)
    np.testing.assert_allclose(started.moments.xx[0], started.x[rows].T @ started.x[rows])
    assert started.moments.shift_y == 0.0 and not started.moments.shift_x.any()
    alone = late.subset(("a", "room"))
    np.testing.assert_allclose(alone.started.x[5], x[5, [0, 2]] - x[0, [0, 2]])


def test_a_subset_takes_the_sums_of_the_whole_where_the_start_is_the_same() -> None:
    design = Design.build([year()[0], year()[2]], INPUTS, "z")
    sub = design.subset(("b", "room"))
    assert sub.started.root is design.started
    assert_same(sub.started.moments, design.started.moments.subset([1, 2]))
