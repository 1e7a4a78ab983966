"""Digits of values that are compared."""

from __future__ import annotations

import math

import pytest

from reports.labels import digits_of


@pytest.mark.parametrize(("values", "digits"), [
    ((9.8, 0.13, 0.029), 2), ((35.2, 12.0, 2.0), 0), ((4.2, 1.1, 0.8), 1), ((120.0, 35.0, 0.8), 1),
    ((0.76, 0.5, 0.8), 2), ((0.004, 0.003), 2), ((0.0, 0.0), 0), ((12.0, math.nan, 0.03), 2),
])  # fmt: skip
def test_the_largest_has_two_digits_that_count_and_the_smallest_one(values: tuple[float, ...], digits: int) -> None:
    assert digits_of(*values) == digits
