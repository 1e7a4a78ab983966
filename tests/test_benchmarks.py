"""The table of performance figures: its shape, not its times."""

import math

import pytest

from benchmarks.__main__ import Sizes, table_rows
from benchmarks.table import HEAD, Row, exponent, markdown, seconds

TINY = Sizes(("mlr",), batches=4, every=4, repeats=1, processes=1, csv_gb=0.003, twin_batches=1, twin_h=0.1, growth=1)


def test_a_row_compares_own_time_with_reference_and_target() -> None:
    row = Row("fit", 0.002, "loop", 0.05, target_ratio=20, target_s=0.001, note="4 points")
    assert row.cells() == ("fit (4 points)", "2 ms", "loop", "50 ms", "25×", "≥ 20×, ≤ 1 ms", "no", "")
    assert Row("fit", 0.002, "loop", 0.05, 20).met is True
    assert Row("fit", 0.002, "loop", 0.05, limit=("≤ 180 MB", False)).met is False
    left_out = Row("nets on a GPU", note="not run (no GPU)", target_ratio=2)
    assert left_out.met is None and left_out.cells()[:2] == ("nets on a GPU", "not run (no GPU)")


def test_times_have_three_digits_and_a_unit() -> None:
    assert [seconds(v) for v in (12.345, 0.012345, 1.2345e-5, math.nan)] == ["12.3 s", "12.3 ms", "12.3 µs", ""]


def test_an_exponent_is_the_slope_of_the_logarithms() -> None:
    assert math.isclose(exponent([10, 20, 40], [3 * n**1.5 for n in (10, 20, 40)]), 1.5)


@pytest.mark.slow
def test_the_table_has_every_part_and_a_value_in_every_row() -> None:
    rows = table_rows(TINY)
    lines = markdown(rows).splitlines()
    assert len(lines) == len(rows) + 2
    assert all(line.count(" | ") == len(HEAD) - 1 for line in lines)
    for part in (
        "crossing, mlr",
        "lag dictionary",
        "elastic net",
        "twin",
        "ingest",
        "complete crossing",
        "nets on a GPU",
    ):
        assert any(row.what.startswith(part) for row in rows), part
    for row in rows:
        assert row.note.startswith("not run") or row.ours_s > 0, row
        assert not row.reference_s <= 0, row
