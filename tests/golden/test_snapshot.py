"""The golden snapshot: the simulation gives the stored numbers, and the comparison sees every kind of difference."""

from __future__ import annotations

import math

import pytest

from tests.golden.snapshot import against_held, differences


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


def test_the_simulation_gives_the_numbers_of_the_file() -> None:
    """The cheapest section; `python -m tests.golden.snapshot compare` takes the others, which are minutes each."""
    assert against_held("simulation") == []
