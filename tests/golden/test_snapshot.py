"""The comparison of the golden snapshot itself: it must see a changed number, a lost key and a longer list."""

from __future__ import annotations

import math

import pytest

from tests.golden.snapshot import differences


@pytest.mark.parametrize(
    ("golden", "got", "where", "size"),
    [
        ({"a": [1.0, 2.0]}, {"a": [1.0, 2.0 + 4e-6]}, "/a/1", 2e-6),
        ({"a": 1.0}, {}, "/a", math.inf),
        ({"a": [1.0]}, {"a": [1.0, 2.0]}, "/a", math.inf),
        ({"a": None}, {"a": 0.0}, "/a", math.inf),
        ({"verdict": "explained"}, {"verdict": "consistent"}, "/verdict", math.inf),
        ({"simulated": True}, {"simulated": False}, "/simulated", math.inf),
    ],
)
def test_a_difference_is_located(golden: object, got: object, where: str, size: float) -> None:
    [(at, difference)] = differences(golden, got)
    assert at == where and difference == pytest.approx(size, rel=1e-3)


def test_rounding_is_no_difference() -> None:
    assert not list(differences({"a": [1.0, "x", None, True]}, {"a": [1.0 + 1e-12, "x", None, True]}))
