"""Rows that remember each other: filtered ones are white, and the memory is found again."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from twin.diagnosis.scoring.memory import ROWS, SHARES, Memory, _likeliest, _likelihood, memory_of, whiter

Array = NDArray[np.float64]
N = 80
CASES = [(0.6, 4.0), (0.94, 16.0), (0.25, 2.0), (0.87, 64.0)]  # share, rows to 1/e


def covariance(share: float, keep: float, n: int = N) -> Array:
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    return np.asarray((1.0 - share) * np.eye(n) + share * keep**apart)


def memory(share: float, rows: float) -> Memory:
    return Memory(np.array([0.0, share]), np.array([0.0, np.exp(-1.0 / rows)]))


@pytest.mark.parametrize(("share", "rows"), CASES)
def test_filtered_rows_are_white(share: float, rows: float) -> None:
    own = memory(share, rows)
    filtering = own.filtered(1, np.eye(N))
    seen = filtering @ covariance(share, float(own.keep[1])) @ filtering.T
    assert np.diag(seen) == pytest.approx(1.0, abs=0.5)  # of the second row: the filter begins in its steady state
    assert np.diag(seen)[8:] == pytest.approx(1.0, abs=0.03)
    assert np.abs(seen - np.diag(np.diag(seen)))[8:, 8:].max() < 0.03


@pytest.mark.parametrize(("share", "rows"), CASES)
def test_white_noise_that_is_filtered_has_the_variance_told(share: float, rows: float) -> None:
    own = memory(share, rows)
    filtering = own.filtered(1, np.eye(2000))
    assert np.sum(filtering[-1] ** 2) == pytest.approx(own.white[1], rel=1e-9)
    assert own.white[0] == 1.0


def test_what_is_filtered_can_be_restored() -> None:
    rows = np.random.default_rng(1).standard_normal((N, 3))
    own = memory(0.87, 8.0)
    np.testing.assert_allclose(own.restored(1, own.filtered(1, rows)), rows, atol=1e-12)
    assert own.filtered(0, rows) is rows and own.restored(0, rows) is rows


@pytest.mark.parametrize(("share", "rows"), CASES)
def test_a_trace_that_does_not_change_counts_as_the_inflation_says(share: float, rows: float) -> None:
    own, n = memory(share, rows), 4000
    level = own.filtered(1, np.ones((n, 1)))
    assert n / float((level**2).sum()) == pytest.approx(own.inflation[1], rel=0.1)


def test_the_memory_of_each_channel_is_found() -> None:
    rng = np.random.default_rng(3)
    keep = float(np.exp(-1.0 / 8.0))
    root = np.linalg.cholesky(covariance(0.75, keep))
    left = [np.concatenate([5.0 * root @ rng.standard_normal(N), rng.standard_normal(N)]) for _ in range(40)]
    found = memory_of(left, [np.repeat([0, 1], N)] * 40, 3)
    assert found.share[0] == pytest.approx(0.75, abs=0.15) and found.keep[0] == pytest.approx(keep, abs=0.1)
    assert found.share[1:].tolist() == [0.0, 0.0]


def test_too_few_rows_say_nothing() -> None:
    assert memory_of([np.arange(15.0)], [np.zeros(15, int)], 1).share[0] == 0.0


def test_the_whiter_of_two_is_chosen_channel_by_channel() -> None:
    one = Memory(np.array([0.5, 0.9]), np.array([0.5, 0.9]))
    other = Memory(np.array([0.9, 0.1]), np.array([0.9, 0.1]))
    both = whiter(one, other)
    assert both.share.tolist() == [0.5, 0.1] and both.keep.tolist() == [0.5, 0.1]


@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
@pytest.mark.parametrize("rows", [1.5, 6.0, 40.0])
def test_going_uphill_finds_what_the_whole_grid_has(share: float, rows: float) -> None:
    phi = float(np.exp(-1.0 / rows))
    given = Memory(np.array([share]), np.array([phi]))
    series = given.restored(0, np.random.default_rng(int(10 * rows)).standard_normal((120, 8)))
    there = np.ones(series.shape, bool)
    keeps = np.exp(-1.0 / np.array(ROWS))
    every = max(_likelihood(series, there, w, float(k)) for w in SHARES for k in keeps)
    assert _likeliest(series, there)[0] == pytest.approx(every, abs=0.5)
