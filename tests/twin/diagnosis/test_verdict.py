"""What is left after all that was found: a large slow misfit is never consistent, the shape of a small one is."""

from __future__ import annotations

import math

import pytest

from twin.diagnosis.proposals.candidate import Where
from twin.diagnosis.telling.conclude import REST, REST_OF_FEW, STRUCTURE, slow_remainder, verdict_of
from twin.diagnosis.telling.found import Found, Rms


def test_a_slow_misfit_counts_by_its_size() -> None:
    rms = [
        Rms("t_head", "K", 9.0, 2.0, 0.1, sensor=True),
        Rms("z", "um", 9.0, 30.0, 1.0),
        Rms("x", "um", 9.0, 1.0, 1.0),
    ]
    assert slow_remainder(rms) == pytest.approx(20.0 / STRUCTURE)  # the median channel
    assert slow_remainder([Rms("z", "um", 9.0, 5.0, math.nan)]) == 0.0
    assert slow_remainder([]) == 0.0


@pytest.mark.parametrize(
    ("slow", "runs", "verdict"),
    [
        (0.9 * REST, 12, "consistent"), (1.1 * REST, 12, "undecidable"),
        (0.9 * REST, 4, "undecidable"), (0.9 * REST_OF_FEW, 4, "consistent"),
    ],
)  # fmt: skip
def test_where_nothing_is_found_and_much_is_left_nothing_is_decided(slow: float, runs: int, verdict: str) -> None:
    assert verdict_of([], False, 2.0 * REST, slow, runs) == verdict  # filtered rows alone are no claim
    assert verdict_of([], True, 0.0, slow, runs) == "unlisted"


@pytest.mark.parametrize(
    ("rest", "slow", "verdict"),
    [
        (0.9, 0.9, "explained"), (1.1, 0.9, "partly_explained"), (0.9, 1.1, "partly_explained"),
    ],
)  # fmt: skip
def test_beside_what_was_found_either_is_more(rest: float, slow: float, verdict: str) -> None:
    sink = Found("floor_sink", Where("node", "bed"), "the bed", {}, 0.95)
    assert verdict_of([sink], False, rest * REST, slow * REST, 12) == verdict
