"""The error along an axis less that of the first sweep at the same position, against hand calculations."""

from __future__ import annotations

import numpy as np
import pandas as pd

from data.batch import Batch, Channel, Finding
from features.design import Design
from features.rises import zeroed_error_um

NAN = float("nan")
CHANNELS = {
    "nut": Channel("nut", "temperature", "degC"),
    "at": Channel("at", "position", "mm"),
    "x": Channel("x", "error", "um", position="at"),
    "z": Channel("z", "error", "um"),
}


def batch(at: list[float], x: list[float], findings: tuple[Finding, ...] = (), name: str = "run") -> Batch:
    n = len(at)
    columns = {"time_s": 10.0 * np.arange(n), "nut": 20.0 + np.arange(n), "at": at, "x": x, "z": np.arange(n) + 5.0}
    return Batch("lathe", name, pd.DataFrame(columns), CHANNELS, findings=findings)


def zeroed(at: list[float], x: list[float], findings: tuple[Finding, ...] = ()) -> list[float]:
    return np.round(zeroed_error_um(batch(at, x, findings), "x"), 12).tolist()


def same(got: list[float], want: list[float]) -> bool:
    return np.array_equal(got, want, equal_nan=True)


def test_every_position_has_its_own_zero() -> None:
    got = zeroed([0, 60, 180, NAN, 0, 60, 180], [1, 2, 5, NAN, 4, 9, 25])
    assert same(got, [0, 0, 0, NAN, 3, 7, 20])


def test_between_the_positions_of_the_first_sweep_the_zero_is_on_a_line() -> None:
    got = zeroed([0, 100, 0, 25, 100], [10, 30, 10, 50, 30])  # at 25 mm the first sweep read 15
    assert same(got, [0, 0, 0, 35, 0])


def test_beyond_the_first_sweep_nothing_is_known() -> None:
    assert same(zeroed([20, 80, 20, 0, 80, 100], [1, 2, 3, 4, 5, 6]), [0, 0, 2, NAN, 3, NAN])


def test_a_way_back_is_taken_against_the_way_there() -> None:
    got = zeroed([0, 90, 180, 180, 90, 0], [0, 10, 20, 21, 13, 2])
    assert same(got, [0, 0, 0, 1, 3, 2])


def test_positions_of_a_laser_scatter_and_are_the_same() -> None:
    got = zeroed([0.001, 90, 180.002, 0, 90.001, 180.004], [1, 2, 3, 4, 5, 6])
    assert np.allclose(got, [0, 0, 0, 3, 3, 3], atol=1e-3)


def test_a_masked_reading_is_no_zero_and_a_masked_position_no_reading() -> None:
    hidden = Finding("out_of_range", "x", "…", 10.0, 10.0)
    assert same(zeroed([0, 50, 100, 0, 50, 100], [0, 99, 4, 1, 9, 5], (hidden,)), [0, NAN, 0, 1, 7, 1])
    lost = Finding("out_of_range", "at", "…", 40.0, 40.0)
    assert same(zeroed([0, 50, 100, 0, 50, 100], [0, 2, 4, 1, 9, 5], (lost,)), [0, 0, 0, 1, NAN, 1])
    assert np.isnan(zeroed([NAN] * 3, [1, 2, 3])).all()


def test_the_design_knows_the_positions_of_its_target() -> None:
    batches = [batch([0, 50, NAN], [1, 2, NAN]), batch([NAN, 0, 50, 0], [NAN, 3, 3, 8], name="other")]
    design = Design.build(batches, ("nut",), "x")
    assert design.along == "at" == design.subset(()).along
    assert same(design.position_mm("at").tolist(), [0, 50, NAN, NAN, 0, 50, 0])
    assert design.subset(("nut",)).position_mm("at") is design.position_mm("at")
    assert same(design.y_um.tolist(), [0, 0, NAN, NAN, 0, 0, 5]) and design.usable.sum() == 5
    assert Design.build(batches, ("nut",), "z").along == "" == Design.build(batches, ("nut",), None).along
