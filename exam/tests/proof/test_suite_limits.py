"""The detection limit that `limits.yml` is made by, on a small machine whose limit is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from data.arrays import Array
from tests.diagnosis.small_cases import consistent
from thermodrift_exam.proof.suite.limits import MOST, Bench, renewed

THRESHOLD = 10.0


@cache
def bench(threshold: float = THRESHOLD) -> Bench:
    return Bench(1, "volumes", {}, consistent(), threshold)


@cache
def wave(size: float) -> list[Array]:
    """A jump to and fro from row to row, which no network makes, of this rms in every channel."""
    return [size * (-1.0) ** np.arange(len(m.row)) for m in consistent().problem.measured]


def test_the_limit_is_where_half_the_square_is_the_threshold() -> None:
    rows = consistent().rows.sum()
    noise = np.median(
        np.concatenate([np.diag(r) for own in consistent().marginal.covariance.roots for r in own.values()])
    )
    assert bench()._times(wave(1.0)) == pytest.approx(np.sqrt(2.0 * THRESHOLD / rows) / noise, rel=0.2)
    assert bench(4.0 * THRESHOLD)._times(wave(1.0)) == pytest.approx(2.0 * bench()._times(wave(1.0)))


def test_twice_the_signature_is_seen_at_half_the_size() -> None:
    assert bench()._times(wave(1.0)) / bench()._times(wave(2.0)) == pytest.approx(2.0)


def test_what_a_recalibration_can_do_is_hardly_seen() -> None:
    blocks = list(consistent().problem.linearise(consistent().x, consistent().nuisance))
    rms = np.sqrt(np.mean(np.concatenate([b.jacobian[:, 0] for b in blocks]) ** 2))
    own = [b.jacobian[:, 0] / rms for b in blocks]
    assert bench()._times(own) > 4.0 * bench()._times(wave(1.0))
    assert bench()._times([np.zeros(len(r)) for r in own]) == MOST


def test_the_table_keeps_every_plant_and_takes_the_median() -> None:
    old = {"limits": {"volumes": {"sun": 9.0}, "elements": {"sun": 1.0}}}
    new = renewed(old, "volumes", [("sun", 1, 0.1), ("sun", 2, 0.4), ("sun", 3, 0.2)])
    assert new["limits"] == {"volumes": {"sun": 0.2}, "elements": {"sun": 1.0}}
    assert new["plants"] == {"volumes": {"sun": [0.1, 0.4, 0.2]}}
