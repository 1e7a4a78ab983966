"""Rows that remember each other: filtered ones are white, and the memory is found again."""

from __future__ import annotations

import numpy as np
import pytest

from data.arrays import Array
from diagnosis.fitting.regression import (
    MATRIX_FILTER_ROWS,
    MEMORY_REACHES_ROWS,
    MEMORY_SHARES,
    Memory,
    memory_of,
    whiter,
)

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
    filtering = own.filtered([(1, slice(0, N))], np.eye(N))
    seen = filtering @ covariance(share, float(own.keep[1])) @ filtering.T
    assert np.diag(seen) == pytest.approx(1.0, abs=0.5)  # of the second row: the filter begins in its steady state
    assert np.diag(seen)[8:] == pytest.approx(1.0, abs=0.03)
    assert np.abs(seen - np.diag(np.diag(seen)))[8:, 8:].max() < 0.03


@pytest.mark.parametrize(("share", "rows"), CASES)
def test_white_noise_that_is_filtered_has_the_variance_told(share: float, rows: float) -> None:
    own = memory(share, rows)
    filtering = own.filtered([(1, slice(0, 2000))], np.eye(2000))
    assert np.sum(filtering[-1] ** 2) == pytest.approx(own.white[1], rel=1e-9)
    assert own.white[0] == 1.0


def test_what_is_filtered_can_be_restored() -> None:
    rows = np.random.default_rng(1).standard_normal((N, 3))
    own = memory(0.87, 8.0)
    both = [(0, slice(0, 20)), (1, slice(20, N))]
    seen = own.filtered(both, rows)
    np.testing.assert_allclose(own.restored(both, seen), rows, atol=1e-12)
    np.testing.assert_array_equal(seen[:20], rows[:20])  # the first channel's rows are independent
    assert np.abs(seen[20:] - rows[20:]).max() > 1.0


def test_few_rows_are_filtered_as_many_are() -> None:
    """A matrix filters the few, a recursion the many."""
    rows = np.random.default_rng(2).standard_normal((MATRIX_FILTER_ROWS + 1, 2))
    own = memory(0.87, 8.0)
    many, few = (own.filtered([(1, slice(0, n))], rows[:n]) for n in (MATRIX_FILTER_ROWS + 1, MATRIX_FILTER_ROWS))
    np.testing.assert_allclose(few, many[:MATRIX_FILTER_ROWS], atol=1e-12)
    np.testing.assert_allclose(own.filtered([(1, slice(0, 7))], rows[:7, 0]), many[:7, 0], atol=1e-12)


@pytest.mark.parametrize(("share", "rows"), CASES)
def test_a_trace_that_does_not_change_counts_as_the_inflation_says(share: float, rows: float) -> None:
    own, n = memory(share, rows), 4000
    level = own.filtered([(1, slice(0, n))], np.ones((n, 1)))
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
def test_what_is_found_is_as_likely_as_any_by_the_series_own_covariance(share: float, rows: float) -> None:
    """Series of different lengths, the variance at its best."""
    given = Memory(np.array([share]), np.array([np.exp(-1.0 / rows)]))
    rng = np.random.default_rng(int(10 * rows))
    series = [3.0 * given.restored([(0, slice(0, n))], rng.standard_normal(n)) for n in (120, 120, 90, 60, 119, 120)]
    found = memory_of(series, [np.zeros(len(s), int) for s in series], 1)

    def likelihood(w: float, keep: float) -> float:
        roots = [np.linalg.cholesky(covariance(w, keep, len(s))) for s in series]
        square = np.mean(np.concatenate([np.linalg.solve(r, s) for r, s in zip(roots, series, strict=True)]) ** 2)
        n = sum(map(len, series))
        return float(-0.5 * n * np.log(square) - sum(np.log(np.diag(r)).sum() for r in roots))

    best = max(likelihood(w, float(np.exp(-1.0 / r))) for w in MEMORY_SHARES for r in MEMORY_REACHES_ROWS)
    assert likelihood(float(found.share[0]), float(found.keep[0])) > best - 3.0  # the filter begins in its steady state
    assert best > likelihood(0.0, 0.0) + (5.0 if share > 0.3 else 0.0)
